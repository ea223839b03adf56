"""Reflectance: the published formulas, reciprocity, and facets that cover the surface once."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from coliags_plugin.fields.cook_torrance import Cosines, facet_density, fresnel, lambert, specular

ROUGHNESS = (0.05, 0.1, 0.3, 0.5, 0.7)
UP = torch.tensor([[0.0, 0.0, 1.0]], dtype=torch.float64)


def double(*values):
    return torch.tensor(values, dtype=torch.float64)


def direction(polar, azimuth):
    return double(math.sin(polar) * math.cos(azimuth), math.sin(polar) * math.sin(azimuth), math.cos(polar))[None]


def brdf(view, lamp, roughness, f0):
    """Diffuse of albedo 1, and specular. 1 / sr"""
    cosines = Cosines.of(UP, view, lamp)
    reflected = fresnel(cosines, double(f0))
    terms = lambert(cosines, reflected), specular(cosines, reflected, double(roughness))
    return [(term / cosines.normal_lamp).item() for term in terms]


def by_hand(view, lamp, normal, roughness, f0):
    """The published formulas, on vectors of three numbers."""
    view, lamp, normal = (np.asarray(v, float) / np.linalg.norm(v) for v in (view, lamp, normal))
    half = (view + lamp) / np.linalg.norm(view + lamp)
    nv, nl, nh, hv = normal @ view, normal @ lamp, normal @ half, half @ view
    f = f0 + (1 - f0) * (1 - hv) ** 5
    a2 = roughness**4
    d = a2 / (math.pi * (nh**2 * (a2 - 1) + 1) ** 2)
    k = (roughness + 1) ** 2 / 8
    g = nv / (nv * (1 - k) + k) * nl / (nl * (1 - k) + k)
    return (1 - f) / math.pi * nl, nl * f * d * g / (4 * nv * nl)


angles = st.floats(0.0, 1.5), st.floats(0.0, 6.3)


@given(*angles, *angles, st.floats(0.05, 0.7), st.floats(0.0, 0.035))
def test_the_published_formulas_and_reciprocity(view_polar, view_azimuth, lamp_polar, lamp_azimuth, roughness, f0):
    view, lamp = direction(view_polar, view_azimuth), direction(lamp_polar, lamp_azimuth)
    there = brdf(view, lamp, roughness, f0)
    expected = np.array(by_hand(view[0].numpy(), lamp[0].numpy(), UP[0].numpy(), roughness, f0))
    assert there == pytest.approx(expected / math.cos(lamp_polar), rel=1e-6)
    assert there == pytest.approx(brdf(lamp, view, roughness, f0), rel=1e-9)


def test_a_lamp_at_the_viewer_is_the_general_case():
    view = direction(0.7, 0.3)
    cosines = Cosines.retroreflected((UP * view).sum(1))
    reflected = fresnel(cosines, double(0.02))
    assert reflected.item() == 0.02
    ours = [
        term.item() / math.cos(0.7) for term in (lambert(cosines, reflected), specular(cosines, reflected, double(0.4)))
    ]
    assert ours == pytest.approx(brdf(view, view, 0.4, 0.02), rel=1e-9)


@pytest.mark.parametrize("roughness", ROUGHNESS)
def test_facets_cover_the_surface_once(roughness):
    """The projected area of all facets is 1: the integral over the hemisphere of D <N, H>, with t = <N, H>^2."""
    edges = 1.0 - torch.logspace(-14, 0, 200_001, dtype=torch.float64)
    middles = (edges[1:] + edges[:-1]) / 2
    area = facet_density(middles.sqrt(), torch.full_like(middles, roughness)) * math.pi * (edges[:-1] - edges[1:])
    assert area.sum().item() == pytest.approx(1.0, abs=1e-4)


def test_gradients_are_those_of_finite_differences_and_finite_at_grazing_angles():
    view, lamp = direction(0.6, 0.2), direction(0.9, 2.0)
    roughness, f0 = double(0.4).requires_grad_(), double(0.03).requires_grad_()
    normal = torch.nn.functional.normalize(double(0.1, -0.2, 1.0)[None]).requires_grad_()

    def value(normal, view, lamp, roughness, f0):
        cosines = Cosines.of(normal, view, lamp)
        reflected = fresnel(cosines, f0)
        return lambert(cosines, reflected) + specular(cosines, reflected, roughness)

    torch.autograd.gradcheck(value, (normal, view.requires_grad_(), lamp.requires_grad_(), roughness, f0))
    grazing = direction(math.pi / 2, 0.0)
    value(normal, grazing, lamp, roughness, f0).sum().backward()
    assert all(tensor.grad.isfinite().all() for tensor in (normal, roughness, f0))
