"""Fixed random numbers of pixels, against splitmix64 in whole numbers."""

from __future__ import annotations

import torch
from hypothesis import given
from hypothesis import strategies as st

from coliags_plugin.core.pixel_ids import fixed_uniform, pixel_ids
from coliags_plugin.core.scenes import concatenate_targets
from tests.scenes import wall_scene


def splitmix64(state):
    state = (state + 0x9E3779B97F4A7C15) % 2**64
    state = ((state ^ (state >> 30)) * 0xBF58476D1CE4E5B9) % 2**64
    state = ((state ^ (state >> 27)) * 0x94D049BB133111EB) % 2**64
    return state ^ (state >> 31)


def test_the_reference_is_splitmix64():
    assert splitmix64(0) == 0xE220A8397B1DCDAF  # its first published output for seed 0


@given(frame=st.integers(0, 100_000), pixel=st.integers(0, 2**32 - 1), seed=st.integers(0, 2**31))
def test_numbers_are_splitmix64_of_frame_pixel_and_seed(frame, pixel, seed):
    ids = pixel_ids(frame, torch.tensor([[pixel]]))
    assert ids.item() == frame * 2**32 + pixel
    assert fixed_uniform(ids, seed).item() == (splitmix64(ids.item() ^ splitmix64(seed)) >> 11) / 2**53


def test_a_pixel_has_one_identifier_however_it_is_drawn():
    first, second = wall_scene().train[:2]
    height, width = first.image.shape[:2]
    whole = torch.stack([first.target.ids, second.target.ids])
    assert len(whole.unique()) == 2 * height * width
    pixels = torch.tensor([[3, 1], [30, 20]])
    both = concatenate_targets([frame.target_at(pixels) for frame in (first, second)])
    assert both.ids.shape == (4, 1)
    assert both.ids[:, 0].tolist() == [*whole[0, [1, 20], [3, 30]].tolist(), *whole[1, [1, 20], [3, 30]].tolist()]
