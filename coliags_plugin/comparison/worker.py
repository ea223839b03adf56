"""Worker process of a comparison: trains and evaluates one cell.

    python -m coliags_plugin.comparison.worker TASK

TASK is a :class:`CellTask` as JSON.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from coliags_plugin.core.errors import InputError
from coliags_plugin.engine.run_folder import RunFolder
from coliags_plugin.engine.tasks import Task, run_worker

if TYPE_CHECKING:
    import torch

log = logging.getLogger(__name__)

#: Checkpoints kept during training: a second one in case the last is damaged.
_KEPT = 2
#: Largest time between two checkpoints, seconds.
_SAVE_SECONDS = 60.0


@dataclass(frozen=True, kw_only=True)
class CellTask(Task):
    """One cell of a comparison, whose run is in its folder; its key is the one that the result must have."""

    name: str  # of the method, in tables
    method: str  # name or path of the method config
    overrides: tuple[str, ...]  # ``key.path=value`` changes of it
    scene: str  # name of the scene, in tables
    data: Path
    data_format: str | None
    seed: int
    protocol: str
    result: Path  # where the results file goes
    lock_seconds: float = 120.0  # how long to wait for another process that has the run

    def complete(self) -> None:
        """Train, evaluate and write the results file, as far as that has not been done."""
        from coliags_plugin.engine import evaluator
        from coliags_plugin.engine.devices import choose_device
        from coliags_plugin.engine.trained import load_trained
        from coliags_plugin.results.reading import RESULT_FILE, read_result, write_result

        run = RunFolder(self.folder)
        with run.owned(self.lock_seconds):
            device = choose_device(self.device)
            self._train(run, device)
            file = run.evaluation(self.protocol) / RESULT_FILE
            result = read_result(file) if file.is_file() else None
            if result is None or result.key != self.key:
                trained = load_trained(run.path, device, self.data)
                trained = replace(trained, scene=replace(trained.scene, name=self.scene))
                result = evaluator.evaluate(trained, self.protocol)
            if result.key != self.key:
                raise InputError(
                    f"{file} has the key {result.key}", f"{self.key}", "Method or scene changed meanwhile: start again"
                )
            write_result(self.result, result)

    def _train(self, run: RunFolder, device: torch.device) -> None:
        """Train to the last step, from where the run is."""
        import cv2
        import torch

        from coliags_plugin.config.options import TrainOptions
        from coliags_plugin.engine.checkpoints import keep_newest, take_newest
        from coliags_plugin.engine.trainer import open_training

        threads = self.threads
        if run.config_file.is_file():
            saved = take_newest(run.checkpoints, self.name, torch.device("cpu"))
            if saved is not None and saved.step == run.method().config.schedule.steps:
                log.info("trained: %d steps", saved.step)
                return
            threads = int(run.provenance().get("threads", threads))
        torch.set_num_threads(threads)
        cv2.setNumThreads(threads)
        options = TrainOptions(
            self.method, self.data, seed=self.seed, settings=self.overrides, data_format=self.data_format
        )
        names = {"run_name": self.name, "scene_name": self.scene, "protocol": self.protocol}
        with open_training(options, run, device, "continue", owned=True, **names) as trainer:
            log.info("training from step %d of %d on %d threads", trainer.step, trainer.steps, threads)
            trainer.train(_SAVE_SECONDS, _KEPT)
        keep_newest(run.checkpoints, 1)


if __name__ == "__main__":
    run_worker(CellTask)
