"""Layouts of public datasets, in which phantoms are written here so that their readers have something to read.

Every subclass of Layout with a ``name`` in a module of this folder is registered.
"""

from importlib import import_module
from pathlib import Path

from coliags_plugin.config.registry import phantom_layouts
from coliags_plugin.phantom.layouts import Layout

for path in sorted(Path(__file__).parent.glob("[!_]*.py")):
    module = import_module(f"{__name__}.{path.stem}")
    for kind in vars(module).values():
        if isinstance(kind, type) and issubclass(kind, Layout) and kind.__module__ == module.__name__:
            phantom_layouts.register(kind.name, f"{module.__name__}:{kind.__name__}", source="tests")
