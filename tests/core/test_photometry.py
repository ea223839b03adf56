"""Gains and fall-off fitted to surface points before training."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from coliags_plugin.config.components import make_component
from coliags_plugin.core.photometry import fit_light
from coliags_plugin.modules.gain import FrameGain
from tests.scenes import wall_scene


def gained(gains, width=64, height=48, **options):
    """The wall, lit by a lamp at the camera, with the images of the training frames multiplied by gains."""
    scene = wall_scene(frames=9, width=width, height=height, **options)
    train = [
        replace(frame, image=(frame.rgb * gain * 255).round().to(torch.uint8))
        for frame, gain in zip(scene.train, gains, strict=True)
    ]
    return replace(scene, train=train)


GAINS = torch.tensor([0.8, 0.5, 0.7, 0.9, 0.6, 0.75, 0.65])


def test_gains_are_found_under_an_inverse_square_lamp():
    found = fit_light(gained(GAINS)).log_gains
    expected = GAINS.log() - GAINS.log().mean()
    torch.testing.assert_close(found, expected, atol=0.01, rtol=0.0)


def test_wrong_depth_and_masked_or_clipped_pixels_do_not_count():
    scene = gained(GAINS)
    spoilt = list(scene.train)
    image, mask = spoilt[2].image.clone(), torch.ones(48, 64, dtype=torch.bool)
    image[:20], mask[:20] = 120, False
    image[20:30] = 255
    depth = spoilt[2].depth.clone()
    depth[30:36], image[30:36] = 11.0, 90
    spoilt[2] = replace(spoilt[2], image=image, mask=mask, depth=depth)
    found = fit_light(replace(scene, train=spoilt)).log_gains
    torch.testing.assert_close(found, GAINS.log() - GAINS.log().mean(), atol=0.015, rtol=0.0)


def test_a_frame_that_shows_nothing_known_has_a_finite_gain():
    scene = gained(GAINS)
    black = replace(scene.train[3], image=torch.zeros_like(scene.train[3].image))
    found = fit_light(replace(scene, train=[*scene.train[:3], black, *scene.train[4:]])).log_gains
    assert found.isfinite().all() and found.abs().max() < 1.0


def test_masked_pixels_have_no_influence_to_the_bit():
    scene = gained(GAINS)
    mask = torch.ones(48, 64, dtype=torch.bool)
    mask[10:30, 5:40] = False
    masked = [replace(frame, mask=mask) for frame in scene.train]
    painted = []
    for frame in masked:
        image, depth = frame.image.clone(), frame.depth.clone()
        image[~mask], depth[~mask] = 200, torch.nan
        painted.append(replace(frame, image=image, depth=depth))
    first, second = (fit_light(replace(scene, train=frames)) for frames in (masked, painted))
    assert torch.equal(first.log_gains, second.log_gains)
    assert torch.equal(first.cosine_exponents, second.cosine_exponents)


def test_nothing_but_masked_pixels_leave_gains_at_one():
    scene = gained(GAINS)
    hidden = [replace(frame, mask=torch.zeros(48, 64, dtype=torch.bool)) for frame in scene.train]
    found = fit_light(replace(scene, train=hidden))
    assert found.log_gains.tolist() == [0.0] * 7 and found.cosine_exponents.tolist() == [0.0] * 3


def test_the_module_starts_with_them_where_there_is_depth():
    settings = FrameGain.Settings(channels=3, initial="points")
    module = FrameGain.from_scene(gained(GAINS), settings, torch.Generator())
    assert module.gains().tolist() == [[1.0] * 3] * 7
    module.prepare(gained(GAINS))
    expected = (GAINS.log() - GAINS.log().mean()).exp()
    for channel in module.gains().detach().T:
        assert channel.tolist() == pytest.approx(expected.tolist(), rel=0.015)
    without = FrameGain.from_scene(gained(GAINS, depth=False), settings, torch.Generator())
    without.prepare(gained(GAINS, depth=False))
    assert without.gains().tolist() == [[1.0] * 3] * 7
    few = replace(wall_scene(), train=wall_scene().train[:2])
    assert fit_light(few) is None


@pytest.mark.parametrize("channels", [1, 3])
def test_the_fall_off_over_the_angle_is_found_and_the_law_starts_with_it(channels):
    scene = gained(GAINS, width=192, height=144)
    exponents = torch.tensor([0.4, 0.8, 1.2])

    def vignetted(frame):
        cosines = frame.camera.rays().norm(dim=-1, keepdim=True).reciprocal().float()
        return replace(frame, image=(0.8 * frame.rgb * cosines**exponents * 255).round().to(torch.uint8))

    scene = replace(scene, train=[vignetted(frame) for frame in scene.train])
    torch.testing.assert_close(fit_light(scene).cosine_exponents, exponents, atol=0.08, rtol=0.0)
    appearance = {"name": "attenuated", "head": "plain", "channels": channels, "initial": "points"}
    node = {"name": "anchors", "geometry_head": "plain", "appearance_head": appearance}
    component = make_component("fields", node)
    field = component.target.from_scene(scene, component.settings, torch.Generator())
    expected = exponents.tolist() if channels == 3 else [0.8]
    assert field.learned["cosine_exponent"] == pytest.approx(expected, abs=0.08)
