"""Training on a CUDA device that is not there: nothing meets on two devices, and nothing waits unseen."""

import shutil
from importlib.util import find_spec

import pytest
import torch

import coliags_plugin as cp
from coliags_plugin.config.method_config import load_method
from coliags_plugin.engine.checkpoints import latest_checkpoint, read_checkpoint
from coliags_plugin.engine.run_folder import RunFolder
from coliags_plugin.engine.scoring import Scorer
from coliags_plugin.engine.trainer import Trainer
from tests.pretended_cuda import CUDA, MixedDevicesError, PretendedCuda
from tests.scenes import SMALL, wall_scene, write_wall

#: What runs on the device in training, without renderers: rivals and modules beyond those of `coliags`.
METHODS = ("3dgs-depth", "2dgs", "gaussian-pancakes", "pr-endo", "scaffold-gs", "reim-nerf-small", "coliags-plus")
#: Waits of a step of `coliags` that are not the torch renderer's: the log's, and the lengths of lists.
WAITS = {"tolist engine/trainer.py", "tolist fields/triton_kernels/children.py"}


def make_trainer(path, method, steps=4):
    options = [f"schedule.steps={steps}", f"schedule.written_for={steps}", "schedule.checkpoint_every=2"]
    if not method.startswith("reim"):
        options.append("renderer=torch")
    if load_method(method).config.field.name == "anchors":
        options += [*SMALL, "field.voxel_size=5.0"]  # few anchors: their kernels are interpreted
    return Trainer(load_method(method, options), wall_scene(), "wall", RunFolder(path), 0, CUDA)


def test_operands_on_two_devices_are_refused():
    with PretendedCuda():
        there, here = torch.ones(3, device="cuda"), torch.ones(3)
        assert there.device == CUDA and here.device == torch.device("cpu") and (there * 2.0).is_cuda
        for mixing in (lambda: there + here, lambda: torch.stack([there, here]), lambda: there @ here):
            with pytest.raises(MixedDevicesError):
                mixing()
        with pytest.raises(TypeError, match="cuda"):
            there.numpy()
        torch.testing.assert_close(there.cpu() + here, torch.full((3,), 2.0))


def test_gradients_cross_devices_and_stay_on_theirs():
    with PretendedCuda():
        here = torch.ones(3, requires_grad=True)
        there = torch.full((3,), 2.0, device="cuda", requires_grad=True)
        (here.to("cuda") * there).sum().backward()
        assert here.grad.device == torch.device("cpu") and there.grad.device == CUDA
        with pytest.raises(MixedDevicesError):
            here.grad + there.grad


@pytest.mark.parametrize("method", ["coliags", *(pytest.param(name, marks=pytest.mark.thorough) for name in METHODS)])
def test_trains_evaluates_and_resumes_on_the_device(method, tmp_path):
    with PretendedCuda() as device:
        trainer = make_trainer(tmp_path / "run", method)
        trainer.start()
        device.waits.clear()
        trainer.train()
        waits = {place.rsplit(":", 1)[0] for place in device.waits}
        scorer = Scorer("paper", only=("psnr",))
        compared = scorer.compare(trainer.model, trainer.scene.test_sets["test"][0], CUDA)
        assert scorer.score(compared).values["psnr"] > 0
        last = latest_checkpoint(trainer.run.checkpoints)
        first = read_checkpoint(last, method, torch.device("cpu"))
        shutil.rmtree(last)
        again = make_trainer(tmp_path / "run", method)
        again.resume()
        again.train()
    second = read_checkpoint(latest_checkpoint(again.run.checkpoints), method, torch.device("cpu"))
    assert all(torch.equal(tensor, second.tensors[name]) for name, tensor in first.tensors.items())
    if method == "coliags" and find_spec("triton") is not None:
        assert {place for place in waits if "renderers/" not in place and "checkpoints" not in place} <= WAITS


def test_a_loaded_run_launches_on_its_own_device(tmp_path):
    write_wall(tmp_path / "wall")
    options = {"field.voxel_size": 4.0, "datamanager.points_count": 200}
    run = cp.train("coliags", tmp_path / "wall", tmp_path / "run", steps=1, settings=options, device="cpu")
    with PretendedCuda() as device:
        run = cp.load_run(run.path, device="cuda")
        for _ in range(2):  # another run may have made its own device the current one in between
            assert run.load().device == CUDA
    assert device.made_current == [CUDA, CUDA]
