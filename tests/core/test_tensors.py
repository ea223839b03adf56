"""Copies to a device: numbers that stay there, and tensors without a wait."""

from __future__ import annotations

import shutil
import sys
import sysconfig
from types import SimpleNamespace

import pytest
import torch

from coliags_plugin.core import tensors
from coliags_plugin.core.tensors import constant, sent
from tests.pretended_cuda import CUDA, PretendedCuda


def test_constants_are_of_the_dtype_and_device_and_made_once():
    for dtype in (torch.float32, torch.float64, torch.int64):
        like = torch.zeros(2, dtype=dtype)
        tensor = constant(((1, 2), (3, 4)), like)
        assert torch.equal(tensor, like.new_tensor([[1, 2], [3, 4]])) and tensor.dtype == dtype
        assert constant(((1, 2), (3, 4)), like) is tensor
    with torch.inference_mode():
        first = constant((5.0,), torch.zeros(1))
    (torch.ones(1, requires_grad=True) * first).sum().backward()  # not an inference tensor


def test_constants_and_what_is_sent_stay_on_the_device():
    with PretendedCuda():
        there = torch.zeros(2, device="cuda")
        tensor = constant((7.0, 8.0), there)
        assert tensor.device == CUDA and constant((7.0, 8.0), torch.zeros(2)).device == torch.device("cpu")
    with PretendedCuda():
        assert (constant((7.0, 8.0), torch.zeros(2, device="cuda")) + 1.0).tolist() == [8.0, 9.0]
    here = torch.arange(6.0)
    assert sent(here, "cpu") is here
    with PretendedCuda():
        there = sent(here, "cuda")
        assert there.device == CUDA and there.tolist() == here.tolist()
        assert sent(there, CUDA) is there and sent(there, "cpu").device == torch.device("cpu")


# What is said where triton cannot launch kernels


@pytest.fixture
def lacks(monkeypatch):
    monkeypatch.setattr(tensors, "find_spec", lambda name: object())
    monkeypatch.setitem(sys.modules, "triton", SimpleNamespace(__version__="3.10.0"))
    monkeypatch.delenv("CC", raising=False)
    return tensors.what_triton_lacks.__wrapped__


def test_what_triton_lacks_is_said(lacks, monkeypatch, tmp_path):
    (tmp_path / "Python.h").touch()
    monkeypatch.setattr(sysconfig, "get_paths", lambda scheme: {"include": str(tmp_path)})
    monkeypatch.setattr(shutil, "which", lambda name: None)
    assert "no C compiler" in lacks() and "gcc" in lacks()
    monkeypatch.setenv("CC", "cc")
    assert lacks() is None
    (tmp_path / "Python.h").unlink()
    assert "headers of Python" in lacks()
    monkeypatch.setitem(sys.modules, "triton", SimpleNamespace(__version__="3.5.1"))
    assert "triton 3.5.1 is older than 3.6" in lacks()
    monkeypatch.setattr(tensors, "find_spec", lambda name: None)
    assert "triton is not installed" in lacks()
