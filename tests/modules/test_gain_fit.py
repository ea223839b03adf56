"""Gains fitted to surface points before training."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from coliags_plugin.modules.gain import FrameGain
from coliags_plugin.modules.gain_fit import fit_log_gains
from tests.scenes import wall_scene


def gained(gains, **options):
    """The wall, lit by a lamp at the camera, with the images of the training frames multiplied by gains."""
    scene = wall_scene(frames=9, width=64, height=48, **options)
    train = [
        replace(frame, image=(frame.rgb * gain * 255).round().to(torch.uint8))
        for frame, gain in zip(scene.train, gains, strict=True)
    ]
    return replace(scene, train=train)


GAINS = torch.tensor([0.8, 0.5, 0.7, 0.9, 0.6, 0.75, 0.65])


def test_gains_are_found_under_an_inverse_square_lamp():
    found = fit_log_gains(gained(GAINS))
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
    found = fit_log_gains(replace(scene, train=spoilt))
    torch.testing.assert_close(found, GAINS.log() - GAINS.log().mean(), atol=0.015, rtol=0.0)


def test_a_frame_that_shows_nothing_known_has_a_finite_gain():
    scene = gained(GAINS)
    black = replace(scene.train[3], image=torch.zeros_like(scene.train[3].image))
    found = fit_log_gains(replace(scene, train=[*scene.train[:3], black, *scene.train[4:]]))
    assert found.isfinite().all() and found.abs().max() < 1.0


def test_the_module_starts_with_them_where_there_is_depth():
    settings = FrameGain.Settings(channels=3, initial="points")
    module = FrameGain.from_scene(gained(GAINS), settings, torch.Generator())
    expected = (GAINS.log() - GAINS.log().mean()).exp()
    for channel in module.gains().detach().T:
        assert channel.tolist() == pytest.approx(expected.tolist(), rel=0.015)
    without = FrameGain.from_scene(gained(GAINS, depth=False), settings, torch.Generator())
    assert without.gains().tolist() == [[1.0] * 3] * 7
    few = replace(wall_scene(), train=wall_scene().train[:2])
    assert fit_log_gains(few) is None
