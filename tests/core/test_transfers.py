"""What goes to a device: numbers that stay there, and tensors without a wait."""

import torch

from coliags_plugin.core.transfers import constant, sent
from tests.pretended_cuda import CUDA, PretendedCuda


def test_constants_are_of_the_dtype_and_device_and_made_once():
    for dtype in (torch.float32, torch.float64, torch.int64):
        like = torch.zeros(2, dtype=dtype)
        made = constant(((1, 2), (3, 4)), like)
        assert torch.equal(made, like.new_tensor([[1, 2], [3, 4]])) and made.dtype == dtype
        assert constant(((1, 2), (3, 4)), like) is made
    with torch.inference_mode():
        first = constant((5.0,), torch.zeros(1))
    (torch.ones(1, requires_grad=True) * first).sum().backward()  # not an inference tensor


def test_constants_stay_on_the_device():
    with PretendedCuda():
        there = torch.zeros(2, device="cuda")
        made = constant((7.0, 8.0), there)
        assert made.device == CUDA and constant((7.0, 8.0), torch.zeros(2)).device == torch.device("cpu")
    with PretendedCuda():
        assert (constant((7.0, 8.0), torch.zeros(2, device="cuda")) + 1.0).tolist() == [8.0, 9.0]


def test_sent_tensors_are_where_they_should_be():
    here = torch.arange(6.0)
    assert sent(here, "cpu") is here
    with PretendedCuda():
        there = sent(here, "cuda")
        assert there.device == CUDA and there.tolist() == here.tolist()
        assert sent(there, CUDA) is there and sent(there, "cpu").device == torch.device("cpu")
