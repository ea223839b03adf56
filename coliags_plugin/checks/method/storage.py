"""Checks of checkpoints: reading back, repeating and resuming to the same bits, and refusal of what does not fit."""

from __future__ import annotations

from dataclasses import replace

from coliags_plugin.checks.method.bench import CPU, Bench, as_in_new_process, difference
from coliags_plugin.checks.method.results import CheckFailedError
from coliags_plugin.checks.method.views import same_views
from coliags_plugin.core.errors import InputError
from coliags_plugin.engine.checkpoints import Checkpoint, restore_model
from coliags_plugin.engine.trained import load_trained
from coliags_plugin.engine.trainer import Trainer


def loads(bench: Bench) -> str:
    """The run read back from its folder renders the same bits."""
    bench.trained = load_trained(bench.trainer.run.path, CPU, bench.data)
    frames = bench.scene.train[:2]
    apart = same_views(bench.trainer.model.eval(), bench.trained.model, frames)
    if apart:
        raise CheckFailedError(
            f"the run read back renders otherwise: {apart}; what changes in training must be a parameter or a buffer, "
            "and from_state must restore it"
        )
    return f"{len(frames)} frames render the same bits"


def repeats(bench: Bench) -> str:
    """A second run with the same seed has the same bits half-way."""
    with as_in_new_process():
        second = bench.build("halves")
        second.start()
        for _ in range(bench.half):
            second.take_step()
        second.save()
    apart = _apart(bench.saved(bench.trainer, bench.half), bench.saved(second, bench.half))
    if apart:
        raise CheckFailedError(
            f"two runs of {bench.half} steps from one seed: {apart}; random numbers must come from the generators given"
        )
    return f"{bench.half} steps to the same bits"


def resumes(bench: Bench) -> str:
    """Stopped half-way and resumed, a run ends in the bits of one that was not."""
    with as_in_new_process():
        resumed = bench.build("halves")
        resumed.resume()
        resumed.train()
    apart = _apart(bench.saved(bench.trainer, bench.steps), bench.saved(resumed, bench.steps))
    if apart:
        raise CheckFailedError(
            f"{bench.half} steps, resumed for {bench.steps - bench.half}: {apart}; what decides on the steps to come "
            "must be in parameters, buffers, counters or the generators given"
        )
    return f"{bench.half} + {bench.steps - bench.half} steps end in the bits of {bench.steps}"


def _apart(first: Checkpoint, second: Checkpoint) -> str:
    """What differs between two checkpoints; empty where nothing does."""
    if first.queue != second.queue:
        return "the sampler plans other frames"
    return difference(dict(first.tensors), dict(second.tensors))


def continues_alike(first: Trainer, second: Trainer, bench: Bench) -> str:
    """What differs between two runs at their ends, both in hand; empty where nothing does."""
    for trainer in (first, second):
        while trainer.step < trainer.steps:
            trainer.take_step()
        trainer.save()
    return _apart(bench.saved(first, first.steps), bench.saved(second, second.steps))


def refuses_checkpoints(bench: Bench) -> str:
    """A run of another method is refused, and a checkpoint that lacks a parameter."""
    stranger = bench.build("run", method=replace(bench.loaded, name=f"not-{bench.loaded.name}"))
    try:
        stranger.resume()
    except InputError:
        pass
    else:
        raise CheckFailedError("a run of another method was resumed")
    saved = bench.saved(bench.trainer, bench.steps)
    names = [name for name, _ in bench.trainer.model.field.named_parameters()]
    for name in names:
        rest = {key: value for key, value in saved.tensors.items() if key != f"field/{name}"}
        try:
            restore_model(replace(saved, tensors=rest), bench.loaded.config, bench.scene, bench.trainer.chosen.renderer)
        except InputError:
            continue
        except Exception as error:
            raise CheckFailedError(
                f"from_state without '{name}': {type(error).__name__} instead of KeyError or RuntimeError: {error}"
            ) from error
        raise CheckFailedError(f"a checkpoint without the field's '{name}' was read")
    return f"another method's, and without any of {len(names)} parameters: refused"
