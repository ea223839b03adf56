"""Software that a run or a result is made with."""

from __future__ import annotations

import platform
import subprocess
from pathlib import Path

import torch

from coliags_plugin._version import __version__
from coliags_plugin.core.json_files import JsonObject
from coliags_plugin.results.hashing import code_key


def software() -> JsonObject:
    """Versions, the key of the code, and the git state where the package runs from a checkout."""
    return {
        "package_version": __version__,
        "code": code_key(),
        "git": _git_state(),
        "python": platform.python_version(),
        "torch": torch.__version__,
        "threads": torch.get_num_threads(),
    }


def _git_state() -> str | None:
    root = Path(__file__).resolve().parents[2]
    if not (root / ".git").exists():
        return None
    command = ["git", "-C", str(root), "describe", "--always", "--dirty"]
    try:
        return subprocess.run(command, capture_output=True, text=True, check=True, timeout=10).stdout.strip()
    except (OSError, subprocess.SubprocessError):
        return None
