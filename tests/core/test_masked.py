import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from coliags_plugin.core.masked import masked_mean, zero_outside


def test_nan_outside_the_mask_reaches_neither_value_nor_gradient():
    values = torch.tensor([[1.0, torch.nan], [3.0, torch.inf]], requires_grad=True)
    mask = torch.tensor([[True, False], [True, False]])
    mean = masked_mean(values, mask)
    mean.backward()
    assert mean.item() == 2.0
    assert values.grad.tolist() == [[0.5, 0.0], [0.5, 0.0]]


def test_an_empty_mask_gives_zero_with_a_graph():
    values = torch.full((4, 5, 3), torch.nan, requires_grad=True)
    mean = masked_mean(values, torch.zeros(4, 5, dtype=torch.bool))
    mean.backward()
    assert mean.item() == 0.0
    assert not values.grad.any()


@settings(max_examples=20, deadline=None)
@given(height=st.integers(1, 40), width=st.integers(1, 40), seed=st.integers(0, 99))
def test_a_full_mask_is_no_mask_to_the_bit(height, width, seed):
    values = torch.rand(height, width, 3, generator=torch.Generator().manual_seed(seed))
    full = torch.ones(height, width, dtype=torch.bool)
    assert torch.equal(masked_mean(values, full), masked_mean(values, None))
    part = torch.rand(height, width, generator=torch.Generator().manual_seed(seed)) < 0.5
    expected = values[part].mean() if part.any() else torch.tensor(0.0)
    torch.testing.assert_close(masked_mean(values, part), expected)
    assert torch.equal(zero_outside(values, full), values)
