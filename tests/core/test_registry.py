"""Names find components; names that do not, say what would."""

from __future__ import annotations

import hashlib
from importlib import metadata

import pytest

import coliags_plugin
from coliags_plugin.config.reference import options_of
from coliags_plugin.core import registry as registry_module
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.registry import REGISTRIES, Registry

#: Kinds that no config has options for.
WITHOUT_SETTINGS = {"loggers", "protocols", "pose_formats", "phantom_layouts"}


def test_every_builtin_can_be_imported_and_has_settings_where_its_kind_has_some():
    for kind, registry in REGISTRIES.items():
        for name in registry:
            component = registry.get(name)
            assert kind in WITHOUT_SETTINGS or component.Settings is not None


def test_unknown_name_says_what_was_meant():
    with pytest.raises(InputError, match="Did you mean 'torch'"):
        REGISTRIES["renderers"].get("troch")
    with pytest.raises(InputError, match=r"^no pose format 'tumm'\. Expected one of c3vd, .*Did you mean 'tum'"):
        REGISTRIES["pose_formats"].get("tumm")


def test_entry_points_are_found_once(monkeypatch):
    entry = metadata.EntryPoint("pi", "math:pi", "coliags_plugin.things")
    monkeypatch.setattr(registry_module, "installed", lambda group: (entry,) if group == entry.group else ())
    registry = Registry("things", {}, "thing")
    assert registry.get("pi") == pytest.approx(3.14159, abs=1e-4)
    assert "entry point" in registry.source("pi")
    with pytest.raises(InputError, match="already taken by entry point"):
        registry.register("pi", "math:e")


@pytest.mark.parametrize("target", ["no_such_module:Ghost", "math:no_such_name", "math"])
def test_a_plugin_that_cannot_be_imported_is_listed_and_named(target):
    registry = Registry("things", {}, "thing")
    registry.register("ghost", target, "entry point of another package")
    assert registry.names() == ["ghost"]
    with pytest.raises(InputError, match="'ghost' from entry point of another package cannot be imported"):
        registry.get("ghost")


def test_plugin_path_files_are_found(monkeypatch, tmp_path):
    plugin = tmp_path / "mine.py"
    plugin.write_text("class Mine: pass\nCOMPONENTS = {'fields': {'mine': Mine}}\n")
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("COLIAGS_PLUGIN_PATH", "~/mine.py")
    registry = Registry("fields", {}, "thing")
    assert registry.get("mine").__name__ == "Mine"
    assert registry.source("mine") == str(plugin)


@pytest.mark.parametrize(
    "text", ["x = 1\n", "COMPONENTS = {'nonsense': {}}\n", "COMPONENTS = {'fields': ['mine']}\n", None]
)
def test_bad_plugin_file_is_an_input_error(monkeypatch, tmp_path, text):
    plugin = tmp_path / "bad.py"
    if text is not None:
        plugin.write_text(text)
    monkeypatch.setenv("COLIAGS_PLUGIN_PATH", str(plugin))
    with pytest.raises(InputError, match="COMPONENTS" if text else "not a file"):
        Registry("fields", {}, "thing").names()


def test_a_plugin_file_is_a_module_with_its_source_and_is_recorded_with_its_hash(monkeypatch, tmp_path):
    plugin = tmp_path / "mine.py"
    plugin.write_text(
        "from __future__ import annotations\n"
        "from coliags_plugin.core.settings import Configurable, Settings\n\n\n"
        "class MineSettings(Settings):\n    size: int | None = None # edge, pixels\n    step: int = 3  # noqa: X\n\n\n"
        "class Mine(Configurable[MineSettings]): pass\n\n\nCOMPONENTS = {'fields': {'mine': Mine}}\n"
    )
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLIAGS_PLUGIN_PATH", "mine.py")
    registry = Registry("fields", {}, "thing")
    assert options_of(registry.get("mine")) == [
        {"name": "size", "type": "integer or null", "default": None, "meaning": "Edge, pixels."},
        {"name": "step", "type": "integer", "default": 3, "meaning": ""},
    ]
    digest = hashlib.sha256(plugin.read_bytes()).hexdigest()
    origin = {
        "class": "COLIAGS_PLUGIN_PATH.mine:Mine",
        "source": "COLIAGS_PLUGIN_PATH",
        "file": "mine.py",
        "sha256": digest,
    }
    assert registry.origin("mine") == origin
    assert registry.source("mine") == str(plugin)


@pytest.fixture
def losses(monkeypatch):
    """Another registry of losses, which tests may change."""
    registry = Registry("losses", {"l1": "coliags_plugin.losses.target:L1Loss"}, "loss")
    monkeypatch.setitem(REGISTRIES, "losses", registry)
    return registry


def test_a_class_is_registered_and_replaced_by_a_new_one_of_its_name(losses):
    for _ in range(2):

        class Edges: ...

        coliags_plugin.register("losses", "edges", Edges)
        assert losses.get("edges") is Edges
    origin = losses.origin("edges")
    assert origin["class"].endswith(":test_a_class_is_registered_and_replaced_by_a_new_one_of_its_name.<locals>.Edges")
    assert (origin["source"], origin["file"]) == ("coliags_plugin.register", "test_registry.py")


@pytest.mark.parametrize(
    ("kind", "name", "message"),
    [
        ("loss", "edges", r"no kind 'loss'\. .* Did you mean 'losses'\?"),
        ("losses", "l1", "'l1' from coliags_plugin.register is already taken by built in"),
        ("losses", "edges", "'edges' from coliags_plugin.register is already taken by coliags_plugin.register"),
    ],
)
def test_kinds_that_are_none_and_names_that_are_taken_are_refused(losses, kind, name, message):
    losses.register("edges", Registry)
    with pytest.raises(InputError, match=message):
        coliags_plugin.register(kind, name, object)
