"""Gaussian splatting for colonoscopy: registered components assembled by declarative method configs."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from coliags_plugin.api import evaluate, load_run, load_scene, relight, train

__version__ = "0.1.0"
__all__ = ["evaluate", "load_run", "load_scene", "relight", "train"]


def __getattr__(name: str) -> Any:
    """A function of :mod:`coliags_plugin.api`, imported on first use, as torch takes a second to load."""
    if name in __all__:
        return getattr(import_module("coliags_plugin.api"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
