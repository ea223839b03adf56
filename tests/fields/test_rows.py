"""Selection of rows against torch's."""

from __future__ import annotations

import pytest
import torch

from coliags_plugin.fields.rows import unique_rows


@pytest.mark.parametrize("shape", [(), (3,), (5, 3)])
@pytest.mark.parametrize("index", [[], [2], [5, 0, 3]])
def test_values_and_gradients_are_those_of_index_select(shape, index):
    table = torch.randn(6, *shape, generator=torch.Generator().manual_seed(0), requires_grad=True)
    rows = torch.tensor(index, dtype=torch.int64)
    selected, expected = unique_rows(table, rows), table.index_select(0, rows)
    assert torch.equal(selected, expected)
    given = torch.randn(expected.shape, generator=torch.Generator().manual_seed(1))
    found, wanted = (torch.autograd.grad(values, table, given)[0] for values in (selected, expected))
    assert torch.equal(found, wanted)


def test_gradients_can_be_differentiated():
    table = torch.randn(4, 2, dtype=torch.float64, requires_grad=True)
    rows = torch.tensor([3, 1])
    assert torch.autograd.gradgradcheck(lambda values: unique_rows(values, rows), (table,))
