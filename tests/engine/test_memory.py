"""Memory of a device: frames that would fill it stay on the CPU, and memory that runs out is told."""

import pytest
import torch

from coliags_plugin.config.method_config import load_method
from coliags_plugin.core.errors import DeviceMemoryError
from coliags_plugin.engine.run_folder import RunFolder
from coliags_plugin.engine.trainer import Trainer
from tests.pretended_cuda import CUDA, PretendedCuda
from tests.scenes import wall_scene


def make_trainer(path, device):
    method = load_method("3dgs", ["schedule.steps=3", "schedule.written_for=3", "renderer=torch"])
    return Trainer(method, wall_scene(), "wall", RunFolder(path), 0, torch.device(device))


def test_frames_stay_on_the_cpu_where_they_would_fill_the_device(monkeypatch, tmp_path):
    with PretendedCuda():
        assert make_trainer(tmp_path, CUDA).frames[0].image.is_cuda
        monkeypatch.setattr(torch.cuda, "mem_get_info", lambda *_: (10_000, 2**34))
        assert not make_trainer(tmp_path, CUDA).frames[0].image.is_cuda


def too_much(*args, **kwargs):
    raise torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 2.00 GiB.\nMore")


TOLD = r"step 1, 2,464 elements: .* ran out \(CUDA out of memory.*2.00 GiB\).*whole.*points_count.*width.*--device cpu"


def test_memory_that_runs_out_is_told(tmp_path, monkeypatch):
    trainer = make_trainer(tmp_path / "run", "cpu")
    trainer.start()
    monkeypatch.setattr(trainer.model, "render_stages", too_much)
    with pytest.raises(DeviceMemoryError, match=TOLD):
        trainer.train()
    monkeypatch.setattr(torch.nn.Module, "to", too_much)
    with pytest.raises(DeviceMemoryError, match=TOLD):
        make_trainer(tmp_path / "other", "cpu")
