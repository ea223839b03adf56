"""Requests to stop a run that arrive in the middle of a step."""

from __future__ import annotations

import logging
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

logger = logging.getLogger(__name__)

#: Ctrl-C, what clusters send before they kill, and what a terminal sends when it is closed.
_HANGUP = getattr(signal, "SIGHUP", None)  # not on Windows
STOPPING = tuple(filter(None, (signal.SIGINT, signal.SIGTERM, _HANGUP)))


@contextmanager
def deferred_stop() -> Iterator[Callable[[], bool]]:
    """Defer :data:`STOPPING` signals: the yielded function tells whether one has come; a second one stops at once.

    SIGHUP stays ignored where it is, as under nohup.

    Raises:
        KeyboardInterrupt: On the second signal.
    """
    asked = False

    def remember(number: int, frame: Any) -> None:
        nonlocal asked
        if asked:
            raise KeyboardInterrupt
        asked = True
        logger.info("%s: stopping after this step; once more to stop at once", signal.Signals(number).name)

    if threading.current_thread() is not threading.main_thread():  # signals arrive at the main thread only
        yield lambda: False
        return
    before = {number: signal.getsignal(number) for number in STOPPING}
    if before.get(_HANGUP) is signal.SIG_IGN:
        del before[_HANGUP]
    try:
        for number in before:
            signal.signal(number, remember)
        yield lambda: asked
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
