"""Worker process of a reconstruction: runs the stages of one part.

    python -m coliags_plugin.pipeline.worker TASK

TASK is a :class:`PartTask` as JSON.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from coliags_plugin.core.locks import locked
from coliags_plugin.execution.tasks import Task, TaskOutcome
from coliags_plugin.execution.worker import attempt, run_worker
from coliags_plugin.pipeline.context import StageContext
from coliags_plugin.pipeline.settings import ReconstructionSettings
from coliags_plugin.pipeline.stages import LOCK_FILE, LOCK_SECONDS, Part, Record, part_name, run_stages


@dataclass(frozen=True, kw_only=True)
class PartTask(Task):
    """The stages of one part of a reconstruction."""

    worker: ClassVar[str] = "coliags_plugin.pipeline.worker"
    source: str
    out: str
    settings: str  # JSON
    mask: str | None
    data_format: str | None
    part: Part


def work(task: PartTask) -> TaskOutcome:
    """Run the stages that are not done."""
    return attempt(task.title, task.out, lambda: complete(task))


def complete(task: PartTask) -> None:
    """Run the stages that are not done.

    Raises:
        InputError: One cannot be done; what it says is in the record, too.
    """
    import torch

    from coliags_plugin.engine.devices import choose_device
    from coliags_plugin.pipeline.chain import stages_of

    torch.set_num_threads(task.threads)
    settings = ReconstructionSettings.model_validate_json(task.settings, strict=False)  # of lists
    mask, out = None if task.mask is None else Path(task.mask), Path(task.out)
    device = choose_device(task.device)
    context = StageContext(out, Path(task.source), settings, mask, task.data_format, device)
    name = part_name(task.part)
    with locked(out / f"{LOCK_FILE}-{name}", out, LOCK_SECONDS):
        record = Record.of(out, name)
        record.places = context.places
        failure = run_stages(stages_of(context), record, plan=lambda: stages_of(context), parts={task.part})
        if failure is not None:
            raise failure


if __name__ == "__main__":
    run_worker(lambda text: work(PartTask.from_json(text)))
