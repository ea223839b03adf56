"""Runs the stages of a reconstruction one after the other, and leaves out those that are done."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from coliags_plugin.core.errors import InputError
from coliags_plugin.pipeline.record import Record, StageRecord
from coliags_plugin.reporting.numbers import duration

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Outcome:
    """What a stage has made.

    Attributes:
        summary: One line.
        files: Paths relative to the reconstruction's folder, and what each is.
    """

    summary: str
    files: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Stage:
    """A step of a reconstruction. It reads what earlier stages wrote, and can be repeated after a kill.

    Attributes:
        name: As the record and messages call it.
        options: All that it depends on apart from the stages before it, as JSON.
        run: Does it, replacing what an attempt that was killed has left, or going on with that.
        outputs: Files and folders that it writes, relative to the reconstruction's folder.
    """

    name: str
    options: Mapping[str, Any]
    run: Callable[[], Outcome]
    outputs: Sequence[str] = ()


def run_stages(stages: Sequence[Stage], record: Record, overwrite: bool = False) -> None:
    """Run the stages that are not done.

    A stage that was begun with other options is an error, or with ``overwrite`` removed and repeated, along with those
    after it. The options of one that failed may change.

    Args:
        stages: In order.
        record: Of what is done; kept up to date.
        overwrite: Remove what other options made.

    Raises:
        InputError: See above; or a stage cannot be done: the message says which, and what stands.
    """
    _check_options(stages, record, overwrite)
    for number, stage in enumerate(stages, start=1):
        title = f"[{number}/{len(stages)}] {stage.name}"
        known = record.stages.get(stage.name)
        if known is not None and known.state == "done":
            log.info("%s: done before: %s", title, known.summary)
            continue
        log.info("%s%s", title, "" if known is None else ": begun before")
        record.put(stage.name, StageRecord(_plain(stage.options)))
        began = time.monotonic()
        try:
            made = stage.run()
        except InputError as error:
            record.put(stage.name, replace(record.stages[stage.name], state="failed"))
            raise _failed(error, stage, stages[: number - 1]) from error
        except KeyboardInterrupt:
            log.info("%s: interrupted; the same command goes on from here", title)
            raise
        seconds = time.monotonic() - began
        ended = replace(
            record.stages[stage.name],
            state="done",
            summary=made.summary,
            seconds=round(seconds, 1),
            files=dict(made.files),
        )
        record.put(stage.name, ended)
        log.info("%s: %s; took %s", title, made.summary, duration(seconds))


def _check_options(stages: Sequence[Stage], record: Record, overwrite: bool) -> None:
    """Refuse, or remove, what was made with other options."""
    for place, stage in enumerate(stages):
        known = record.stages.get(stage.name)
        if known is None or known.options == _plain(stage.options):
            continue
        if not overwrite and known.state != "failed":
            raise InputError(
                f"{record.folder}: stage {stage.name} was made with {_differences(known.options, stage.options)}",
                "the options that it was begun with",
                f"Choose another --out, or pass --overwrite to repeat {stage.name} and what follows it",
            )
        later = stages[place:]
        record.forget([other.name for other in later], [output for other in later for output in other.outputs])
        return


def _differences(before: Mapping[str, Any], now: Mapping[str, Any]) -> str:
    """The first differing option, with both values."""
    old, new = dict(_leaves(before)), dict(_leaves(_plain(now)))
    name = next(key for key in [*old, *new] if old.get(key) != new.get(key))
    return f"{name} {old.get(name)}, not {new.get(name)}"


def _leaves(values: Mapping[str, Any], prefix: str = "") -> list[tuple[str, Any]]:
    found: list[tuple[str, Any]] = []
    for key, value in values.items():
        found += _leaves(value, f"{prefix}{key}.") if isinstance(value, Mapping) else [(f"{prefix}{key}", value)]
    return found


def _plain(value: Any) -> Any:
    """The value as it is read back from JSON."""
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    return str(value) if isinstance(value, Path) else value


def _failed(error: InputError, stage: Stage, before: Sequence[Stage]) -> InputError:
    """The error of a stage, with what stands."""
    done = ", ".join(other.name for other in before)
    stands = f"{done} {'stand' if len(before) > 1 else 'stands'}: the same command goes on from there" if done else ""
    advice = ". ".join(part.rstrip(".") for part in (error.do, stands) if part)
    return InputError(f"stage {stage.name}: {error.seen}", error.expected, advice)
