"""Execution of a command: logging, error reporting and exit status."""

from __future__ import annotations

import logging
import sys
from typing import Protocol

from coliags_plugin.core.errors import ReportedError


class Runnable(Protocol):
    """Protocol of a parsed command."""

    def run(self) -> None:
        """Execute the command."""


def run_command(command: Runnable) -> int:
    """Execute a command; reported errors become one line on stderr and an exit status."""
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
