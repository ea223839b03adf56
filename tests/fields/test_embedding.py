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


def test_imia_embedding_of_zero():
    assert cosine_embedding(torch.zeros(1, 1), 5)[0].tolist() == [0.0] + [0.0, 1.0] * 5


def test_imve_embedding_order():
    v = torch.tensor([[0.1, 0.2, 0.3]], dtype=torch.float64)
    embedded = cosine_embedding(v, 10)[0]
    assert len(embedded) == 63
    torch.testing.assert_close(embedded[:3], v[0])
    for k in range(10):
        block = embedded[3 + 6 * k : 9 + 6 * k]
        torch.testing.assert_close(block, torch.cat([(2**k * v[0]).sin(), (2**k * v[0]).cos()]))


def test_no_frequencies_leave_the_input():
    x = torch.rand(4, 3)
    torch.testing.assert_close(cosine_embedding(x, 0), x, rtol=0, atol=0)


def test_dtype_and_leading_dimensions_are_kept():
    embedded = cosine_embedding(torch.rand(2, 5, 3, dtype=torch.float64), 4)
    assert embedded.shape == (2, 5, 27)
    assert embedded.dtype == torch.float64
