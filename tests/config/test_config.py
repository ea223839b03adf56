"""Method configs: inheritance, overrides, and errors that name file, line and key; settings as assignments."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml
from hypothesis import example, given, settings
from hypothesis import strategies as st

from coliags_plugin.config.method_config import (
    descriptions,
    load_method,
    method_files,
    method_folder,
    method_name,
    method_text,
)
from coliags_plugin.config.yaml_tree import (
    assignments,
    dump,
    dump_inline,
    parse_assignments,
    parse_tree,
    parse_value,
    plain_value,
)
from coliags_plugin.core import registry
from coliags_plugin.core.errors import InputError
from tests.commands import refuses


@pytest.fixture
def method_file(tmp_path):
    def write(text, name="mine.yaml"):
        path = tmp_path / "here" / name
        path.parent.mkdir(exist_ok=True)
        path.write_text(text)
        return str(path)

    return write


def test_every_shipped_method_is_described_and_benchmarks_are_none():
    assert all(descriptions(method_files()).values()) and "ablations/none" in method_files()
    assert list((method_folder() / "benchmarks").glob("*.yaml"))
    assert not [name for name in method_files() if "benchmarks" in name]


def test_scaffold_and_coliags_differ_in_heads_only():
    ours = load_method("coliags").config.model_dump()
    rival = load_method("scaffold-gs-depth").config.model_dump()
    assert ours.pop("description") != rival.pop("description")
    geometry = {"hidden": 32, "initial_opacity": None}
    assert ours["field"].pop("geometry_head") == {"name": "imve", "frequencies": 10, **geometry}
    appearance = {"hidden": 32, "bias_init": "scene_distances"}
    assert ours["field"].pop("appearance_head") == {"name": "imia", "frequencies": 5, **appearance}
    assert rival["field"].pop("geometry_head") == {"name": "plain", **geometry}
    assert rival["field"].pop("appearance_head") == {"name": "plain", "distance": False, **appearance}
    assert ours == rival


def test_depth_weighs_as_in_the_paper_at_30_mm_and_a_quarter_of_it_at_least():
    losses, paper = (load_method(name).config.losses for name in ("coliags-plus", "coliags"))
    assert losses["depth"].name == "scene-depth" and paper.keys() <= losses.keys()
    for step in (0, 1, 2):
        expected = max(30 * paper["depth"].settings.weight_at(step, 2), 1.5)
        assert losses["depth"].settings.weight_at(step, 2) == pytest.approx(expected)


@pytest.mark.parametrize(
    ("method", "other", "option", "values"),
    [
        ("scaffold-gs-distance", "scaffold-gs-depth", "distance", (True, False)),
        ("coliags", "ablations/bias-init-pytorch", "bias_init", ("scene_distances", "pytorch")),
    ],
)
def test_methods_that_differ_in_one_option_of_the_appearance_head_alone(method, other, option, values):
    first, second = (load_method(name).config.model_dump() for name in (method, other))
    assert first.pop("description") != second.pop("description")
    assert tuple(config["field"]["appearance_head"].pop(option) for config in (first, second)) == values
    assert first == second
    assert f"bias_init: scene_distances  # {method}.yaml:" in load_method(method).annotated()


@pytest.mark.parametrize(
    ("row", "depth", "heads", "frequencies"),
    [
        ("none", False, ("plain", "plain"), ()),
        ("depth", True, ("plain", "plain"), ()),
        ("depth-imia", True, ("plain", "imia"), ()),
        ("depth-imve", True, ("imve", "plain"), ()),
        ("depth-imve-imia", True, ("imve", "imia"), (10, 5)),
        *(
            (f"embedding-{geometry}-{appearance}", True, ("imve", "imia"), (geometry, appearance))
            for geometry, appearance in ((10, 0), (10, 5), (10, 10), (5, 5), (15, 5))
        ),
    ],
)
def test_the_papers_ablation_rows_and_embedding_sizes(row, depth, heads, frequencies):
    config = load_method(f"ablations/{row}").config
    assert ("depth" in config.losses) == depth
    head_nodes = config.field.settings.geometry_head, config.field.settings.appearance_head
    assert tuple(head.name for head in head_nodes) == heads
    if frequencies:
        assert tuple(head.settings.frequencies for head in head_nodes) == frequencies


def looked_up(config, path):
    """Value of a config at a path of attributes and keys."""
    for key in path.split("."):
        config = config[key] if isinstance(config, dict) else getattr(config, key)
    return config


HEAD = "field.settings.geometry_head"
RATE = "optimizers.features.lr"


@pytest.mark.parametrize(
    ("text", "overrides", "expected"),
    [
        ("field:\n  geometry_head: {name: plain}\n", (), {f"{HEAD}.name": "plain"}),
        (
            "field:\n  geometry_head: {frequencies: 4}\n",
            (),
            {f"{HEAD}.name": "imve", f"{HEAD}.settings.frequencies": 4},
        ),
        ("field: {geometry_head: {frequencies: 4}}\n", (), {f"{HEAD}.settings.hidden": 32}),
        ("schedule: {steps: 7}\n", (), {"schedule.steps": 7}),
        ("", ["field.geometry_head.frequencies=8", f"{RATE}=1e-3"], {f"{HEAD}.settings.frequencies": 8, RATE: 1e-3}),
        ("", ["losses.depth.final_weight=null", "losses.depth.weight=0"], {"losses.depth.settings.weight": 0.0}),
        ("", [f"{RATE}=0"], {RATE: 0.0}),
        ("", ["optimizers.features.beta2=0.5"], {RATE: 0.0075, "optimizers.features.beta2": 0.5}),
        ("optimizers: {offsets: {lr: 1.0}}\n", ["optimizers.offsets=null"], {"optimizers.offsets.lr": 0.01}),
        ("", ["sampler=pixels", "sampler.pixels=7"], {"sampler.name": "pixels", "sampler.settings.pixels": 7}),
        ("", ["losses={l1: {name: l1, weight: 1}}", "losses.l1.weight=0.5"], {"losses.l1.settings.weight": 0.5}),
    ],
)
def test_files_and_overrides_change_what_they_inherit(method_file, text, overrides, expected):
    method_file(f"base: coliags\n{text}", "parent.yaml")
    config = load_method(method_file("base: parent.yaml\n"), overrides).config
    assert {path: looked_up(config, path) for path in expected} == expected
    assert hasattr(looked_up(config, f"{HEAD}.settings"), "frequencies") == ("plain" not in text)


def test_comments_tell_file_and_line_or_the_option_and_the_meaning():
    loaded = load_method("coliags", ["field.geometry_head.frequencies=8", "modules.exposure=gain"])
    lines = [line.strip() for line in loaded.annotated().splitlines()]
    option, meaning = "field.geometry_head.frequencies=8", "Frequencies of gamma, per component of the direction."
    assert f"frequencies: 8  # `{option}`: {meaning}" in lines
    meaning = "Learned factor on the rendered colours for each training frame."
    assert f"name: gain  # `modules.exposure=gain`: {meaning}" in lines
    assert "features: 32  # scaffold-gs.yaml:10: Feature channels per anchor, input of the heads." in lines
    assert "max_gain: 8.0  # default: Gains are at least 1 / max_gain and at most max_gain." in lines
    assert "schedule:  # How long to train and how often to write." in lines
    assert yaml.safe_load(loaded.annotated()) == yaml.safe_load(loaded.config.to_yaml())


@pytest.mark.parametrize(
    "mapping",
    [
        {"base": "coliags", "field": {"voxel_size": np.float32(2.0)}, "losses": {"depth": None}},
        {"description": "d", "base": Path("mine.yaml"), "strategy": {"name": "none"}, "schedule": {"steps": 7}},
        {"base": "~/mine.yaml", "losses": {"edges": {"name": "d-ssim", "weight": 1e-5}}},
        load_method("3dgs").config.model_dump(),
    ],
)
def test_a_mapping_is_a_method_like_the_same_file(method_file, mapping, monkeypatch, tmp_path):
    folder = Path(method_file("base: scaffold-gs\nfield: {voxel_size: 3.0}\n")).parent
    monkeypatch.setenv("HOME", str(folder))
    monkeypatch.chdir(folder)
    text = method_text({"name": "my method", **mapping})
    monkeypatch.chdir(tmp_path.parent)  # as a worker, which may be elsewhere
    loaded = load_method(text)
    plain = parse_value(dump_inline(plain_value(mapping, "")))
    assert loaded.config == load_method(method_file(dump(plain), "same.yaml")).config
    assert (loaded.name, method_name(method_text(mapping))) == ("my method", "mapping")
    assert method_text(Path("a.yaml")) == method_text("a.yaml") == "a.yaml"


@pytest.mark.parametrize(
    ("mapping", "message"),
    [
        ({"base": "coliags", "feild": {}}, "mapping: feild: unknown key 'feild'.*Did you mean 'field'"),
        ({"base": "coliags", "field": {"voxel_sise": 1}}, "mapping: field.voxel_sise: .*Did you mean 'voxel_size'"),
        ({"base": "coliag"}, "no method 'coliag'.*Did you mean 'coliags'"),
        ({"field": "anchors"}, "mapping: losses: is missing"),
        ({"base": "coliags", "losses": {"mine": object()}}, "setting mapping.losses.mine is a object"),
        (["coliags"], r"method \['coliags'\]. Expected a name, the path of a YAML file, or a mapping"),
    ],
)
def test_mistakes_in_a_mapping_are_named(mapping, message):
    refuses(message, lambda: load_method(method_text(mapping)))


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        ("base: coliags\nfield:\n  geometry_head: {frequences: 4}\n", ["mine.yaml:3", "frequences", "'frequencies'"]),
        ("base: coliags\nvoxel_size: 1.0\n", ["unknown key 'voxel_size'", "Did you mean 'field.voxel_size'"]),
        ("base: coliags\nfeild: {}\n", ["mine.yaml:2", "unknown key 'feild'", "Did you mean 'field'"]),
        ("base: coliags\nfield: {near_plane: 0.2}\n", ["mine.yaml:2", "unknown key 'near_plane'"]),
        ("a: " + "[" * 500, ["nested too deeply"]),
        ("a: &a {b: *a}\n", ["nested too deeply"]),
        (f"base: coliags\na: {'9' * 5000}\n", ["mine.yaml:2: Exceeds the limit (4300 digits)"]),
        ("2020-13-45: a\n", ["mine.yaml: month must be in 1..12"]),
        ("base: coliags\nnear_plane: -1.0\n", ["mine.yaml:2", "near_plane", "greater than or equal to 0"]),
        ("base: coliags\nrenderer: {name: cpu, eps: 1.0}\n", ["unknown key 'eps'", "Did you mean 'eps2d'"]),
        ("base: coliags\nschedule:\n  steps: many\n", ["mine.yaml:3", "schedule.steps", "'many'"]),
        ("base: coliags\nrenderer: {name: cuda-magic}\n", ["mine.yaml:2", "no renderer 'cuda-magic'"]),
        ("base: coliags\nlosses:\n  extra: {weight: 1.0}\n", ["mine.yaml:3", "needs 'name'", "depth-l1"]),
        (
            "base: coliags\nfield:\n  appearance_head: {spread_kinks: true}\n",
            ["mine.yaml:3", "field.appearance_head.spread_kinks", "unknown key 'spread_kinks'", "bias_init"],
        ),
        ("base: coliags\ndatamanager:\n  width: 8\n", ["mine.yaml:2: datamanager: width = 8 and height = None: give"]),
        ("base: coliags\nprotocol: papper\n", ["mine.yaml:2: protocol: no protocol 'papper'", "Did you mean 'paper'"]),
        ("base: coliags\nschedule: {steps: 5}\nschedule: {steps: 6}\n", ["mine.yaml:3", "twice", "mine.yaml:2"]),
        ("base: coliags\n  bad: [\n", ["mine.yaml:"]),
        ("- a\n- b\n", ["mine.yaml", "mapping"]),
        ("base: coliagz\n", ["mine.yaml:1: base: no method 'coliagz'", "Did you mean 'coliags'"]),
        ("description: x\nbase: 0123456789.yaml\n", ["mine.yaml:2: base: no file ", "See `coliags list methods`"]),
        ("base: odd.yml\n", ["mine.yaml:1: base: no file ", "Did you mean 'odd.yaml'?"]),
        ("base: coliags.yaml\n", ["mine.yaml:1: base: no file ", "Did you mean 'coliags'?"]),
        ("base: mine.yaml\n", ["mine.yaml:1: base: method configs inherit from each other: mine.yaml -> mine.yaml"]),
        ("base: ./../here/mine.yaml\n", ["mine.yaml:1: base: method configs inherit from each other"]),
        ("base: odd.yaml\n", ["mine.yaml:1: base: odd.yaml holds tuple"]),
        ("base: 3\n", ["mine.yaml:1", "base is 3"]),
        ("base: {name: coliags}\n", ["mine.yaml:1: base is {'name': 'coliags'}"]),
        ("description: lonely\n", ["datamanager: is missing"]),
        ("base: scaffold-gs\nlosses: {l1: null, d-ssim: null, scale-volume: null}\n", ["losses", "at least 1 item"]),
    ],
)
def test_mistakes_are_named(method_file, text, parts):
    method_file("- a\n", "odd.yaml")
    with pytest.raises(InputError) as caught:
        load_method(method_file(text))
    for part in parts:
        assert part in str(caught.value)


@pytest.mark.parametrize(
    ("key", "values"),
    [
        ("losses.depth.final_weight", r"final_weight 0\.0 with weight 0\.2"),
        ("losses.depth.weight", r"final_weight 0\.01 with weight 0\.0"),
        ("optimizers.offsets.final_lr", r"final_lr 0\.0 with lr 0\.01"),
        ("optimizers.offsets.lr", r"final_lr 0\.0001 with lr 0\.0"),
    ],
)
def test_a_schedule_with_an_end_at_zero_is_refused_at_the_key_to_blame(key, values):
    """A rate or weight would be 0 for the whole run."""
    with pytest.raises(
        InputError, match=rf"^`{key}=0`: {key}: {values}: a logarithmic schedule cannot reach or leave 0"
    ):
        load_method("coliags", [f"{key}=0"])


@pytest.mark.parametrize(
    ("name", "assignments", "message"),
    [
        *(("coliags", [text], text) for text in ("steps", "=3", "schedule..steps=3", "schedule.stepz=3")),
        ("colliags", [], "Did you mean 'coliags'"),
        *(("coliags", [f"optimizers.features.lr={text}"], "finite") for text in (".inf", "1e400")),
        *(("coliags", [f"losses.l1.weight={text}"], "finite") for text in (".nan", "1e400")),
        ("coliags", ["field.voxel_size=.inf"], "finite"),
        ("coliags", ['modules."a.b"=gain'], "letters, digits and underscores"),
        (
            "coliags",
            ["losses.l1.from_step=9", "losses.l1.until_step=5"],
            "until_step 5 does not come after from_step 9",
        ),
    ],
)
def test_bad_assignments_and_unknown_methods_are_named(name, assignments, message):
    with pytest.raises(InputError, match=message):
        load_method(name, assignments)


@pytest.mark.parametrize(
    ("text", "value"),
    [
        *(("1e-5", 1e-5), ("-3", -3), ("0.5", 0.5), ("true", True), ("null", None)),
        *(("[1, 2]", (1, 2)), ("on", "on"), ("a", "a")),
    ],
)
def test_scalars_are_read_as_yaml_1_2(text, value):
    assert parse_value(text) == value
    assert type(parse_value(text)) is type(value)
    assert parse_tree("", "x").plain() == {}


def test_a_component_without_settings_is_named(monkeypatch):
    monkeypatch.setitem(registry.losses._targets, "bare", object)
    monkeypatch.setitem(registry.losses._sources, "bare", "entry point x:Bare")
    with pytest.raises(InputError, match="'bare' from entry point x:Bare has no class attribute 'Settings'"):
        load_method("coliags", ["losses.extra=bare"])


# Settings and assignments: each is the other, exactly


numbers = st.floats(allow_nan=False)
plain = st.recursive(
    st.none() | st.booleans() | st.integers() | numbers | st.text(st.characters(exclude_categories=["C"]), max_size=8),
    lambda inner: (
        st.lists(inner, max_size=3).map(tuple)
        | st.dictionaries(st.text("abc1e.-_ ", min_size=1, max_size=6), inner, max_size=3)
    ),
    max_leaves=6,
)
paths = st.from_regex(r"[a-z_]{1,8}(\.[a-z_]{1,8}){0,2}", fullmatch=True)


#: Texts that would be read as something else.
LOOKING_LIKE_OTHERS = (*"1e5 1.5 on yes null ~ true [1] #1 1_000 0x1f 12:30".split(), "", " x ", "a: b")


@settings(max_examples=40, deadline=None)
@example({"a": LOOKING_LIKE_OTHERS} | {f"b.{chr(97 + index)}": text for index, text in enumerate(LOOKING_LIKE_OTHERS)})
@given(settings=st.dictionaries(paths, plain, max_size=4))
def test_settings_survive_as_texts(settings):
    parsed = parse_assignments(assignments(settings))
    assert parsed == settings and list(parsed) == list(settings)
    assert repr(parsed) == repr(settings)  # 1 is not 1.0, nor is True


def test_assignments_read_as_people_would_type_them():
    settings = {"field.voxel_size": 1e-3, "losses.depth": None, "split": "block", "offset": (1, 2.5)}
    texts = ("field.voxel_size=0.001", "losses.depth=null", "split=block", "offset=[1, 2.5]", "losses={l1: {name: l1}}")
    assert assignments({**settings, "losses": {"l1": {"name": "l1"}}}) == texts and assignments(None) == ()


def test_numbers_of_numpy_and_torch_and_paths_are_plain():
    settings = {"a": np.float32(0.5), "b": np.int64(3), "c": np.bool_(True), "d": Path("x/y"), "e": torch.tensor(2)}
    assert parse_assignments(assignments(settings)) == {"a": 0.5, "b": 3, "c": True, "d": "x/y", "e": 2}
    assert parse_assignments(assignments({"a": -math.inf})) == {"a": -math.inf}
    # Of a key that is there twice the last counts, in its place.
    assert list(parse_assignments(["a=1", "b=2", "a=3"]).items()) == [("b", 2), ("a", 3)]
    settings = {"field.geometry_head.frequencies": 7, 'optimizers."offsets".lr': 0.5, "losses.depth": None}
    config = load_method("coliags", assignments(settings)).config
    assert config.field.settings.geometry_head.settings.frequencies == 7
    assert config.optimizers["offsets"].lr == 0.5 and "depth" not in config.losses


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (["schedule.steps=5"], "values by key path"),
        ({3: 1}, "values by key path"),
        ({"a": object()}, "setting a is a object"),
        ({"a": {"b": [np.zeros(2)]}}, r"setting a\.b is a ndarray"),
    ],
)
def test_other_things_are_refused(settings, message):
    with pytest.raises(InputError, match=message):
        assignments(settings)
