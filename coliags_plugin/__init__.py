"""Gaussian splatting for colonoscopy: registered components assembled by declarative method configs."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from coliags_plugin.core import __version__

if TYPE_CHECKING:
    from coliags_plugin.api.comparing import compare, report, variant
    from coliags_plugin.api.runs import Run, import_splats, load_run, open_training, train
    from coliags_plugin.api.scenes import (
        check_data,
        estimate_depth,
        estimate_poses,
        load_scene,
        make_phantom,
        reconstruct,
    )
    from coliags_plugin.core.registry import register

__all__ = [
    "Run",
    "__version__",
    "check_data",
    "compare",
    "estimate_depth",
    "estimate_poses",
    "import_splats",
    "load_run",
    "load_scene",
    "make_phantom",
    "open_training",
    "reconstruct",
    "register",
    "report",
    "train",
    "variant",
]

#: Names of the API by its modules.
_MODULES = {
    "api.comparing": ("compare", "report", "variant"),
    "api.runs": ("Run", "import_splats", "load_run", "open_training", "train"),
    "api.scenes": ("check_data", "estimate_depth", "estimate_poses", "load_scene", "make_phantom", "reconstruct"),
    "core.registry": ("register",),
}


def __getattr__(name: str) -> Any:
    """A name of the API, imported on first use, so that importing the package takes no time."""
    for module, names in _MODULES.items():
        if name in names:
            return getattr(import_module(f"coliags_plugin.{module}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    """The names of the API too, for completion."""
    return sorted({*globals(), *__all__})
