"""Commands run in this process, and calls that must be refused."""

from __future__ import annotations

import pytest

from coliags_plugin.cli import main
from coliags_plugin.core.errors import InputError


def run(*argv) -> int:
    """Exit status of a command."""
    with pytest.raises(SystemExit) as stopped:
        main([str(arg) for arg in argv])
    return stopped.value.code


def refuses(match: str, call, *arguments, **options) -> None:
    """Check that a call raises an :class:`InputError` whose message matches."""
    with pytest.raises(InputError, match=match):
        call(*arguments, **options)


def refused(capsys, *argv) -> str:
    """The message of a command that must fail with status 2, without a traceback."""
    assert run(*argv) == 2
    message = capsys.readouterr().err
    assert "Traceback" not in message
    assert message.startswith("coliags: ") or "\ncoliags: " in message
    return message
