"""gamma, number by number."""

from __future__ import annotations

import pytest
import torch

from coliags_plugin.fields.mlp import cosine_embedding

#: Computed by hand from the definition for cos theta = 0.5 and five frequencies.
HALF = [0.5, 0.479426, 0.877583, 0.841471, 0.540302, 0.909297, -0.416147, -0.756802, -0.653644, 0.989358, -0.145500]


def test_imia_embedding_of_one_half():
    embedded = cosine_embedding(torch.tensor([[0.5]], dtype=torch.float64), 5)
    assert embedded.shape == (1, 11)
    assert embedded[0].tolist() == pytest.approx(HALF, abs=5e-7)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize(("shape", "frequencies"), [((1, 3), 10), ((2, 5, 3), 4), ((4, 1), 5), ((4, 3), 0)])
def test_octaves_follow_one_another(shape, frequencies, dtype):
    v = torch.rand(shape, generator=torch.Generator().manual_seed(0), dtype=dtype)
    octaves = [part for k in range(frequencies) for part in ((2**k * v).sin(), (2**k * v).cos())]
    torch.testing.assert_close(cosine_embedding(v, frequencies), torch.cat([v, *octaves], dim=-1))
