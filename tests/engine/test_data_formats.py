"""Choice of the data manager that reads a folder."""

from __future__ import annotations

import pytest

import tests.layouts  # noqa: F401  (registers them)
from coliags_plugin.core import registry
from coliags_plugin.core.components import make_component
from coliags_plugin.core.errors import InputError
from coliags_plugin.engine.data_formats import data_manager, find_format, load_method_for, open_scene

#: Layouts of the phantom whose name is not their format's.
FORMAT_OF = {"c3vd-raw": "c3vd", "endogslam": "c3vd-endogslam", "pr-endo": "c3vd-endogslam"}


def test_every_format_has_a_phantom_layout():
    formats = {name for name in registry.datamanagers if registry.datamanagers.source(name) == "built in"}
    assert {FORMAT_OF.get(layout, layout) for layout in registry.phantom_layouts} == formats - {"auto"}


def test_nothing_and_two_things_are_refused(wall, tmp_path, monkeypatch):
    with pytest.raises(InputError, match="no folder"):
        find_format(tmp_path / "gone")
    (tmp_path / "holiday.jpg").touch()
    with pytest.raises(InputError, match=r"holds holiday\.jpg, which none .*without poses .* sfm"):
        find_format(tmp_path)

    class Claims:
        @classmethod
        def recognise(cls, path):
            return "everything is mine"

    monkeypatch.setitem(registry.datamanagers._targets, "greedy", Claims)
    with pytest.raises(InputError, match=r"several formats \(c3vd: camera_pose.txt.*greedy: everything is mine"):
        find_format(wall)


@pytest.mark.parametrize(
    ("files", "message"),
    [
        ({"rgb/1.png": "", "poses.txt": "0 1 0 0 0 0 0 0 1\n"}, r"poses\.txt, line 1: '0 1 0 .*8 finite numbers"),
        ({"images/1.png": "", "traj.txt": "# by hand\n0,5 1\n"}, r"traj\.txt, line 2: '0,5 1'.*decimal points"),
        ({"rgb/1.png": "", "poses.txt": "<html>"}, r"poses\.txt: it is a web page"),
        (
            {"transforms_train.json": "{}", "transforms_test.json": "{}"},
            r"Blender's NeRF scenes: transforms_train\.json, transforms_test\.json\. Expected .*one transforms\.json",
        ),
        (
            {f"sparse/0/{name}": "" for name in ("cameras.bin", "images.bin", "points3D.ply")},
            r"0 holds no COLMAP model, but cameras\.bin, images\.bin, points3D\.ply\. Expected .*points3D, all \.bin",
        ),
        ({f"sparse/{name}": "" for name in ("cameras.bin", "images.txt", "points3D.bin")}, r"but .*all \.bin or all"),
    ],
)
def test_what_nearly_has_a_format_is_told_what_is_wrong(tmp_path, files, message):
    for name, text in files.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    with pytest.raises(InputError, match=message):
        find_format(tmp_path)


def test_options_of_the_folders_own_format_may_be_set(wall):
    method = load_method_for(wall, "coliags", ["datamanager.lens=fisheye", "datamanager.points_count=5"])
    assert method.config.datamanager.name == "c3vd"
    assert method.config.datamanager.settings.lens == "fisheye"
    assert method.config.datamanager.settings.points_count == 5
    named = load_method_for(wall / "gone", "coliags", [], "c3vd")
    assert named.config.datamanager.name == "c3vd"
    with pytest.raises(InputError, match="Did you mean 'c3vd'"):
        load_method_for(wall, "coliags", [], "c3dv")


def test_options_of_the_method_are_kept_unless_for_another_format(wall, tmp_path):
    for data_format in (None, "c3vd"):
        method = load_method_for(wall, "3dgs", [], data_format)
        assert method.config.datamanager.name == "c3vd"
        assert method.config.datamanager.settings.points_count == 50_000
        assert "points_count: 50000  # 3dgs.yaml:7" in method.annotated()
    mine = tmp_path / "mine.yaml"
    mine.write_text("base: 3dgs\ndatamanager: {name: rotatecolon, points_count: 9}\n")
    kept, dropped = (load_method_for(wall, str(mine), [], name) for name in (None, "c3vd"))
    assert (kept.config.datamanager.name, kept.config.datamanager.settings.points_count) == ("rotatecolon", 9)
    assert (dropped.config.datamanager.name, dropped.config.datamanager.settings.points_count) == ("c3vd", 200_000)


def test_options_without_a_method(wall):
    auto = make_component("datamanagers", {"name": "auto", "points_count": 77})
    manager = data_manager(auto, wall)
    scene = manager.load(wall)
    assert scene.provenance.dataset == "c3vd" and len(scene.points) == 77
    assert manager.fingerprint(wall) == scene.provenance.fingerprint
    assert len(open_scene(wall, options=["split=all-train", "max_frames=4"]).train) == 4
    for options, told in [(["splti=own"], "splti"), (["max_frames=none"], "max_frames"), (["x"], "key.path=value")]:
        with pytest.raises(InputError, match=told):
            open_scene(wall, options=options)
