"""Worker process of a comparison: trains and evaluates one cell.

    python -m coliags_plugin.comparison.worker TASK

TASK is a :class:`~coliags_plugin.comparison.tasks.Task` as JSON. The last line printed is its
:class:`~coliags_plugin.comparison.tasks.TaskOutcome`; messages go to standard error. When standard input is a pipe, the
worker stops when it is closed, with its state saved: so it ends with whatever started it, however that ends.
"""

from __future__ import annotations

import errno
import logging
import os
import signal
import stat
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from coliags_plugin.comparison.tasks import STOPPED, Task, TaskOutcome, outcome_line
from coliags_plugin.core.errors import InputError, InterruptedRunError, ReportedError
from coliags_plugin.engine.run_folder import RunFolder

if TYPE_CHECKING:
    import torch

log = logging.getLogger(__name__)

#: For a step, or what else cannot be interrupted, to end after the worker was asked to stop, seconds.
_GRACE = 30.0
#: Checkpoints kept during training: a second one in case the last is damaged.
_KEPT = 2


def main() -> None:
    """Work on the task of the command line and exit: 0, 1 for a failure, 130 where it was asked to stop."""
    with os.fdopen(os.dup(1), "w") as answers:
        os.dup2(2, 1)  # whatever a library prints is a message
        signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background jobs ignore it
        signal.signal(signal.SIGTERM, _stop)
        if stat.S_ISFIFO(os.fstat(0).st_mode):
            threading.Thread(target=_stop_with_input, daemon=True).start()
        logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s", stream=sys.stderr)
        outcome = work(Task.from_json(sys.argv[1]))
        log.info("%s%s", outcome.ending, f": {outcome.reason}" if outcome.reason else "")
        answers.write(outcome_line(outcome) + "\n")
    sys.exit({"done": 0, "stopped": STOPPED}.get(outcome.ending, 1))


def work(task: Task) -> TaskOutcome:
    """Complete a cell, whatever state it is in; every error becomes the reason of its failure."""
    try:
        log.info("%s: process %d", task.title, os.getpid())
        with RunFolder(Path(task.run)).owned(task.lock_seconds):
            complete(task)
    except (InterruptedRunError, KeyboardInterrupt) as error:
        return TaskOutcome("stopped", str(error))
    except ReportedError as error:
        return TaskOutcome("failed", str(error))
    except OSError as error:
        log.exception("%s", task.title)
        full = f"no space left for {task.run}"
        return TaskOutcome("failed", full if error.errno in (errno.ENOSPC, errno.EDQUOT) else f"{error}")
    except Exception as error:
        log.exception("%s", task.title)
        first = str(error).strip().partition("\n")[0]
        return TaskOutcome("failed", f"{type(error).__name__}: {first}" if first else type(error).__name__)
    return TaskOutcome("done")


def complete(task: Task) -> None:
    """Train, evaluate and write the results file, as far as that has not been done."""
    from coliags_plugin.engine import evaluator
    from coliags_plugin.engine.devices import choose_device
    from coliags_plugin.engine.trained import load_trained
    from coliags_plugin.results.reading import RESULT_FILE, read_result, write_result

    run, device = RunFolder(Path(task.run)), choose_device(task.device)
    _train(task, run, device)
    file = run.evaluation(task.protocol) / RESULT_FILE
    if not (file.is_file() and read_result(file).key == task.result_key):
        trained = load_trained(run.path, device, Path(task.data))
        trained = replace(trained, scene=replace(trained.scene, name=task.scene))
        file = evaluator.evaluate(trained, task.protocol) / RESULT_FILE
    result = read_result(file)
    if result.key != task.result_key:
        raise InputError(
            f"{file} has the key {result.key}", f"{task.result_key}", "Method or scene changed meanwhile: start again"
        )
    write_result(Path(task.result), result)


def _train(task: Task, run: RunFolder, device: torch.device) -> None:
    """Train to the last step, from where the run is."""
    import cv2
    import torch

    from coliags_plugin.engine.checkpoints import keep_newest, take_newest
    from coliags_plugin.engine.training import TrainingRequest, open_training

    threads = task.threads
    if run.config_file.is_file():
        saved = take_newest(run.checkpoints, task.name, torch.device("cpu"))
        if saved is not None and saved.step == run.method().config.schedule.steps:
            log.info("trained: %d steps", saved.step)
            return
        threads = int(run.provenance().get("threads", threads))
    torch.set_num_threads(threads)
    cv2.setNumThreads(threads)
    request = TrainingRequest(
        task.method,
        Path(task.data),
        task.overrides,
        task.seed,
        task.data_format,
        method_name=task.name,
        scene_name=task.scene,
        protocol=task.protocol,
    )
    with open_training(request, run, device, "continue", owned=True) as trainer:
        log.info("training from step %d of %d on %d threads", trainer.step, trainer.steps, threads)
        trainer.train(task.save_seconds, _KEPT)
    keep_newest(run.checkpoints, 1)


def _stop(number: int, frame: object) -> None:
    os.kill(os.getpid(), signal.SIGINT)


def _stop_with_input() -> None:
    """Wait for the end of standard input, then stop as Ctrl-C does, and at last at once."""
    while os.read(0, 4096):
        pass
    os.kill(os.getpid(), signal.SIGINT)
    time.sleep(_GRACE)
    os._exit(STOPPED)


if __name__ == "__main__":
    main()
