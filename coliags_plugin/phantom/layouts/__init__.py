"""The folder layouts a phantom can be written in, by name. Looking at the names loads nothing.

To add one, subclass :class:`coliags_plugin.phantom.layouts.base.Layout` in a module of its own and name it
in ``LayoutName`` and ``LAYOUTS``.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    from coliags_plugin.phantom.layouts.base import Layout

LayoutName = Literal[
    "c3vd",
    "c3vd-raw",
    "c3vd-v2",
    "endogslam",
    "pr-endo",
    "rotatecolon",
    "colmap",
    "nerfstudio",
    "rgbd",
    "reim-nerf",
]

#: Name to ``module:Class``; the module is one of this package.
LAYOUTS: dict[str, str] = {
    "c3vd": "c3vd:C3vdLayout",
    "c3vd-raw": "c3vd_raw:C3vdRawLayout",
    "c3vd-v2": "c3vd_v2:C3vdV2Layout",
    "endogslam": "endogslam:EndoGslamLayout",
    "pr-endo": "pr_endo:PrEndoLayout",
    "rotatecolon": "rotatecolon:RotateColonLayout",
    "colmap": "colmap:ColmapLayout",
    "nerfstudio": "nerfstudio:NerfstudioLayout",
    "rgbd": "rgbd:RgbdLayout",
    "reim-nerf": "reim_nerf:ReimNerfLayout",
}


def layout_of(name: str) -> Layout:
    """The layout of a name in ``LAYOUTS``, imported now if it was not yet."""
    module, _, kind = LAYOUTS[name].partition(":")
    made: Layout = getattr(import_module(f"{__name__}.{module}"), kind)()
    return made
