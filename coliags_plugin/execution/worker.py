"""A worker process: works on the task of its command line, and says how that ended.

The last line printed is the :class:`~coliags_plugin.execution.tasks.TaskOutcome`; messages go to standard error. When
standard input is a pipe, the worker stops when it is closed, with its state saved: so it ends with whatever started it,
however that ends.
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
from collections.abc import Callable

from coliags_plugin.core.errors import InterruptedRunError, NotWritableError, ReportedError
from coliags_plugin.execution.tasks import STOPPED, TaskOutcome, outcome_line

log = logging.getLogger(__name__)

#: For a step, or what else cannot be interrupted, to end after the worker was asked to stop, seconds.
_GRACE = 30.0


def run_worker(work: Callable[[str], TaskOutcome]) -> None:
    """Work on the task of the command line and exit: 0, 1 for a failure, 130 where it was asked to stop."""
    with os.fdopen(os.dup(1), "w") as answers:
        os.dup2(2, 1)  # whatever a library prints is a message
        signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background jobs ignore it
        signal.signal(signal.SIGTERM, _stop)
        if stat.S_ISFIFO(os.fstat(0).st_mode):
            threading.Thread(target=_stop_with_input, daemon=True).start()
        logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s", stream=sys.stderr)
        outcome = work(sys.argv[1])
        log.info("%s%s", outcome.ending, f": {outcome.reason}" if outcome.reason else "")
        answers.write(outcome_line(outcome) + "\n")
    sys.exit({"done": 0, "stopped": STOPPED}.get(outcome.ending, 1))


def attempt(title: str, folder: str, work: Callable[[], None]) -> TaskOutcome:
    """How work in a folder ends: every error becomes the reason of its failure."""
    try:
        log.info("%s: process %d", title, os.getpid())
        work()
    except (InterruptedRunError, KeyboardInterrupt) as error:
        return TaskOutcome("stopped", str(error))
    except ReportedError as error:
        return TaskOutcome("unwritable" if isinstance(error, NotWritableError) else "failed", str(error))
    except OSError as error:
        log.exception("%s", title)
        if error.errno in (errno.ENOSPC, errno.EDQUOT):
            return TaskOutcome("unwritable", f"no space left for {folder}")
        return TaskOutcome("failed", f"{error}")
    except Exception as error:
        log.exception("%s", title)
        first = str(error).strip().partition("\n")[0]
        return TaskOutcome("failed", f"{type(error).__name__}: {first}" if first else type(error).__name__)
    return TaskOutcome("done")


def _stop(number: int, frame: object) -> None:
    os.kill(os.getpid(), signal.SIGINT)


def _stop_with_input() -> None:
    """Wait for the end of standard input, then stop as Ctrl-C does, and at last at once."""
    while os.read(0, 4096):
        pass
    os.kill(os.getpid(), signal.SIGINT)
    time.sleep(_GRACE)
    os._exit(STOPPED)
