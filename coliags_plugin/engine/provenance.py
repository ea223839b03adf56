"""Provenance of a run."""

from __future__ import annotations

import math
import platform
import subprocess
from pathlib import Path

import torch

from coliags_plugin._version import __version__
from coliags_plugin.config.method_config import LoadedMethod
from coliags_plugin.core.json_files import JsonObject
from coliags_plugin.core.scenes import Scene
from coliags_plugin.engine.model import Model
from coliags_plugin.renderers.choice import ChosenRenderer
from coliags_plugin.results.hashing import code_key


def run_provenance(
    method: LoadedMethod,
    scene: Scene,
    scene_path: str,  # relative to the run folder
    seed: int,
    device: torch.device,
    chosen: ChosenRenderer,
    model: Model,
) -> JsonObject:
    """What a run is and was made with."""
    footprint = scene.pixel_footprint
    return {
        "method": method.name,
        "seed": seed,
        "steps": method.config.schedule.steps,
        "device": str(device),
        "renderer": chosen.name,
        "renderer_reason": chosen.reason,
        "untrained_views": {name: module.untrained_views for name, module in model.view_modules.items()},
        **software(),
        "scene": {
            "name": scene.name,
            "path": scene_path,
            "extent": scene.extent,
            "pixel_footprint": footprint if math.isfinite(footprint) else None,  # without points there is none
            "points": len(scene.points),
            "provenance": scene.provenance,
        },
    }


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
