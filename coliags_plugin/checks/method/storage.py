"""Checks of checkpoints: reading back, repeating and resuming to the same bits, and refusal of what does not fit."""

from __future__ import annotations

from dataclasses import replace

from coliags_plugin.checks.method.context import CPU, CheckContext, as_in_new_process, difference
from coliags_plugin.checks.method.rendering import same_views
from coliags_plugin.checks.results import CheckFailedError
from coliags_plugin.core.errors import InputError
from coliags_plugin.engine.checkpoints import Checkpoint, restore_model
from coliags_plugin.engine.trained import load_trained
from coliags_plugin.engine.trainer import Trainer


def loads(context: CheckContext) -> str:
    """The run read back from its folder renders the same bits."""
    context.trained = load_trained(context.trainer.run.path, CPU, context.data)
    frames = context.scene.train[:2]
    apart = same_views(context.trainer.model.eval(), context.trained.model, frames)
    if apart:
        raise CheckFailedError(
            f"the run read back renders otherwise: {apart}; what changes in training must be a parameter or a buffer, "
            "and from_state must restore it"
        )
    return f"{len(frames)} frames render the same bits"


def repeats(context: CheckContext) -> str:
    """A second run with the same seed has the same bits half-way."""
    with as_in_new_process():
        second = context.build("halves")
        second.start()
        for _ in range(context.half):
            second.take_step()
        second.save()
    apart = _apart(context.saved(context.trainer, context.half), context.saved(second, context.half))
    if apart:
        raise CheckFailedError(
            f"two runs of {context.half} steps from one seed: {apart}; random numbers must come from the generators "
            "given"
        )
    return f"{context.half} steps to the same bits"


def resumes(context: CheckContext) -> str:
    """Stopped half-way and resumed, a run ends in the bits of one that was not."""
    with as_in_new_process():
        resumed = context.build("halves")
        resumed.resume()
        resumed.train()
    apart = _apart(context.saved(context.trainer, context.steps), context.saved(resumed, context.steps))
    if apart:
        raise CheckFailedError(
            f"{context.half} steps, resumed for {context.steps - context.half}: {apart}; what decides on the steps to "
            "come must be in parameters, buffers, counters or the generators given"
        )
    return f"{context.half} + {context.steps - context.half} steps end in the bits of {context.steps}"


def _apart(first: Checkpoint, second: Checkpoint) -> str:
    """What differs between two checkpoints; empty where nothing does."""
    if first.frame_queue != second.frame_queue:
        return "the sampler plans other frames"
    return difference(dict(first.tensors), dict(second.tensors))


def continues_alike(first: Trainer, second: Trainer, context: CheckContext) -> str:
    """What differs between two runs at their ends, both in hand; empty where nothing does."""
    for trainer in (first, second):
        while trainer.step < trainer.steps:
            trainer.take_step()
        trainer.save()
    return _apart(context.saved(first, first.steps), context.saved(second, second.steps))


def refuses_checkpoints(context: CheckContext) -> str:
    """A run of another method is refused, and a checkpoint that lacks a parameter."""
    stranger = context.build("run", method=replace(context.loaded, name=f"not-{context.loaded.name}"))
    try:
        stranger.resume()
    except InputError:
        pass
    else:
        raise CheckFailedError("a run of another method was resumed")
    saved = context.saved(context.trainer, context.steps)
    names = [name for name, _ in context.trainer.model.field.named_parameters()]
    config, renderer = context.loaded.config, context.trainer.chosen.renderer
    for name in names:
        rest = {key: value for key, value in saved.tensors.items() if key != f"field/{name}"}
        try:
            restore_model(replace(saved, tensors=rest), config, context.scene, renderer)
        except InputError:
            continue
        except Exception as error:
            raise CheckFailedError(
                f"from_state without '{name}': {type(error).__name__} instead of KeyError or RuntimeError: {error}"
            ) from error
        raise CheckFailedError(f"a checkpoint without the field's '{name}' was read")
    return f"another method's, and without any of {len(names)} parameters: refused"
