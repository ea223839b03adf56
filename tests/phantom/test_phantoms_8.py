"""The eight phantoms of the benchmark are valid settings, and differ in what they are to tell apart."""

from __future__ import annotations

import re

import pytest

from coliags_plugin.config.method_files import method_folder
from coliags_plugin.config.yaml_tree import read_tree
from coliags_plugin.phantom.settings import PhantomSettings, phantom_settings

#: A repeated name is an error of the reader.
BENCHMARK = read_tree(method_folder() / "benchmarks" / "phantoms-8.yaml").plain()


@pytest.fixture(scope="module")
def scenes() -> dict[str, PhantomSettings]:
    return {name: phantom_settings(how["phantom"]) for name, how in BENCHMARK["scenes"].items()}


def test_every_scene_is_a_phantom_of_full_size_with_a_name_that_is_a_folder(scenes):
    assert list(BENCHMARK) == ["description", "scenes"] and "\n" not in BENCHMARK["description"]
    assert len(scenes) == 8
    for name, chosen in scenes.items():
        assert list(BENCHMARK["scenes"][name]) == ["phantom"]
        assert re.fullmatch(rf"[a-z0-9]+(-[a-z0-9]+)*-{chosen.seed}", name)
        sizes = (chosen.width, chosen.height, chosen.frames, chosen.rotation_views, chosen.layout)
        assert sizes == (None, None, 120, 12, "c3vd")


def test_they_differ_in_colon_light_motion_and_exposure(scenes):
    resolved = {name: chosen.resolved() for name, chosen in scenes.items()}
    assert len({chosen.seed for chosen in resolved.values()}) == 8
    assert {chosen.light for chosen in resolved.values()} == {"c3vd", "strong"}
    assert {chosen.trajectory for chosen in resolved.values()} == {"pullback", "rotation", "inspection"}
    assert "fixed" in {chosen.gain for chosen in resolved.values()}
    assert [name for name, chosen in resolved.items() if any(chosen.light_offset[:2])] == [
        "offset-lamp-3",
        "side-lamp-7",
    ]
    inspecting = [chosen for chosen in resolved.values() if chosen.trajectory == "inspection"]
    assert len(inspecting) == 3 and all(chosen.gain == "auto" and chosen.gain_span >= 2.5 for chosen in inspecting)
    assert sum(chosen.white_balance_drift >= 0.08 for chosen in inspecting) == 1
