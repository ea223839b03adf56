"""Memory of a device: frames that would fill it stay on the CPU, and memory that runs out is told."""

import pytest
import torch

from coliags_plugin.core.errors import DeviceMemoryError
from tests.engine.test_trainer import make_trainer
from tests.pretended_cuda import CUDA, PretendedCuda


def test_frames_stay_on_the_cpu_where_they_would_fill_the_device(monkeypatch, tmp_path):
    with PretendedCuda():
        assert make_trainer(tmp_path, "3dgs", overrides=["renderer=torch"], device=CUDA).frames[0].image.is_cuda
        monkeypatch.setattr(torch.cuda, "mem_get_info", lambda *_: (10_000, 2**34))
        assert not make_trainer(tmp_path, "3dgs", overrides=["renderer=torch"], device=CUDA).frames[0].image.is_cuda


def too_much(*args, **kwargs):
    raise torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 2.00 GiB.\nMore")


TOLD = r"step 1, 2,464 elements: .* ran out \(CUDA out of memory.*2.00 GiB\).*whole.*points_count.*width.*--device cpu"


def test_memory_that_runs_out_is_told(tmp_path, monkeypatch):
    trainer = make_trainer(tmp_path / "run", "3dgs")
    trainer.start()
    monkeypatch.setattr(trainer.model, "render_stages", too_much)
    with pytest.raises(DeviceMemoryError, match=TOLD):
        trainer.train()
    monkeypatch.setattr(torch.nn.Module, "to", too_much)
    with pytest.raises(DeviceMemoryError, match=TOLD):
        make_trainer(tmp_path / "other", "3dgs")
