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


def test_auto_chooses_cpu_on_the_cpu_falls_back_to_torch_and_says_why(monkeypatch):
    renderer = make_component("renderers", {"name": "auto", "background": (0.5, 0.0, 0.0)})
    chosen = choose_renderer(renderer, "gaussians3d", CPU)
    assert chosen.name == "cpu" and "auto chose cpu" in chosen.reason
    assert chosen.renderer.settings.background == (0.5, 0.0, 0.0)
    unavailable = classmethod(lambda cls: Availability(False, "numba is at lunch"))
    monkeypatch.setattr(registry.renderers.get("cpu"), "availability", unavailable)
    chosen = choose_renderer(renderer, "gaussians3d", CPU)
    assert chosen.name == "torch" and "cpu cannot run here: numba is at lunch" in chosen.reason
    with pytest.raises(InputError, match="numba is at lunch"):
        choose_renderer(make_component("renderers", "cpu"), "gaussians3d", CPU)


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
