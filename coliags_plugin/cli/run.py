"""Running a command: its log, its errors, its exit status."""

from __future__ import annotations

import logging
import sys
from typing import Protocol

from coliags_plugin.core.errors import ReportedError


class Runnable(Protocol):
    """A parsed command."""

    def run(self) -> None:
        """Do it."""


def run_command(command: Runnable) -> int:
    """Run a command and turn what stops it into one line and an exit status."""
    from rich.console import Console
    from rich.logging import RichHandler

    console = Console(file=sys.stderr)
    logging.basicConfig(
        level=logging.INFO,
        format="%(message)s",
        handlers=[RichHandler(console=console, show_time=False, show_path=False, show_level=False, highlighter=None)],
    )
    try:
        command.run()
    except ReportedError as error:
        print(f"coliags: {error}", file=sys.stderr)
        return error.exit_status
    except KeyboardInterrupt:
        print("coliags: interrupted", file=sys.stderr)
        return 130
    except BrokenPipeError:
        sys.stderr.close()
        return 1
    return 0
