"""Software versions for the provenance of a run."""

from __future__ import annotations

import platform
import subprocess
from pathlib import Path
from typing import Any

import torch

import coliags_plugin


def software() -> dict[str, Any]:
    """Versions, and the git state where the package runs from a checkout."""
    return {
        "package_version": coliags_plugin.__version__,
        "git": _git_state(),
        "python": platform.python_version(),
        "torch": torch.__version__,
        "threads": torch.get_num_threads(),
    }


def _git_state() -> str | None:
    root = Path(coliags_plugin.__file__).resolve().parents[1]
    if not (root / ".git").exists():
        return None
    command = ["git", "-C", str(root), "describe", "--always", "--dirty"]
    try:
        return subprocess.run(command, capture_output=True, text=True, check=True, timeout=10).stdout.strip()
    except (OSError, subprocess.SubprocessError):
        return None
