"""Choice of renderers: impossible pairs are refused, and the reason for a choice is given."""

from __future__ import annotations

import pytest
import torch

from coliags_plugin.config import registry
from coliags_plugin.config.components import make_component
from coliags_plugin.contracts import Availability
from coliags_plugin.core.errors import InputError
from coliags_plugin.renderers.choice import choose_renderer

CPU = torch.device("cpu")


def test_auto_chooses_cpu_on_the_cpu_and_says_why():
    chosen = choose_renderer(make_component("renderers", "auto"), "gaussians3d", CPU)
    assert chosen.name == "cpu"
    assert "auto chose cpu" in chosen.reason


def test_auto_falls_back_to_torch_and_says_why(monkeypatch):
    renderer = registry.renderers.get("cpu")
    monkeypatch.setattr(renderer, "availability", classmethod(lambda cls: Availability(False, "numba is at lunch")))
    chosen = choose_renderer(make_component("renderers", "auto"), "gaussians3d", CPU)
    assert chosen.name == "torch"
    assert "cpu cannot run here: numba is at lunch" in chosen.reason


def test_auto_passes_its_options_on():
    renderer = make_component("renderers", {"name": "auto", "background": (0.5, 0.0, 0.0)})
    assert choose_renderer(renderer, "gaussians3d", CPU).renderer.settings.background == (0.5, 0.0, 0.0)


@pytest.mark.parametrize(
    ("renderer", "message"),
    [
        ("torch", r"draws gaussians3d, surfels, the field is made of radiance"),
        ("auto", r"no renderer can serve.*--set renderer=NAME, NAME being volume"),
        ({"name": "auto", "prefer": ("volum",)}, r"renderer auto, prefer: .*Did you mean 'volume'"),
    ],
)
def test_an_impossible_pair_names_both_sides(renderer, message):
    with pytest.raises(InputError, match=message):
        choose_renderer(make_component("renderers", renderer), "radiance", CPU)


def test_an_unavailable_renderer_says_why(monkeypatch):
    renderer = registry.renderers.get("torch")
    monkeypatch.setattr(renderer, "availability", classmethod(lambda cls: Availability(False, "the moon is full")))
    with pytest.raises(InputError, match="the moon is full"):
        choose_renderer(make_component("renderers", "torch"), "gaussians3d", CPU)
