"""Volume rendering against closed forms, and a small radiance field trained on batches of pixels."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import nn

from coliags_plugin.contracts import RadianceField, RadianceSamples
from coliags_plugin.core.errors import InputError
from coliags_plugin.renderers.volume_renderer import (
    OPAQUE,
    WEIGHT_FLOOR,
    CompositedRays,
    VolumeRenderer,
    VolumeRendererSettings,
    even_places,
    refined_places,
    transmittances,
)
from tests.scenes import camera_at

COLOR = (0.8, 0.3, 0.1)


class Fog(RadianceField):
    """Even density everywhere, or only beyond a plane."""

    def __init__(self, density, start=0.0):
        super().__init__()
        self.density = nn.Parameter(torch.tensor(float(density), dtype=torch.float64))
        self.start = start

    def query(self, positions, directions, camera, generator=None):
        beyond = (positions[..., 2] > self.start).to(positions)
        return RadianceSamples(self.density * beyond, positions.new_tensor(COLOR).expand(positions.shape))


Fog.__abstractmethods__ = frozenset()


def camera_from(near_plane, *place):
    return replace(camera_at(*(place or (0, 0, 0))), near_plane=near_plane)


def make(**options):
    return VolumeRenderer(VolumeRendererSettings(**options))


def test_even_fog_absorbs_exponentially_and_nothing_has_no_depth():
    camera = camera_from(1.0)
    output = make(far_plane=9.0, samples=7, background=(0.0, 1.0, 0.0)).render(Fog(0.2), camera)
    lengths = camera.rays().norm(dim=-1)
    alpha = 1 - torch.exp(-0.2 * 8.0 * lengths)
    torch.testing.assert_close(output.alpha, alpha)
    expected = alpha[..., None] * torch.tensor(COLOR) + (1 - alpha[..., None]) * torch.tensor([0.0, 1.0, 0.0])
    torch.testing.assert_close(output.rgb, expected.double())
    kinds = ("depth_accumulated", "depth_expected", "depth_median", "inverse_depth_accumulated")
    empty = make(far_plane=5.0).render(Fog(0.0), camera, kinds)
    assert not any(empty[kind].any() for kind in kinds)


# --- from coarse to fine ----------------------------------------------------------------------------------------------


class Ball(Fog):
    """Dense within a ball of radius 1 about (0, 0, 6); counts where it is asked."""

    def __init__(self, density=4000.0, center=(0.0, 0.0, 6.0)):
        super().__init__(density)
        self.center, self.asked = torch.tensor(center, dtype=torch.float64), []

    def query(self, positions, directions, camera, generator=None):
        self.asked.append(positions.detach())
        inside = ((positions - self.center).norm(dim=-1) < 1.0).to(positions)
        return RadianceSamples(self.density * inside, 0.5 + 0.3 * (positions - self.center).tanh())


class Levels(Ball):
    """A ball whose coarse level is another, greener one."""

    def __init__(self, other):
        super().__init__()
        self.other = other

    @property
    def coarse_level(self):
        return self.other


REFINED = {"far_plane": 9.0, "samples": 48, "importance_samples": 64, "opaque_end": True}


def ball_distance(camera):
    """Distance along each ray to the ball, whether it is hit well within its rim, and whether it is missed."""
    rays = nn.functional.normalize(camera.rays(), dim=-1)
    offset = torch.tensor([0.0, 0.0, 6.0], dtype=torch.float64) - camera.center
    along = (rays * offset).sum(-1)
    nearest = (offset - along[..., None] * rays).norm(dim=-1)
    return along - (1 - nearest.clamp_max(1).square()).sqrt(), nearest < 0.9, nearest >= 1


@pytest.mark.parametrize("spacing", ["depth", "distance"])
def test_depth_and_distance_of_a_ball_from_coarse_to_fine(spacing):
    camera, field = camera_from(3.0, 0.3, -0.2, 0.0, 40, 30), Ball()
    wants = ("depth_accumulated", "depth_accumulated_coarse", "ray_lengths")
    output = make(**REFINED, spacing=spacing).render(field, camera, wants)
    distance, hit, outside = ball_distance(camera)
    assert hit.sum() > 80 and outside.any()
    torch.testing.assert_close(output["ray_lengths"], camera.rays().norm(dim=-1))
    # The first coarse sample inside stands for half an interval of 6 / 48 before and behind it, where the importance
    # samples then lie: if the surface does too, they find it, otherwise they begin within half an interval of it.
    step = 6 / 48 if spacing == "distance" else 6 / 48 * output["ray_lengths"][hit]
    coarse = (output["ray_lengths"] * output["depth_accumulated_coarse"] - distance)[hit]
    fine = (output["ray_lengths"] * output["depth_accumulated"] - distance)[hit]
    assert (coarse > 0).all() and (coarse < step).all()
    outputs = coarse < 0.5 * step
    assert 20 < outputs.sum() < len(outputs) - 20
    assert (fine > 0).all() and (fine < 0.5 * step).all() and (fine < 1.01 * step / 64)[outputs].all()
    assert (output.alpha[hit] == 1).all() and (output.alpha[outside] == 0).all()
    first, second = field.asked
    assert first.shape[1] == 48 and second.shape[1] == 48 + 64
    reach = (second - camera.center).norm(dim=-1) - distance.flatten()[:, None]
    near = (reach.abs() < 0.2).sum(1)[hit.flatten()]
    assert near.min() >= 60  # importance samples lie at the surface


def test_the_coarse_outputs_are_the_coarse_levels_and_one_pass_has_but_one():
    camera, other = camera_from(3.0), Ball(center=(0.5, 0.0, 5.0))
    wants = ("rgb_coarse", "alpha_coarse", "depth_median_coarse", "depth_median")
    pixels = torch.tensor([[16, 11], [20, 11], [0, 0]])
    both = make(**REFINED).render(Levels(other), camera, wants, pixels)
    single = {name: value for name, value in REFINED.items() if name != "importance_samples"}
    alone = make(**single).render(other, camera, wants, pixels)
    assert both["rgb_coarse"].shape == (3, 1, 3)
    for name in ("rgb", "alpha", "depth_median"):
        assert torch.equal(both[f"{name}_coarse"], alone[name])
    for name in ("rgb", "alpha"):
        assert torch.equal(alone[name], alone[f"{name}_coarse"])
    assert not torch.equal(both["depth_median"], both["depth_median_coarse"])
    whole = make(**REFINED, rays_at_once=100).render(Levels(other), camera, wants)
    assert whole["rgb_coarse"].shape == (24, 32, 3)
    torch.testing.assert_close(whole["rgb_coarse"][11, 16], both["rgb_coarse"][0, 0])


def test_the_coarse_level_has_gradients_only_through_outputs_of_its_own():
    camera, other = camera_from(3.0), Ball(0.5)
    field = Levels(other)
    make(**REFINED).render(field, camera).rgb.sum().backward()
    assert field.density.grad is not None and other.density.grad is None
    make(**REFINED).render(field, camera, ("depth_accumulated_coarse",))["depth_accumulated_coarse"].sum().backward()
    assert other.density.grad != 0


def test_colours_of_the_coarse_level_are_computed_for_its_image_alone():
    class Silent(Ball):
        def query_density(self, positions, directions, camera):
            return Ball.query(self, positions, directions, camera).density

        def query(self, positions, directions, camera, generator=None):
            raise RuntimeError("asked for colours")

    camera, field = camera_from(3.0), Levels(Silent())
    silent = make(**REFINED).render(field, camera, ("depth_accumulated", "depth_accumulated_coarse"))
    spoken = make(**REFINED).render(Levels(Ball()), camera, ("depth_accumulated", "rgb_coarse"))
    assert torch.equal(silent.rgb, spoken.rgb)
    with pytest.raises(RuntimeError, match="asked for colours"):
        make(**REFINED).render(field, camera, ("rgb_coarse",))


def test_samples_behind_an_opaque_surface_are_left_out_in_rendering_and_change_nothing():
    class Wall(Fog):
        asked = 0

        def query(self, positions, directions, camera, generator=None):
            self.asked += positions.shape[:2].numel()
            return super().query(positions, directions, camera)

    camera, fields = camera_from(3.0, 0, 0, 0, 40, 30), (Wall(20.0, start=5.0), Wall(20.0, start=5.0))
    wants = ("depth_accumulated", "depth_median", "inverse_depth_accumulated", "rgb_coarse")
    everywhere = make(**REFINED).render(fields[0], camera, wants)
    with torch.no_grad():
        output = make(**REFINED).render(fields[1], camera, wants)
    assert fields[0].asked == 40 * 30 * (48 + 48 + 64) and fields[1].asked < 0.8 * fields[0].asked
    for name in ("rgb", "alpha", *wants):
        torch.testing.assert_close(output[name], everywhere[name].detach(), rtol=0, atol=9.0 * OPAQUE)


def test_chance_places_samples_in_training_alone():
    camera, field = camera_from(3.0), Fog(0.2, start=5.0)
    wants, pixels = ("depth_accumulated",), torch.tensor([[3, 4], [5, 6]])

    def drawn(seed, **options):
        renderer, generator = make(**REFINED, **options), torch.Generator().manual_seed(seed)
        return renderer.render(field, camera, wants, pixels, generator)["depth_accumulated"]

    still = make(**REFINED).render(field, camera, wants, pixels)["depth_accumulated"]
    assert torch.equal(still, make(**REFINED, jitter=True).render(field, camera, wants, pixels)["depth_accumulated"])
    assert torch.equal(still, drawn(0))
    assert torch.equal(drawn(0, jitter=True), drawn(0, jitter=True))
    assert not torch.equal(drawn(0, jitter=True), drawn(1, jitter=True))


BOUNDED = type("Bounded", (Fog,), {"ray_bounds": torch.tensor([10.0, 25.0], dtype=torch.float64)})(50.0, 12.0)


def test_bounds_of_the_field():
    open_ended = make(far_plane=None, spacing="distance", samples=300)
    given = make(far_plane=25.0, spacing="distance", samples=300)
    make().check_field(Fog(50.0), 0.2)
    open_ended.check_field(BOUNDED, 0.0)
    ours, theirs = (
        one.render(BOUNDED, camera_from(near), ("depth_expected",)) for one, near in ((open_ended, 0.0), (given, 10.0))
    )
    assert torch.equal(ours["depth_expected"], theirs["depth_expected"])


@pytest.mark.parametrize(
    ("options", "field", "near_plane", "message"),
    [
        ({"far_plane": 1.0}, Fog(1.0), 2.0, "start at 2 and end at 1"),
        ({"far_plane": None, "spacing": "distance"}, Fog(1.0), 0.0, "does not know where its surface is"),
        ({"far_plane": None, "spacing": "distance"}, BOUNDED, 30.0, "start at 30 and end at 25"),
        ({}, BOUNDED, 0.0, "near_plane 0 with spacing 'depth'"),
        ({"far_plane": None}, None, 0.0, "spacing 'depth': a field's own is a distance"),
        ({"samples": 2, "importance_samples": 4}, None, 0.0, "importance_samples with samples 2"),
    ],
)
def test_refusals(options, field, near_plane, message):
    with pytest.raises(ValueError if field is None else InputError, match=message):
        make(**options).check_field(field, near_plane)
    with pytest.raises(InputError, match="no renderer output 'normals'"):
        make().render(Fog(1.0), camera_at(0, 0, 0), ("normals",))


# Where rays are sampled, and what the samples add up to: against numpy, closed forms and independent loops


RAYS = torch.zeros(3, 3, dtype=torch.float64)


def chance(seed=0):
    return torch.Generator().manual_seed(seed)


def test_even_places_are_midpoints_and_random_ones_lie_in_the_same_intervals():
    still = even_places(2.0, 10.0, 4, RAYS, None)
    assert still.tolist() == [[3.0, 5.0, 7.0, 9.0]] * 3
    drawn = even_places(2.0, 10.0, 4, torch.zeros(5000, 3, dtype=torch.float64), chance())
    share = (drawn - (still[:1] - 1.0)) / 2.0
    assert 0.0 <= share.min() and share.max() < 1.0
    torch.testing.assert_close(share.mean(0), torch.full((4,), 0.5, dtype=torch.float64), rtol=0, atol=0.02)
    assert torch.equal(drawn, even_places(2.0, 10.0, 4, torch.zeros(5000, 3, dtype=torch.float64), chance()))


@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 10_000), samples=st.integers(3, 20), more=st.integers(1, 30), most=st.sampled_from([0.0, 1.0])
)
def test_refined_places_are_numpys_inverse_of_the_cumulative_weights(seed, samples, more, most):
    random = np.random.default_rng(seed)
    places = np.sort(random.uniform(1.0, 9.0, (2, samples)), axis=1)
    weights = random.uniform(0.0, most, (2, samples)) ** 8  # rays without weight are refined evenly
    outputs = refined_places(torch.from_numpy(places), torch.from_numpy(weights), more, None).numpy()
    for row in range(2):
        edges = (places[row, 1:] + places[row, :-1]) / 2
        mass = weights[row, 1:-1] + WEIGHT_FLOOR
        cumulative = np.concatenate([[0.0], np.cumsum(mass) / mass.sum()])
        expected = np.interp((np.arange(more) + 0.5) / more, cumulative, edges)
        np.testing.assert_allclose(outputs[row], np.sort([*places[row], *expected]), rtol=0, atol=1e-9)


def test_an_opaque_end_absorbs_what_is_left_where_there_is_density():
    density = torch.tensor([[0.5, 0.25, 1e-6], [0.5, 0.25, 0.0]], requires_grad=True)
    lengths = torch.tensor([[1.0, 2.0, 3.0]]).expand(2, -1)
    behind = transmittances(density, lengths, opaque_end=True)
    expected = torch.exp(-torch.tensor([0.0, 0.5, 1.0])).tolist()
    assert behind[0].tolist() == pytest.approx([*expected, 0.0])
    assert behind[1].tolist() == pytest.approx([*expected, expected[-1]])
    behind.sum().backward()
    assert density.grad.isfinite().all() and not density.grad[:, -1].any()
    assert transmittances(density, lengths, opaque_end=False)[0, -1].item() == pytest.approx(np.exp(-1.0 - 3e-6))


def test_outputs_are_the_sums_of_their_definitions():
    generator = chance()
    density, lengths = torch.rand(4, 6, generator=generator).double(), torch.rand(4, 6, generator=generator).double()
    depths = torch.rand(4, 6, generator=generator).double().cumsum(1) + 1
    colors, background = torch.rand(4, 6, 3, generator=generator).double(), torch.tensor([0.1, 0.2, 0.3]).double()
    rays = CompositedRays(depths, transmittances(density, lengths, False), colors)
    for row in range(4):
        light, sums = 1.0, {"alpha": 0.0, "depth_accumulated": 0.0, "inverse_depth_accumulated": 0.0}
        rgb, median = torch.zeros(3).double(), 0.0
        for index in range(6):
            opacity = 1.0 - np.exp(-float(density[row, index] * lengths[row, index]))
            weight, depth = light * opacity, float(depths[row, index])
            sums["alpha"] += weight
            sums["depth_accumulated"] += weight * depth
            sums["inverse_depth_accumulated"] += weight / depth
            rgb += weight * colors[row, index]
            median = depth if light > 0.5 >= light * (1 - opacity) else median
            light *= 1.0 - opacity
        sums |= {"depth_expected": sums["depth_accumulated"] / sums["alpha"], "depth_median": median}
        for name, value in sums.items():
            assert rays.output(name, background)[row, 0].item() == pytest.approx(value, abs=1e-12), name
        torch.testing.assert_close(rays.output("rgb", background)[row, 0], rgb + light * background)
