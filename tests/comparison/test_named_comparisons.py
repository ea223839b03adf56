"""Benchmarks and ablations: the shipped ones are the publications'; faults of files are told by line and key."""

from __future__ import annotations

import csv
import json
from contextlib import nullcontext
from pathlib import Path

import pytest

from coliags_plugin.comparison.named_files import (
    ABLATIONS,
    Variant,
    load_ablation,
    load_benchmark,
    shipped,
    variants_of,
)
from coliags_plugin.comparison.scenes import find_scenes
from coliags_plugin.config.method_config import descriptions, load_method, method_files
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.registry import phantom_layouts
from coliags_plugin.phantom.generate import resolve


@pytest.fixture
def written(tmp_path):
    """Path of a YAML file with a text."""

    def write(text):
        (tmp_path / "mine.yaml").write_text(text)
        return str(tmp_path / "mine.yaml")

    return write


@pytest.mark.parametrize("name", shipped())
def test_every_shipped_benchmark_is_valid_and_described(name):
    benchmark = load_benchmark(name)
    assert descriptions(shipped())[name] == benchmark.description != ""
    for scene, entry in benchmark.scenes.items():
        name_of_format = entry.format or benchmark.format
        config = load_method("coliags", benchmark.overrides(scene), name_of_format).config
        assert config.datamanager.settings.split == (benchmark.split or "every-8th")
    if name == "c3vd-endogslam":
        assert len(benchmark.scenes) == 10 and benchmark.scenes.keys() < load_benchmark("c3vd").scenes.keys()
        assert (benchmark.split, benchmark.format) == ("endogslam", "c3vd-endogslam")


def test_c3vd_is_the_official_list(shared_data):
    path = shared_data / "c3vd_summary_csv" / "C3VD_data_summary_registered.csv"
    with path.open(encoding="utf-8-sig", newline="") as file:
        official = {row["Old Name"]: row["Video Name"] for row in csv.DictReader(file) if row["Video Name"]}
    scenes = load_benchmark("c3vd").scenes
    assert {name: entry.folders(name) for name, entry in scenes.items()} == {
        old: (old, new) for old, new in official.items()
    }


def test_options_become_changes_of_the_data_manager(written):
    name = written(
        "description: mine\nsplit: block\noptions: {block: [0.2, 0.4], width: 84, height: 67}\n"
        "scenes: {a: {}, b: {options: {split: own, points_file: a b.ply}}}\n"
    )
    benchmark = load_benchmark(name)
    settings = {
        scene: load_method("coliags", benchmark.overrides(scene)).config.datamanager.settings for scene in ("a", "b")
    }
    assert (settings["a"].split, settings["a"].block, settings["a"].width) == ("block", (0.2, 0.4), 84)
    assert (settings["b"].split, settings["b"].height, settings["b"].points_file) == ("own", 67, "a b.ply")


@pytest.mark.parametrize(
    ("load", "text", "message"),
    [
        (load_benchmark, "scenes: {}", "mine.yaml:2: scenes"),
        (load_benchmark, "scenes:\n  a: {phantm: {seed: 0}}", r"mine.yaml:3: scenes.a.phantm: unknown key 'phantm'"),
        (load_benchmark, "scenes:\n  a:\n    phantom: {seeds: 0}", "mine.yaml:4: scenes.a.phantom.seeds: .*'seeds'"),
        (load_benchmark, "scenes: {../a: {}}", r"scene name '\.\./a'"),
        (load_benchmark, "format: c3dv\nscenes: {a: {}}", "mine.yaml:2: format: .*Did you mean 'c3vd'"),
        (load_benchmark, "scenes: {a: {}}\nscenes: {a: {}}", "key 'scenes' is there twice"),
        (load_ablation, "variants: {a: [field.features=8]}", "variant 'a' names no method, and there is no base"),
        (load_ablation, "base: coliags\nvariants: {}", "mine.yaml:3: variants"),
        (load_ablation, "base: coliags\nvariants: {a: {sets: []}}", "unknown key 'sets'.*Did you mean 'set'"),
        (load_ablation, "base: coliags\nvariants: {a: [[[b]]]}", "mine.yaml:3: variants.a.set"),
    ],
)
def test_faults_are_named_by_line_and_key(written, load, text, message):
    with pytest.raises(InputError, match=message):
        load(written(f"description: x\n{text}"))


def test_an_unknown_name_says_which_was_meant(written):
    with pytest.raises(InputError, match=r"mine.yaml:1: description: is missing"):
        load_benchmark(written("scenes: {a: {}}"))
    with pytest.raises(InputError, match=r"no benchmark 'c3dv'.*Did you mean 'c3vd'"):
        load_benchmark("c3dv")
    with pytest.raises(InputError, match=r"no ablation 'paper-row'.*Did you mean 'paper-rows'"):
        load_ablation("paper-row")


# Ablations


@pytest.mark.parametrize("ablation", shipped(ABLATIONS))
def test_every_shipped_ablation_is_described_and_its_variants_have_what_their_names_say(ablation):
    assert descriptions(shipped(ABLATIONS))[ablation]
    for variant in load_ablation(ablation):
        config, name = load_method(variant.method, variant.overrides).config, variant.name
        has_depth = "depth" in config.losses
        if ablation == "rivals":
            assert has_depth != (name.endswith("no-depth") or name in ("scaffold-gs", "3dgs", "2dgs"))
            assert ("exposure" in config.modules) == (name.endswith("gain") or name == "coliags-plus")
        elif ablation in ("paper-rows", "embedding-sizes"):
            geometry, appearance = config.field.settings.geometry_head, config.field.settings.appearance_head
            sees_distance = appearance.name == "plain" and appearance.settings.distance
            uses = (geometry.name == "imve", appearance.name == "imia", sees_distance, has_depth)
            parts = [part in name.split("-") for part in ("imve", "imia", "distance", "depth")]
            if ablation == "paper-rows":
                assert [*uses] == parts
            else:
                assert name == f"{geometry.settings.frequencies}-{appearance.settings.frequencies}"


def test_short_forms(written, tmp_path):
    name = written(
        "description: x\nbase: coliags\nvariants:\n  whole:\n  rival: scaffold-gs\n  local: deeper.yaml\n"
        "  small: &small [field.features=8, field.children=4]\n  both: {method: 3dgs, set: [field.sh_degree=0]}\n"
        "  joined: [field.voxel_pixels=1, *small]\n"
    )
    variants = {variant.name: (variant.method, variant.overrides) for variant in load_ablation(name)}
    assert variants == {
        "whole": ("coliags", ()),
        "rival": ("scaffold-gs", ()),
        "local": (str(tmp_path / "deeper.yaml"), ()),
        "small": ("coliags", ("field.features=8", "field.children=4")),
        "both": ("3dgs", ("field.sh_degree=0",)),
        "joined": ("coliags", ("field.voxel_pixels=1", "field.features=8", "field.children=4")),
    }


def test_a_name_or_file_is_a_method_or_an_ablation(written, tmp_path, monkeypatch):
    assert not method_files().keys() & shipped(ABLATIONS).keys()
    assert variants_of("coliags") == [Variant("coliags", "coliags")]
    assert variants_of("embedding-sizes") == load_ablation("embedding-sizes")
    assert variants_of(name := written("base: coliags\n")) == [Variant("mine", name)]
    assert [each.name for each in variants_of(written("description: x\nvariants: {a: coliags, b: 3dgs}"))] == ["a", "b"]
    monkeypatch.setattr(f"{variants_of.__module__}.method_files", lambda: {"rivals": tmp_path / "rivals.yaml"})
    with pytest.raises(InputError, match=r"'rivals' is a method and an ablation.*Give its file, .*rivals.yaml"):
        variants_of("rivals")


# Scenes


def test_scenes_that_are_missing_are_all_named_with_the_place(tmp_path):
    (tmp_path / "cecum_t1_a").mkdir()
    with pytest.raises(InputError, match=r"21 of 22 scenes are not there: cecum_t1_b, cecum_t2_a") as refused:
        find_scenes(["c3vd"], tmp_path)
    assert "trans_t4_b" in str(refused.value) and str(tmp_path) in str(refused.value)
    assert "cecum_t1_a," not in str(refused.value)


def test_folders_and_scenes_of_a_file(tmp_path, written):
    (tmp_path / "wall").mkdir()
    name = written("description: x\nscenes: {one: {phantom: {seed: 3}}, two: {phantom: {seed: 4}}}")
    scenes = find_scenes([str(tmp_path / "wall"), f"{name}/two"], tmp_path / "made")
    assert [scene.name for scene in scenes] == ["wall", "two"]
    assert scenes[0].is_there and not scenes[1].is_there
    assert scenes[1].phantom.seed == 4 and scenes[1].path == tmp_path / "made" / "two"
    (tmp_path / "c0_cecum_t1_v2").mkdir()
    (scene,) = find_scenes(["c3vd/cecum_t1_b"], tmp_path)  # by its present name
    assert (scene.name, scene.path, scene.data_format) == ("cecum_t1_b", tmp_path / "c0_cecum_t1_v2", "c3vd")


@pytest.mark.parametrize(
    ("names", "data", "message"),
    [
        (["nowhere"], None, "no scene 'nowhere'.*a benchmark: c3vd, c3vd-endogslam"),
        (["c3vd/cecum"], None, "no scene of benchmark 'c3vd' 'cecum'.*Did you mean"),
        (["{tmp}/wall", "{tmp}/other/wall"], None, "more than one scene is named wall"),
        (["{tmp}/wall"], "x", "`data=x` with these benchmarks: none"),
        (["c3vd", "rotatecolon"], "x", "`data=x` with these benchmarks: c3vd, rotatecolon"),
    ],
)
def test_scenes_that_cannot_be_meant(tmp_path, names, data, message):
    for folder in ("wall", "other/wall"):
        (tmp_path / folder).mkdir(parents=True)
    with pytest.raises(InputError, match=message):
        find_scenes([name.format(tmp=tmp_path) for name in names], None if data is None else Path(data))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({}, None),
        ({"seed": 4}, "another phantom than the benchmark's: seed 4 instead of 3"),
        (
            {"tilt": 1.0},
            r"tilt 1\.0 instead of 'none'\. .*as this version makes it.*Remove it, so that it is made",
        ),
        (None, "is not a phantom"),
    ],
)
def test_another_phantom_in_the_place_of_the_benchmarks(tmp_path, written, changes, message):
    name = written("description: x\nscenes: {one: {phantom: {seed: 3, frames: 9}}}")
    (scene,) = find_scenes([name], tmp_path / "made")
    (tmp_path / "made" / "one").mkdir(parents=True)
    if changes is not None:
        made = resolve(scene.phantom, phantom_layouts.get(scene.phantom.layout)()).model_dump(mode="json")
        settings = {"settings": {**made, **changes}}
        (tmp_path / "made" / "one" / "phantom.json").write_text(json.dumps(settings))
    with nullcontext() if message is None else pytest.raises(InputError, match=message):
        assert find_scenes([name], tmp_path / "made")[0].is_there
