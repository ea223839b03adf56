"""Every check can fail: what breaks the contract in one way fails the check about it, and no other."""

from __future__ import annotations

import re

import pytest

from coliags_plugin.core import registry
from coliags_plugin.testing import METHOD_CHECKS, CheckContext, name_of_check
from tests.checks import components

SPLATS = """
datamanager: auto
field: Balls
renderer: auto
strategy: {name: Division}
losses: {colour: {name: Colour, weight: 1.0}}
optimizers: {means: {lr: 0.01}, sizes: {lr: 0.0}, logits: {lr: 0.05}}
"""
FOG = """
datamanager: auto
field: Fog
renderer: {name: volume, samples: 16}
strategy: none
losses: {colour: {name: Colour, weight: 1.0}}
optimizers: {near: {lr: 0.05}, far: {lr: 0.05}}
"""
#: What is changed, by overrides; the only check that fails; and what its line says.
BROKEN = [
    (["field=DoublesItsSize"], "resolves", "read again, it has another field"),
    (["losses.colour={name: AcceptsAnyOption, weight: 1.0}"], "options", "losses.colour.no_such_option=1"),
    (["field=CrashesWhenMade"], "builds", r"ZeroDivisionError: division by zero \(tests/checks/components.py:\d+\)"),
    (["field=HasAnUngroupedParameter"], "groups", "never trained: field.forgotten"),
    (["field=SharesAParameter", "strategy=none"], "groups", "in more than one parameter group: field.means"),
    (["field=CrashesInALibrary"], "trains", r"RuntimeError: .*\(tests/checks/components.py:\d+\)"),
    (["losses.late={name: Colour, weight: 1.0, from_step: 29990}"], "terms", r"'late' \(after step 29990 of 30000\)"),
    (["losses.colour={name: Maximised, weight: 1.0}"], "learns", "it should fall"),
    (["field=HasADetachedGroup"], "gradients", "no gradient but 0 in 20 steps: means;"),
    (["renderer=LacksNormals"], "renders", "normals is promised"),
    (["renderer=DepthInMetres"], "renders", "depth_median is between 0.0"),
    (["renderer=FlatNormals"], "renders", r"normals has shape \[32, 40\], not \[32, 40, 3\]"),
    (["renderer=AlphaAboveOne"], "renders", "alpha is between"),
    (["field=NaNFeature"], "renders", "albedo has 1.* numbers that are not finite"),
    (["renderer=FixedSize"], "renders", "another size of 29 x 23 pixels"),
    (["modules.free=CrashesForFreeCameras"], "renders", "AttributeError: 'NoneType'"),
    (["field=RendersWithChance"], "renders again", "two renderings of frame .* differs in"),
    (["renderer=IgnoresUnknownOutputs"], "requests", "output 'no_such_output' by Altered: not refused"),
    (["renderer=CrashesForUnknownOutputs"], "requests", "KeyError instead of InputError"),
    (["renderer=IgnoresPixels"], "requests", "single pixels by Altered: not refused"),
    (["field=ForgetsABuffer"], "loads", "must be a parameter or a buffer"),
    (["losses.colour={name: DiffersFromRunToRun, weight: 1.0}"], "repeats", "two runs of 10 steps"),
    (["losses.colour={name: TakesGlobalRandomNumbers, weight: 1.0}"], "resumes", "resumed for 10: field/.* differs in"),
    (["sampler=ForgetsItsPlace"], "resumes", "resumed for 10"),
    (["field=ReadsWhatIsThere"], "checkpoints", "without the field's 'means': not refused"),
    (["strategy=ForgetsAGroup"], "rows", "492 to 495 rows: parameter group 'logits' has 494"),
    (["strategy=ForgetsTheBuffer"], "rows", "492 to 495 rows: buffer 'ages' has 492"),
    (["strategy=ForgetsTheCounter"], "rows", "492 to 495 rows: counter 'steps' of the strategy has 492"),
    (["strategy=GoesPastAdam"], "rows", "the optimizer of group 'means' trains what is no longer the field's"),
    (["strategy=ForgetsAfterAnEvent"], "rows", "resumed after the event of step 4"),
    (["protocol=wants-albedo"], "evaluates", "outputs needed by protocol 'wants-albedo': albedo"),
    (["renderer=HasNoExpectedDepth"], "images", "depth_expected"),
    (["losses.colour={name: AssumesDepth, weight: 1.0}"], "other data", "without depth: AttributeError: .*components"),
    (["sampler=CrashesAlone"], "other data", "with one frame: RuntimeError: .*components"),
    (["losses.colour={name: CountsMaskedPixels, weight: 1.0}"], "ignored pixels", "masked pixels: colour"),
    (["renderer={name: SwapsPixels, samples: 16}"], "pixels", "rgb of single pixels"),
]  # fmt: skip

#: Checks whose first component is tried in the quick suite; the others take seconds together.
QUICK = {"builds", "trains", "renders", "resumes"}


@pytest.fixture(autouse=True)
def registered(monkeypatch):
    """The components of components.py under the names of their classes, the protocol under its own."""
    kinds = {
        components.RoundGaussians: registry.fields,
        components.RadianceField: registry.fields,
        components.Loss: registry.losses,
        components.Strategy: registry.strategies,
        components.Sampler: registry.samplers,
        components.ViewModule: registry.modules,
        components.CpuRenderer: registry.renderers,
        components.VolumeRenderer: registry.renderers,
        components.Protocol: registry.protocols,
    }
    for name, target in vars(components).items():
        for base, kind in kinds.items():
            if isinstance(target, type) and issubclass(target, base) and target.__module__ == components.__name__:
                kind.names()  # so that nothing is discovered later
                key = target.name if kind is registry.protocols else name
                monkeypatch.setitem(kind._targets, key, target)
                monkeypatch.setitem(kind._sources, key, "a test")


def outcomes(tmp_path, text, overrides=()):
    (tmp_path / "made-up.yaml").write_text(text)
    context = CheckContext(str(tmp_path / "made-up.yaml"), tmp_path, overrides)
    return [context.outcome(check) for check in METHOD_CHECKS]


def failed(results):
    return {result.name: result.detail for result in results if result.status == "failed"}


@pytest.mark.parametrize(("text", "skipped"), [(SPLATS, {"pixels"}), (FOG, {"rows"})], ids=["splats", "fog"])
def test_sound_components_pass(tmp_path, text, skipped):
    results = outcomes(tmp_path, text)
    assert failed(results) == {}
    assert {result.name for result in results if result.status == "skipped"} == skipped


@pytest.mark.parametrize(
    ("overrides", "name", "line"),
    [
        pytest.param(
            *row, marks=[pytest.mark.thorough] * (row[1] not in QUICK or row[1] in {r[1] for r in BROKEN[:index]})
        )
        for index, row in enumerate(BROKEN)
    ],
    ids=str,
)
def test_a_broken_component_fails_the_check_that_is_about_it(tmp_path, overrides, name, line):
    text = FOG if name == "pixels" else SPLATS
    failures = failed(outcomes(tmp_path, text, overrides))
    assert failures.keys() == {name}, failures
    assert re.search(line, failures[name]), failures[name]
    assert "\n" not in failures[name]


def test_every_check_has_a_component_that_fails_it():
    assert {name for _, name, _ in BROKEN} == {name_of_check(check) for check in METHOD_CHECKS}
