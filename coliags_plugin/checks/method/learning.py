"""Checks of training: finite numbers, terms that count, gradients that arrive, and an error that falls."""

from __future__ import annotations

import json
import math

import torch

from coliags_plugin.checks.method.context import CheckContext, as_in_new_process
from coliags_plugin.checks.results import CheckFailedError
from coliags_plugin.config.method_config import OptimizerSettings
from coliags_plugin.core.masked import masked_mean
from coliags_plugin.core.scenes import Frame
from coliags_plugin.engine.trainer import Trainer

#: Training frames whose error is measured, and pixels of each where the method trains on pixels.
_FRAMES, _PIXELS = 8, 256


def trains(context: CheckContext) -> str:
    """A whole run ends, all its losses and parameters being finite."""
    with as_in_new_process():
        trainer = context.build("run")
        trainer.start()
        trainer.train()
    context.trainer = trainer
    context.rows = [json.loads(line) for line in trainer.run.log_file.read_text(encoding="utf-8").splitlines()]
    spoilt = [name for name, value in trainer.model.named_parameters() if not torch.isfinite(value).all()]
    if spoilt:
        raise CheckFailedError(f"after {context.steps} steps these are not finite: {', '.join(spoilt)}")
    rate = context.steps / max(trainer.seconds, 1e-6)
    return f"{context.steps} steps, {rate:.0f} a second, loss {context.rows[-1]['loss']:.4g} at the last"


def inactive_terms(context: CheckContext) -> list[str]:
    """Loss terms that no step of the run counted."""
    return [key for key in context.loaded.config.losses if not any(key in row["terms"] for row in context.rows)]


def every_term_counts(context: CheckContext) -> str:
    """Every loss term is active at some step of the run."""
    losses, written_for = context.trainer.losses, context.loaded.config.schedule.written_for
    idle = inactive_terms(context)
    if idle:
        told = ", ".join(f"'{key}' (after step {losses[key].settings.from_step} of {written_for})" for key in idle)
        raise CheckFailedError(f"never active in {context.steps} steps: {told}; see from_step, or check more --steps")
    first = {key: next(row["step"] for row in context.rows if key in row["terms"]) for key in losses}
    return ", ".join(key if step == 1 else f"{key} from step {step}" for key, step in first.items())


def error_falls(context: CheckContext) -> str:
    """Training brings the rendered training images closer to the recorded ones."""
    with as_in_new_process():
        before = _error(context.build("before"))
    after = _error(context.trainer)
    change = f"mean colour error {before:.4f} before and {after:.4f} after {context.steps} steps"
    if not (math.isfinite(before) and after < before):
        raise CheckFailedError(f"{change}: it should fall")
    return change


@torch.no_grad()
def _error(trainer: Trainer) -> float:
    """Mean absolute colour error over some training frames, as the sampler would render them."""
    frames = trainer.scene.train[:: max(1, len(trainer.scene.train) // _FRAMES)][:_FRAMES]
    return sum(_frame_error(trainer, frame) for frame in frames) / len(frames)


def _frame_error(trainer: Trainer, frame: Frame) -> float:
    pixels, target = None, frame.target
    if not trainer.sampler.whole_images:
        count = frame.camera.width * frame.camera.height
        index = torch.arange(0, count, max(1, count // _PIXELS))
        pixels = torch.stack([index % frame.camera.width, index // frame.camera.width], dim=1)
        target = frame.target_at(pixels)
    rgb = trainer.model.render(frame.camera, view=frame.view(trained=True), pixels=pixels).rgb
    return float(masked_mean((rgb - target.rgb).abs(), target.mask))


def gradients_arrive(context: CheckContext) -> str:
    """Every parameter group that is to be trained gets a gradient at some step."""
    optimizers = context.trainer.optimizers
    without = [name for name, adam in optimizers.adam.items() if not _moved(adam)]
    frozen = [name for name in without if _is_frozen(context, name)]
    idle = [name for name in without if name not in frozen]
    remarks = [f"{', '.join(frozen)} frozen"] if frozen else []
    if idle and not inactive_terms(context):
        raise CheckFailedError(
            f"no gradient but 0 in {context.steps} steps: {', '.join(idle)}; nothing that the losses see depends on "
            "it, or its part is detached or begins later (then check more --steps)"
        )
    if idle:
        remarks.append(f"{', '.join(idle)} not yet active")
    return "; ".join([f"{len(optimizers.adam) - len(without)} of {len(optimizers.adam)} groups", *remarks])


def _moved(adam: torch.optim.Optimizer) -> bool:
    """Whether Adam has seen a gradient other than 0."""
    return any(bool(state["exp_avg_sq"].any()) for state in adam.state.values() if "exp_avg_sq" in state)


def _is_frozen(context: CheckContext, group: str) -> bool:
    settings: OptimizerSettings = context.loaded.config.optimizers[group]
    parameters = context.trainer.model.parameter_groups()[group]
    return settings.lr == 0.0 or not any(parameter.requires_grad for parameter in parameters)
