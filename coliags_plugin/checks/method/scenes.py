"""The small phantom that methods are checked on, and the depth of a scene."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from contextlib import suppress
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import torch

from coliags_plugin.config import registry
from coliags_plugin.config.method_config import load_method, method_tree
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.scenes import Scene
from coliags_plugin.phantom.generate import generate
from coliags_plugin.phantom.settings import phantom_settings

#: Small and coarse: a second to make, and few pixels to render. Two of the frames are held out.
PHANTOM = {
    "frames": 12,
    "width": 40,
    "height": 32,
    "rotation_views": 0,
    "polyps": 1,
    "path_length": 20.0,
    "interreflection": 0.0,
    "mesh_spacing": 2.0,
    "texture_spacing": 0.5,
}
#: Has depth, from which initial points are fused.
DEFAULT_LAYOUT = "c3vd"
#: Layouts that have what losses may need and the default layout lacks.
_LAYOUTS_WITH = {"sparse_depth": "colmap"}


def write_phantom(method: str, overrides: Sequence[str], folder: Path) -> Path:
    """Make the phantom that a method is checked on in a folder.

    In the layout of its data manager, where there is one of that name, or in one that has what its losses need.
    """
    named = method_tree(method, overrides).find(["datamanager", "name"]).value
    layout = named if named in registry.phantom_layouts else _layout_for_losses(method, overrides)
    reads_others = named in registry.datamanagers and registry.datamanagers.source(named) == "built in"
    if reads_others and named not in ("auto", layout):
        raise InputError(f"no phantom is made for the data manager '{named}'", do="Name a scene with --data")
    return shutil.copytree(_phantom(layout).name, folder / "phantom", dirs_exist_ok=True)


def _layout_for_losses(method: str, overrides: Sequence[str]) -> str:
    needed: set[str] = set()
    with suppress(InputError):  # of an invalid config: the first check tells
        losses = load_method(method, overrides).config.losses
        needed = {name for node in losses.values() for name in node.target.needs}
    return next((layout for name, layout in _LAYOUTS_WITH.items() if name in needed), DEFAULT_LAYOUT)


@cache
def _phantom(layout: str) -> TemporaryDirectory[str]:
    """Made once in a process, and removed at its end."""
    folder = TemporaryDirectory(prefix="coliags-phantom-")
    generate(phantom_settings({"layout": layout, **PHANTOM}), Path(folder.name), overwrite=True)
    return folder


def depth_range(scene: Scene) -> tuple[float, float] | None:
    """Smallest and largest z-depth known in a few training frames, else of the initial points; None without any."""
    depths = [frame.depth for frame in scene.train[:4]]
    known = torch.cat([torch.zeros(0), *(depth[depth.isfinite()].flatten() for depth in depths if depth is not None)])
    if len(known) == 0 and len(scene.points):
        camera = scene.train[0].camera
        depth = camera.project(scene.points.positions.to(camera.camera_to_world))[1]
        known = depth[depth > 0]
    return (float(known.min()), float(known.max())) if len(known) else None
