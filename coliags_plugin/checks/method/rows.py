"""Check of a strategy: parameters, Adam's moments, buffers and counters change their rows together."""

from __future__ import annotations

import shutil
from itertools import pairwise

from coliags_plugin.checks.method.context import CheckContext, as_in_new_process
from coliags_plugin.checks.method.storage import continues_alike
from coliags_plugin.checks.results import CheckFailedError, CheckSkippedError
from coliags_plugin.core.settings import Settings
from coliags_plugin.engine.trainer import Trainer


def keeps_rows_together(context: CheckContext) -> str:
    """Rows change together at every event, and a run resumed right after one ends in the same bits."""
    node = context.loaded.config.strategy
    if node.target.serves is None:
        raise CheckSkippedError(f"strategy '{node.name}' changes no rows")
    written_for = context.loaded.config.schedule.written_for
    method = context.load(_spread_out(node.settings, context.steps, written_for))
    with as_in_new_process():
        trainer = context.build("events", method=method)
        trainer.start()
        before = start = _Census(trainer)
        if not start.count:
            raise CheckFailedError(f"element_count of field '{context.loaded.config.field.name}' is 0: override it")
        counts = [start.count]
        while trainer.step < trainer.steps and start.count == before.count:
            before = _stepped(trainer, start, before)
            counts.append(before.count)
        if start.count == before.count:
            raise CheckSkippedError(f"no row came or went in {trainer.steps} steps ({trainer.strategy.plan()})")
        changed_at = trainer.step
        trainer.save()
        copy = context.folder / "events-resumed"
        shutil.copytree(trainer.run.path, copy, dirs_exist_ok=True)
        while trainer.step < trainer.steps:
            before = _stepped(trainer, start, before)
            counts.append(before.count)
    with as_in_new_process():
        resumed = context.build(copy.name, method=method)
        resumed.resume()
        apart = continues_alike(trainer, resumed, context)
    if apart:
        raise CheckFailedError(f"resumed after the event of step {changed_at}: {apart}")
    events = sum(a != b for a, b in pairwise(counts))
    return f"{start.count} to {before.count} rows in {events} events; resumed after step {changed_at} to the same bits"


def _spread_out(settings: Settings, steps: int, written_for: int) -> list[str]:
    """Overrides with which a strategy has a few events in ``steps``, between which training goes on.

    Intervals, in steps of a run of ``written_for``, are the whole numbers among its options that are called ``every``
    or ``..._every``.
    """
    names = [name for name in type(settings).model_fields if name == "every" or name.endswith("_every")]
    given = {name: getattr(settings, name) for name in names if isinstance(getattr(settings, name), int)}
    shortest = min(given.values(), default=0)
    short = max(1, written_for // 5)
    return [f"strategy.{name}={short if every == shortest else 2 * short}" for name, every in given.items()]


class _Census:
    """Numbers of rows at one time: of the field, its groups of one parameter, its own buffers, and the counters.

    Buffers of the field's parts may be of another kind.
    """

    def __init__(self, trainer: Trainer) -> None:
        model = trainer.model
        self.count = model.field.element_count
        groups = {name: group for name, group in model.field.parameter_groups().items() if len(group) == 1}
        self.parameters = {name: len(group[0]) for name, group in groups.items() if group[0].ndim}
        self.buffers = {name: len(value) for name, value in model.field.named_buffers(recurse=False) if value.ndim}
        self.counters = {name: len(value) for name, value in trainer.strategy.state_dict().items() if value.ndim}


def _stepped(trainer: Trainer, start: _Census, before: _Census) -> _Census:
    """The numbers after one more step, having been compared."""
    done = trainer.take_step()
    now = _Census(trainer)
    said = f"step {done['step']}, {before.count} to {now.count} rows: "
    for group, parameters in trainer.model.parameter_groups().items():
        adam = trainer.optimizers.adam[group]
        if list(map(id, adam.param_groups[0]["params"])) != list(map(id, parameters)):
            raise CheckFailedError(
                f"{said}the optimizer of group '{group}' trains what is no longer the field's; change rows by "
                "ParameterRows alone"
            )
        for parameter in parameters:
            for key, value in adam.state.get(parameter, {}).items():
                if key.startswith("exp_avg") and value.shape != parameter.shape:
                    raise CheckFailedError(
                        f"{said}{key} of group '{group}' has shape {list(value.shape)}, its parameter "
                        f"{list(parameter.shape)}; change rows by ParameterRows alone"
                    )
    for kind, then, after in (
        ("parameter group", start.parameters, now.parameters),
        ("buffer", start.buffers, now.buffers),
    ):
        for name, length in then.items():
            if length == start.count and after[name] != now.count:
                raise CheckFailedError(f"{said}{kind} '{name}' has {after[name]}")
    for name, length in now.counters.items():
        per_row, rest = divmod(before.counters.get(name, 0), before.count)
        if per_row and not rest and length not in (0, per_row * now.count):
            raise CheckFailedError(f"{said}counter '{name}' of the strategy has {length}")
    return now
