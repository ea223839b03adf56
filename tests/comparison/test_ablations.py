"""Ablations: the shipped ones are the paper's, and a file of one's own has short forms."""

from __future__ import annotations

import pytest

from coliags_plugin.comparison.ablations import ABLATIONS, load_ablation
from coliags_plugin.comparison.named_files import descriptions, shipped
from coliags_plugin.config.method_config import load_method
from coliags_plugin.core.errors import InputError


@pytest.mark.parametrize("name", shipped(ABLATIONS))
def test_every_shipped_ablation_is_valid_and_described(name):
    assert descriptions(ABLATIONS)[name]
    for variant in load_ablation(name):
        assert load_method(variant.method, variant.overrides).config


def heads(variant):
    field = load_method(variant.method, variant.overrides).config.field.settings
    return field.geometry_head, field.appearance_head


def test_the_papers_rows_take_away_what_their_names_lack():
    for variant in load_ablation("paper-rows"):
        parts = set(variant.name.split("-"))
        geometry, appearance = heads(variant)
        assert (geometry.name == "imve") == ("imve" in parts)
        assert (appearance.name == "imia") == ("imia" in parts)
        losses = load_method(variant.method, variant.overrides).config.losses
        assert ("depth" in losses) == ("depth" in parts)
    assert len(load_ablation("paper-rows")) == 5


def test_the_sizes_of_embeddings_are_in_their_names():
    for variant in load_ablation("embedding-sizes"):
        geometry, appearance = heads(variant)
        assert variant.name == f"{geometry.settings.frequencies}-{appearance.settings.frequencies}"


@pytest.fixture
def written(tmp_path):
    def write(text):
        (tmp_path / "mine.yaml").write_text(text)
        return str(tmp_path / "mine.yaml")

    return write


def test_short_forms(written, tmp_path):
    name = written(
        "description: x\nbase: coliags\nvariants:\n  whole:\n  rival: scaffold-gs\n  local: deeper.yaml\n"
        "  small: [field.features=8, field.children=4]\n  both: {method: 3dgs, set: [field.sh_degree=0]}\n"
    )
    variants = {variant.name: (variant.method, variant.overrides) for variant in load_ablation(name)}
    assert variants == {
        "whole": ("coliags", ()),
        "rival": ("scaffold-gs", ()),
        "local": (str(tmp_path / "deeper.yaml"), ()),
        "small": ("coliags", ("field.features=8", "field.children=4")),
        "both": ("3dgs", ("field.sh_degree=0",)),
    }


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("description: x\nvariants: {a: [field.features=8]}", "variant 'a' names no method, and there is no base"),
        ("description: x\nbase: coliags\nvariants: {}", "mine.yaml:3: variants"),
        ("description: x\nbase: coliags\nvariants: {a: {sets: []}}", "unknown key 'sets'.*Did you mean 'set'"),
        ("description: x\nbase: coliags\nvariants: {a: 3}", "mine.yaml:3: variants.a"),
    ],
)
def test_faults_are_named(written, text, told):
    with pytest.raises(InputError, match=told):
        load_ablation(written(text))


def test_an_unknown_name_says_which_was_meant():
    with pytest.raises(InputError, match=r"no ablation 'paper-row'.*Did you mean 'paper-rows'"):
        load_ablation("paper-row")
