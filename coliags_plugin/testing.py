"""The contract of a method, as a list of checks for plugin authors, pytest and ``coliags check method``.

A test module that checks a method of your own:

    @pytest.fixture(scope="module")
    def context(tmp_path_factory):
        return testing.CheckContext("my-method", tmp_path_factory.mktemp("check"))


    @pytest.mark.parametrize("check", testing.METHOD_CHECKS)
    def test_the_contract(check, context):
        context.run(check)
"""

from __future__ import annotations

import math
import shutil
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import torch
from pydantic import ValidationError
from pydantic_core import PydanticCustomError
from torch import Tensor

from coliags_plugin.checks.method import CPU, CheckContext, components, difference, name_of_check
from coliags_plugin.checks.results import CheckFailedError, CheckSkippedError, fail_if
from coliags_plugin.config.method_config import LoadedMethod, load_method
from coliags_plugin.config.options import RenderOptions
from coliags_plugin.core.cameras import Camera
from coliags_plugin.core.components import make_component
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.render_output import DEPTH_KINDS
from coliags_plugin.core.scenes import Frame, PointCloud, Scene, View
from coliags_plugin.core.settings import Settings
from coliags_plugin.core.tensors import masked_mean
from coliags_plugin.engine.checkpoints import restore_model
from coliags_plugin.engine.evaluator import evaluate
from coliags_plugin.engine.model import Model
from coliags_plugin.engine.rendering import render_run
from coliags_plugin.engine.trained import TrainedRun, load_trained
from coliags_plugin.engine.trainer import Trainer

__all__ = ["METHOD_CHECKS", "CheckContext", "CheckFailedError", "CheckSkippedError", "name_of_check"]

#: An option, and an output, that nothing has.
_NO_OPTION, _NO_OUTPUT = "no_such_option", "no_such_output"
#: Training frames whose error is measured, and pixels of each where the method trains on pixels.
_FRAMES, _PIXELS = 8, 256
#: Frames of each test set that are evaluated and rendered.
_TEST_FRAMES = 2
#: Alpha from which a pixel has a depth.
_OPAQUE = 0.95
#: Depth may leave the range of the scene by this factor: a model is not good yet after a few steps.
_MARGIN = 10.0
_ROUNDING = 1e-4
#: Steps on other data.
_STEPS = 2


# Config and model


def check_resolves(context: CheckContext) -> LoadedMethod:
    """The config is valid, and the same when it is written to YAML and read again."""
    config, path = context.loaded.config, context.folder / "resolved.yaml"
    path.write_text(config.to_yaml(), encoding="utf-8")
    again = load_method(str(path.resolve())).config
    changed = [name for name in type(config).model_fields if getattr(again, name) != getattr(config, name)]
    if changed or again.to_yaml() != config.to_yaml():
        raise CheckFailedError(f"written to YAML and read again, it has another {', '.join(changed) or 'text'}")
    return context.loaded


def check_options(context: CheckContext) -> None:
    """Every component refuses an option that it does not have, by name."""
    for path, component in components(context.result_of(check_resolves).config).items():
        options = {"name": component.name, **component.settings.model_dump(), _NO_OPTION: 1}
        what = f"{path}.{_NO_OPTION}=1 (are the Settings of '{component.name}' a subclass of core.settings.Settings?)"
        error = _refused(what, partial(make_component, component.kind, options), ValidationError, PydanticCustomError)
        if _NO_OPTION not in str(error):
            raise CheckFailedError(f"{path}.{_NO_OPTION}=1 is refused without being named: {error}") from error


def _refused(what: str, attempt: Callable[[], object], *expected: type[Exception]) -> Exception:
    """The error with which something is refused; another exception, or none, is a fault."""
    try:
        attempt()
    except expected as error:
        return error
    except Exception as error:
        names = " or ".join(kind.__name__ for kind in expected)
        raise CheckFailedError(f"{what}: {type(error).__name__} instead of {names}: {error}") from error
    raise CheckFailedError(f"{what}: not refused")


def check_builds(context: CheckContext) -> None:
    """The components fit one another and the scene; nothing is written yet."""
    context.result_of(check_resolves)
    if context.build("built").run.path.exists():
        raise CheckFailedError("the run folder was written before training began")


def check_groups(context: CheckContext) -> None:
    """Every trainable parameter is in exactly one parameter group, which an optimizer trains."""
    context.result_of(check_builds)
    model = context.build("groups").model
    groups, named = model.parameter_groups(), dict(model.named_parameters())
    counts = Counter(id(parameter) for group in groups.values() for parameter in group)
    strangers = counts.keys() - set(map(id, named.values()))
    ungrouped = [name for name, value in named.items() if value.requires_grad and not counts[id(value)]]
    foreign = [name for name, group in groups.items() if strangers.intersection(map(id, group))]
    fail_if(ungrouped, "in no parameter group, so never trained")
    fail_if([name for name, value in named.items() if counts[id(value)] > 1], "in more than one parameter group")
    fail_if([name for name, group in groups.items() if not group], "empty parameter groups")
    fail_if(foreign, "parameter groups that hold a parameter that is no attribute of the model")


# Training


def check_trains(context: CheckContext) -> Trainer:
    """A whole run ends, and all its losses and parameters are finite."""
    context.result_of(check_builds)
    trainer = context.build("run")
    trainer.start()
    trainer.train()
    spoilt = [name for name, value in trainer.model.named_parameters() if not torch.isfinite(value).all()]
    fail_if(spoilt, f"after {context.steps} steps these are not finite")
    return trainer


def _idle_terms(trainer: Trainer) -> list[str]:
    """Loss terms that no step of a run counted."""
    active = {key for row in trainer.run.log_rows() for key in row["terms"]}
    return [key for key in trainer.losses if key not in active]


def check_terms(context: CheckContext) -> None:
    """Every loss term is active at some step of the run."""
    trainer, written_for = context.result_of(check_trains), context.loaded.config.schedule.written_for
    idle = [
        f"'{key}' (after step {trainer.losses[key].settings.from_step} of {written_for}); see from_step, or check more "
        "`steps`"
        for key in _idle_terms(trainer)
    ]
    fail_if(idle, f"never active in {context.steps} steps")


def check_learns(context: CheckContext) -> None:
    """Training brings the rendered training images closer to the recorded ones."""
    after, before = _error(context.result_of(check_trains)), _error(context.build("before"))
    if not (math.isfinite(before) and after < before):
        raise CheckFailedError(
            f"mean colour error {before:.4f} before and {after:.4f} after {context.steps} steps: it should fall"
        )


@torch.no_grad()
def _error(trainer: Trainer) -> float:
    """Mean absolute colour error over some training frames, as the sampler would render them."""
    errors = []
    for frame in trainer.scene.train[:: max(1, len(trainer.scene.train) // _FRAMES)][:_FRAMES]:
        pixels, target = None, frame.target
        if not trainer.sampler.whole_images:
            pixels = _some_pixels(frame.camera, max(1, frame.camera.width * frame.camera.height // _PIXELS))
            target = frame.target_at(pixels)
        rgb = trainer.model.render(frame.camera, view=frame.view(trained=True), pixels=pixels).rgb
        errors.append(float(masked_mean((rgb - target.rgb).abs(), target.mask)))
    return sum(errors) / len(errors)


def _some_pixels(camera: Camera, every: int) -> Tensor:
    index = torch.arange(0, camera.width * camera.height, every)
    return torch.stack([index % camera.width, index // camera.width], dim=1)


def check_gradients(context: CheckContext) -> None:
    """Every parameter group that is to be trained gets a gradient at some step."""
    trainer = context.result_of(check_trains)
    groups, rates = trainer.model.parameter_groups(), context.loaded.config.optimizers
    idle = [
        name
        for name, adam in trainer.optimizers.adam.items()
        if not any("exp_avg_sq" in state and state["exp_avg_sq"].any() for state in adam.state.values())
        and rates[name].lr != 0.0
        and any(parameter.requires_grad for parameter in groups[name])
    ]
    if idle and not _idle_terms(trainer):
        raise CheckFailedError(
            f"no gradient but 0 in {context.steps} steps: {', '.join(idle)}; nothing that the losses see depends on "
            "it, or its part is detached or begins later (then check more `steps`)"
        )


# Rendering


def check_renders(context: CheckContext) -> Trainer:
    """Every output has its shape and finite values in range, for views of the video, another size and a free camera."""
    trainer, frame = context.result_of(check_trains), context.scene.train[0]
    small, train = _resized(frame.camera), context.scene.train
    known = [frame.depth[frame.depth.isfinite()] for frame in train[:4] if frame.depth is not None]
    z = torch.cat(known) if known else context.scene.depths_in_view()
    depths = (float(z.min()), float(z.max())) if len(z) else None
    views: dict[str, tuple[Camera, View | None]] = {
        "a training view": (frame.camera, frame.view(trained=True)),
        "an untrained view": (frame.camera, replace(frame.view(trained=False), name="no such frame", time=0.5)),
        "another size": (small, frame.view(trained=True)),
        "a free camera": (small, None),
    }
    for what, (camera, view) in views.items():
        fault = _wrong(_maps(trainer.model, camera, view), trainer.model, camera, depths)
        fail_if(fault, f"{what} of {camera.width} x {camera.height} pixels")
    return trainer


def _resized(camera: Camera) -> Camera:
    """The camera with fewer pixels, an odd number of them, over the same field of view."""
    return camera.resized(*(max(1, int(0.35 * side)) * 2 + 1 for side in (camera.width, camera.height)))


@torch.no_grad()
def _maps(model: Model, camera: Camera, view: View | None, pixels: Tensor | None = None) -> dict[str, Tensor]:
    output = model.render(camera, sorted(model.outputs), view, pixels)
    return {"rgb": output.rgb, "alpha": output.alpha, **output.maps}


def _wrong(maps: dict[str, Tensor], model: Model, camera: Camera, depths: tuple[float, float] | None) -> str:
    """The first fault of the outputs of a view; empty without."""
    size = (camera.height, camera.width)
    channels: dict[str, tuple[int, ...]] = {"rgb": (3,), "normals": (3,), **dict.fromkeys(("alpha", *DEPTH_KINDS), ())}
    for name in sorted(model.outputs):
        if name not in maps:
            return f"{name} is promised by `outputs` and not delivered"
        shape, expected = tuple(maps[name].shape), (*size, *channels.get(name, ("C",)))  # a field's own: however many
        if shape[:2] != size or (name in channels and shape != expected):
            return f"{name} has shape {list(shape)}, not [{', '.join(map(str, expected))}]"
        spoilt = int((~torch.isfinite(maps[name])).sum())
        if spoilt:
            return f"{name} has {spoilt} numbers that are not finite"
    alpha = maps["alpha"]
    if alpha.min() < -_ROUNDING or alpha.max() > 1.0 + _ROUNDING:
        return f"alpha is between {float(alpha.min()):.4g} and {float(alpha.max()):.4g}, not within [0, 1]"
    for name in sorted(model.outputs & set(DEPTH_KINDS)):
        depth = maps[name][alpha > _OPAQUE]
        z = 1.0 / depth if name.startswith("inverse") else depth
        if depths is None or not len(z):
            continue
        # Surfels seen edge-on may be far beyond at single pixels (docs/rivals/2dgs.md).
        low, high = torch.quantile(z, z.new_tensor([0.01, 0.99])).tolist()
        if not (low >= depths[0] / _MARGIN and high <= depths[1] * _MARGIN):
            return (
                f"z of {name} is between {low:.4g} and {high:.4g} at 98 % of the pixels with alpha > {_OPAQUE}, and "
                f"the scene lies between z = {depths[0]:.4g} and {depths[1]:.4g}"
            )
    return ""


def check_renders_again(context: CheckContext) -> Trainer:
    """Rendering a view twice gives the same bits, with another view in between."""
    trainer, frame = context.result_of(check_renders), context.scene.train[0]
    view = frame.view(trained=True)
    first = _maps(trainer.model, frame.camera, view)
    _maps(trainer.model, _resized(frame.camera), None)
    again = _maps(trainer.model, frame.camera, view)
    fail_if(difference(first, again), f"two renderings of frame {frame.name}")
    return trainer


def check_pixels(context: CheckContext) -> None:
    """Single pixels are those of the whole image."""
    model, frame = context.result_of(check_renders_again).model, context.scene.train[0]
    if not model.renderer.renders_pixels:
        raise CheckSkippedError(f"{type(model.renderer).__name__} renders whole images")
    if any(module.whole_image for module in model.view_modules.values()):
        raise CheckSkippedError("a view module needs whole images")
    camera, view = _resized(frame.camera), frame.view(trained=True)
    pixels = _some_pixels(camera, 7)
    single = _maps(model, camera, view, pixels)
    for name, values in _maps(model, camera, view).items():
        expected, rendered = values[pixels[:, 1], pixels[:, 0]], single[name][:, 0]
        if rendered.shape != expected.shape or not torch.allclose(rendered, expected, rtol=1e-3, atol=1e-4):
            raise CheckFailedError(f"{name} of single pixels is not that of the whole image")


def check_requests(context: CheckContext) -> None:
    """An output that does not exist is refused, and so are single pixels by a renderer of whole images."""
    model, camera = context.result_of(check_renders).model, context.scene.train[0].camera
    by = f"by {type(model.renderer).__name__}"
    with torch.no_grad():
        _refused(f"output '{_NO_OUTPUT}' {by}", lambda: model.render(camera, ("rgb", _NO_OUTPUT)), InputError)
        if not model.renderer.renders_pixels:
            pixels = torch.tensor([[1, 2], [0, 0]])
            _refused(f"single pixels {by}", lambda: model.render(camera, pixels=pixels), InputError)


# Checkpoints


def check_loads(context: CheckContext) -> TrainedRun:
    """The run read back from its folder renders the same bits."""
    trainer = context.result_of(check_renders_again)
    trained = load_trained(trainer.run.path, CPU, context.data)
    models = (trainer.model.eval(), trained.model)
    for frame in context.scene.train[:2]:
        for view in (frame.view(trained=True), frame.view(trained=False)):
            fail_if(
                difference(*(_maps(model, frame.camera, view) for model in models)),
                f"the run read back renders otherwise: frame {frame.name}",
                "what changes in training must be a parameter or a buffer, and from_state must restore it",
            )
    return trained


def check_repeats(context: CheckContext) -> None:
    """A second run with the same seed has the same bits half-way."""
    first, second = context.result_of(check_renders_again), context.build("halves")
    second.start()
    while second.step < context.half:
        second.take_step()
    second.save()
    context.compare(first, second, context.half, f"two runs of {context.half} steps from one seed")


def check_resumes(context: CheckContext) -> None:
    """Stopped half-way and resumed, a run ends in the bits of one that was not."""
    context.result_of(check_loads)
    context.result_of(check_repeats)
    resumed = context.build("halves")
    resumed.resume()
    resumed.train()
    what = f"{context.half} steps, resumed for {context.steps - context.half}"
    context.compare(context.result_of(check_trains), resumed, context.steps, what)


def check_checkpoints(context: CheckContext) -> None:
    """A run of another method is refused, and a checkpoint that lacks a parameter."""
    trainer, loaded = context.result_of(check_trains), context.loaded
    stranger = context.build("run", method=replace(loaded, name=f"not-{loaded.name}"))
    _refused("a run of another method", stranger.resume, InputError)
    saved, renderer = context.saved(trainer, context.steps), trainer.chosen.renderer
    for name, _ in trainer.model.field.named_parameters():
        tensors = {key: value for key, value in saved.tensors.items() if key != f"field/{name}"}
        rest = replace(saved, tensors=tensors)
        read = partial(restore_model, rest, loaded.config, context.scene, renderer)
        _refused(f"a checkpoint without the field's '{name}'", read, InputError)


def check_rows(context: CheckContext) -> None:
    """Rows change together at every event, and a run resumed right after one ends in the same bits."""
    context.result_of(check_resumes)
    config = context.loaded.config
    if config.strategy.target.serves is None:
        raise CheckSkippedError(f"strategy '{config.strategy.name}' changes no rows")
    method = context.load(_spread_out(config.strategy.settings, config.schedule.written_for))
    trainer, copy, changed_at = context.build("events", method=method), context.folder / "events-resumed", 0
    trainer.start()
    if not trainer.model.field.element_count:
        raise CheckFailedError(f"element_count of field '{config.field.name}' is 0: override it")
    while trainer.step < trainer.steps:
        if _step_changes_rows(trainer) and not changed_at:
            changed_at = trainer.step
            trainer.save()
            shutil.copytree(trainer.run.path, copy, dirs_exist_ok=True)
    if not changed_at:
        raise CheckSkippedError(f"no row came or went in {trainer.steps} steps ({trainer.strategy.plan()})")
    trainer.save()
    resumed = context.build(copy.name, method=method)
    resumed.resume()
    resumed.train()
    context.compare(trainer, resumed, trainer.steps, f"resumed after the event of step {changed_at}")


def _spread_out(settings: Settings, written_for: int) -> list[str]:
    """Overrides with which a strategy has a few events in a run, between which training goes on.

    Intervals, in steps of a run of ``written_for``, are the whole numbers among its options that are called ``every``
    or ``..._every``.
    """
    names = [name for name in type(settings).model_fields if name == "every" or name.endswith("_every")]
    intervals = {name: getattr(settings, name) for name in names if isinstance(getattr(settings, name), int)}
    shortest, short = min(intervals.values(), default=0), max(1, written_for // 5)
    return [f"strategy.{name}={short if every == shortest else 2 * short}" for name, every in intervals.items()]


def _lengths(trainer: Trainer) -> dict[str, int]:
    """Lengths of parameters that are a group alone, of the field's buffers and of the strategy's counters."""
    field = trainer.model.field
    groups = field.parameter_groups().items()
    parts: dict[str, Tensor] = {f"parameter group '{name}'": group[0] for name, group in groups if len(group) == 1}
    parts |= {f"buffer '{name}'": value for name, value in field.named_buffers(recurse=False)}
    parts |= {f"counter '{name}' of the strategy": value for name, value in trainer.strategy.state_dict().items()}
    return {name: len(value) for name, value in parts.items() if value.ndim}


def _step_changes_rows(trainer: Trainer) -> bool:
    """Take a step, after which all that has rows has as many of them per element as before, or is an empty counter."""
    count, lengths = trainer.model.field.element_count, _lengths(trainer)
    trainer.take_step()
    new_count = trainer.model.field.element_count
    what, advice = f"step {trainer.step}, {count} to {new_count} rows", "change rows by ParameterRows alone"
    for group, parameters in trainer.model.parameter_groups().items():
        if list(map(id, trainer.optimizers.adam[group].param_groups[0]["params"])) != list(map(id, parameters)):
            fault = f"the optimizer of group '{group}' trains what is no longer the field's"
            raise CheckFailedError(f"{what}: {fault}; {advice}")
    try:
        trainer.optimizers.check_moments()
    except ValueError as error:
        raise CheckFailedError(f"{what}: {error}; {advice}") from error
    for name, length in _lengths(trainer).items():
        per_element, rest = divmod(lengths.get(name, 0), count)
        if per_element and not rest and length != per_element * new_count and (length or "counter" not in name):
            raise CheckFailedError(f"{what}: {name} has {length}")
    return new_count != count


# Evaluation and images


def check_evaluates(context: CheckContext) -> None:
    """The method's protocol yields finite metrics, or reasons for those that cannot be had."""
    trained = _few_frames(context)
    summary = evaluate(trained, trained.config.protocol).summary()
    metrics, reasons = {name: summary[name] for name in summary["directions"] if name in summary}, summary["reasons"]
    unexplained = [
        name for name, value in metrics.items() if not (reasons.get(name) if value is None else math.isfinite(value))
    ]
    fail_if(unexplained, "metrics without value or reason")
    if all(value is None for value in metrics.values()):
        raise CheckFailedError(f"no metric has a value: {next(iter(reasons.values()))}")


def check_images(context: CheckContext) -> None:
    """``coliags render`` writes an image of every kind for every frame."""
    trained, folder = _few_frames(context), context.folder / "renders"
    name, frames = next(iter(trained.scene.test_sets.items()))
    render_run(trained, RenderOptions(folder, (name,), video=False, overwrite=True))
    kinds = {"rgb", "depth", "rgb_error"} | ({"depth_error"} if frames[0].depth is not None else set())
    paths = [folder / kind / f"{frame.name}.png" for kind in sorted(kinds) for frame in frames]
    missing = [path for path in paths if not path.is_file() or not path.stat().st_size]
    fail_if([str(path.relative_to(folder)) for path in missing], "no image")


def _few_frames(context: CheckContext) -> TrainedRun:
    """The run with only a few test frames."""
    trained = context.result_of(check_loads)
    sets = {name: frames[:_TEST_FRAMES] for name, frames in trained.scene.test_sets.items() if frames}
    if not sets:
        raise CheckSkippedError("the scene holds out no test frames")
    return replace(trained, scene=replace(trained.scene, test_sets=sets))


# Scenes that lack something, and pixels that are to be ignored

_VARIANTS: dict[str, Callable[[Scene], Scene]] = {
    "without depth": lambda scene: replace(
        scene,
        train=[
            replace(frame.with_maps(depth=None, depth_at_least=None, depth_confidence=None), sparse_depth=None)
            for frame in scene.train
        ],
    ),
    "without points": lambda scene: replace(scene, points=PointCloud(torch.zeros(0, 3))),
    "with one frame": lambda scene: replace(scene, train=scene.train[:1]),
}


def check_other_data(context: CheckContext) -> None:
    """A scene without depth, without points or with one training frame is trained on, or refused beforehand."""
    context.result_of(check_trains)
    for what, change in _VARIANTS.items():
        begun = False
        try:
            trainer = context.build("elsewhere", change(context.scene))
            begun = True
            _take_steps(trainer)
        except InputError as error:
            if begun:
                raise CheckFailedError(f"{what}: refused only when training had begun: {error}") from error
        except Exception as error:
            raise CheckFailedError(
                f"{what}: {context.describe(error)}; expected training, or an InputError beforehand"
            ) from error


def check_ignored_pixels(context: CheckContext) -> None:
    """Masked pixels, NaN included, change no loss and no parameter."""
    context.result_of(check_repeats)
    runs: list[tuple[list[dict[str, Any]], dict[str, Tensor]]] = []
    for spoilt in (False, True):
        frames = [_masked(frame, spoilt) for frame in context.scene.train]
        trainer = context.build("masked", replace(context.scene, train=frames))
        runs.append((_take_steps(trainer), trainer.model.state_dict()))
    (rows, first), (spoilt_rows, second) = runs
    advice = "see coliags_plugin.core.tensors"
    for ours, theirs in zip(rows, spoilt_rows, strict=True):
        wrong = [key for key, value in ours["terms"].items() if theirs["terms"][key] != value]
        fail_if(wrong, "loss terms that depend on masked pixels", advice)
    fail_if(difference(first, second), "masked pixels change the model", advice)


def _masked(frame: Frame, spoilt: bool) -> Frame:
    """The frame with a part of its image masked out; ``spoilt``: there of other colours, and depth that is NaN."""
    height, width = frame.image.shape[:2]
    ignored = torch.zeros(height, width, dtype=torch.bool)
    ignored[height // 4 : height // 2, width // 4 : width // 2] = True
    masked = frame.with_maps(mask=frame.valid & ~ignored)
    if not spoilt:
        return masked
    depth = None if frame.depth is None else frame.depth.masked_fill(ignored, torch.nan)
    return masked.with_maps(image=torch.where(ignored[..., None], 255 - frame.image, frame.image), depth=depth)


def _take_steps(trainer: Trainer) -> list[dict[str, Any]]:
    return [trainer.take_step() for _ in range(min(_STEPS, trainer.steps))]


#: All functions above that are called ``check_...``, in their order; each raises where its docstring does not hold.
METHOD_CHECKS: tuple[Callable[[CheckContext], Any], ...] = tuple(
    value for name, value in list(globals().items()) if name.startswith("check_")
)
