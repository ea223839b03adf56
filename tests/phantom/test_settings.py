"""Settings of phantoms, and those of the benchmarks."""

from __future__ import annotations

import pytest

from coliags_plugin.comparison.named_files import load_benchmark
from coliags_plugin.core.errors import InputError
from coliags_plugin.phantom.settings import IN_VIVO, PhantomSettings, phantom_settings


@pytest.mark.parametrize(
    ("options", "named"),
    [
        ({"frames": 8}, "frames"),
        ({"width": 15}, "width"),
        ({"light_offset": (4.0, 4.0, 0.0)}, "within 5 mm"),
        ({"light_offset": (float("nan"), 0.0, 0.0)}, "light_offset"),
        ({"lamps": ((1.0, 0.0, 0.0), (0.0, 6.0, 0.0))}, "phantom setting lamps.*6 mm from the lens"),
        ({"lamps": ((1.0, 0.0, 0.0),), "lamp_shares": (0.5, 0.5)}, "2 lamp_shares of 1 lamps"),
        ({"lamps": ((1.0, 0.0, 0.0),), "lamp_shares": (0.0,)}, "lamp_shares: .*one of them more"),
        ({"color_matrix": ((0.9, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))}, "color_matrix: .*sums to 0.9"),
        ({"color_matrix": ((1.0, 0.0, 0.0), (0.0, 1.4, -0.4), (0.0, 0.0, 1.0))}, "off-diagonal beyond 0.3"),
        ({"pose_noise": (0.1, -1.0)}, "pose_noise"),
        ({"compression": 0}, "compression"),
        ({"albedo": (1.2, 0.3, 0.2)}, "albedo"),
        ({"seed": -1}, "seed"),
        ({"layout": "c3vd_raw"}, "phantom setting layout: .*unknown layout; known are c3vd, .*colmap"),
        ({"polypes": 3}, "polyps"),
    ],
)
def test_bad_settings_are_named(options, named):
    with pytest.raises(InputError, match=named):
        phantom_settings(options)


def test_presets_fill_what_is_left_open():
    strong = PhantomSettings(light="strong")
    assert (strong.gain, strong.light_offset, strong.white_balance_drift) == ("fixed", (0.0, 0.0, 0.0), 0.0)
    assert phantom_settings({"lamps": [[3.0, 0.0, 0.0]]}).lamps == ((3.0, 0.0, 0.0),)
    mild = phantom_settings({"gain": "fixed", "layout": "nerfstudio", "white_balance_drift": 0.0})
    assert (mild.gain, mild.white_balance_drift, mild.light_offset) == ("fixed", 0.0, (0.0, 0.0, -3.6))


def test_settings_that_are_given_win_over_the_preset_and_the_record_is_read_back():
    settings = phantom_settings({"preset": "in-vivo", "wave": 0.0, "frames": 30})
    assert settings.wave == 0.0 and settings.frames == 30 and settings.breathing == IN_VIVO["breathing"]
    assert PhantomSettings(**settings.model_dump()) == settings
    assert phantom_settings({}).model_dump() == PhantomSettings().model_dump()


#: Settings that are the light, the camera or the errors of no method's model.
UNASSUMED = {"lamps", "diffuse_roughness", "s_curve", "color_matrix", "metering", "gain_steps", "sharpening"} | {
    *("compression", "pose_noise", "depth_noise", "gamma"),
}


def departures(settings: PhantomSettings) -> set[str]:
    return {name for name in UNASSUMED if getattr(settings, name) != PhantomSettings.model_fields[name].default}


@pytest.mark.parametrize(("name", "unassumed"), [("phantoms-12", 7), ("phantoms-tuning", 2)])
def test_the_benchmarks_have_both_kinds_of_scenes(name, unassumed):
    scenes = {key: scene.phantom for key, scene in load_benchmark(name).scenes.items()}
    assert all(key.endswith(f"-{chosen.seed}") for key, chosen in scenes.items())
    kinds = [kind for chosen in scenes.values() if (kind := departures(chosen))]
    assert len(kinds) == len({frozenset(kind) for kind in kinds}) == unassumed < len(scenes)
    assert all(len(kind) >= 4 and "lamps" in kind for kind in kinds)
    if name == "phantoms-12":
        assert set.union(*kinds) == UNASSUMED and sum(chosen.moves for chosen in scenes.values()) == 2
        assert {chosen.trajectory for chosen in scenes.values()} == {"pullback", "rotation", "inspection"}


def test_an_exact_twin_lacks_nothing_but_the_errors_of_its_scene():
    scenes = {key: scene.phantom for key, scene in load_benchmark("phantoms-tracked").scenes.items()}
    errors = {"pose_noise": (0.17, 0.09), "depth_noise": 0.03}
    for key, chosen in scenes.items():
        assert key.endswith(f"-{chosen.seed}")
        if key.startswith("exact"):
            assert chosen.model_copy(update=errors) == scenes[key.replace("exact", "tracked")]
        else:
            assert {name: getattr(chosen, name) for name in errors} == errors
