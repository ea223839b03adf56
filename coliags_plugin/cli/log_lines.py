"""The log as the terminal shows it."""

from __future__ import annotations

import logging
from typing import TextIO

from rich.console import Console, ConsoleRenderable
from rich.logging import RichHandler
from rich.traceback import Traceback


class LogLines(RichHandler):
    """One line per message, above a progress bar: not broken to the width, so that paths and commands can be copied."""

    def __init__(self, stream: TextIO) -> None:
        super().__init__(console=Console(file=stream, soft_wrap=True), highlighter=None)

    def render(
        self, *, record: logging.LogRecord, traceback: Traceback | None, message_renderable: ConsoleRenderable
    ) -> ConsoleRenderable:
        """The message alone."""
        return message_renderable
