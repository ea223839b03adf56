"""Training on a CUDA device that is not there: nothing meets on two devices, and nothing waits unseen."""

import shutil
from collections import Counter
from dataclasses import replace
from unittest import mock

import pytest
import torch

import coliags_plugin as cp
from coliags_plugin.config.method_config import load_method
from coliags_plugin.core.scenes import PointCloud, SparseDepth
from coliags_plugin.engine.checkpoints import read_checkpoint
from coliags_plugin.engine.run_folder import RunFolder
from coliags_plugin.engine.scoring import Scorer
from coliags_plugin.engine.trainer import Trainer
from coliags_plugin.renderers.triton_renderer import TritonRenderer
from tests.pretended_cuda import CUDA, MixedDevicesError, PretendedCuda
from tests.renderers.test_torch_renderer import INPUTS, cast, render_gaussians, scene
from tests.scenes import SMALL, wall_scene, write_wall

#: What runs on the device in training, without renderers: rivals and modules beyond those of `coliags`.
METHODS = ("3dgs-depth", "2dgs", "gaussian-pancakes", "pr-endo", "scaffold-gs", "reim-nerf-small", "coliags-plus")
#: Waits of a step that are not the renderers': for losses and checks, and for the lengths of the lists of elements in
#: view, of those drawn, and of the lamps that cast shadows.
WAITS = Counter(
    {
        "tolist engine/trainer.py": 1,
        "tolist fields/triton_kernels/children.py": 1,
        "a mask as index fields/attenuation.py": 1,
        "nonzero fields/explicit_gaussians.py": 1,
        "nonzero fields/lit_gaussians.py": 1,
    }
)
#: Methods and options whose steps are counted: every component that steps use is in one of them.
STEPS = {
    "coliags": (),
    "coliags-plus": (
        *("modules.poses=pose-correction", "modules.warp=image-warp", 'optimizers."warp.displacement"={lr: 0.1}'),
        *('optimizers."poses.translation"={lr: 0.03}', 'optimizers."poses.rotation"={lr: 0.001}'),
    ),
    "2dgs": (),
    "3dgs-depth": (),
    "gaussian-pancakes": (),
    "pr-endo": ("field.network_from=0",),
    "reim-nerf-small": ("field.width=16", "sampler.pixels=64"),
    "scaffold-gs-distance": (),
}
QUICK = ("coliags", "pr-endo")


def make_trainer(path, method, steps=4, more=(), scene=None):
    options = [f"schedule.steps={steps}", f"schedule.written_for={steps}", "schedule.checkpoint_every=2", *more]
    if not method.startswith("reim"):
        options.insert(0, "renderer=torch")
    if load_method(method).config.field.name == "anchors":
        options = [*SMALL, "field.voxel_size=5.0", *options]  # few anchors: their kernels are interpreted
    return Trainer(load_method(method, options), scene or wall_scene(), "wall", RunFolder(path), 0, CUDA)


def waits_of_a_step(path, method, *options):
    """Number of waits of a step in the middle of a run, by cause and file."""
    with PretendedCuda() as device:
        trainer = make_trainer(path, method, 40, options, rich_scene())
        trainer.step = 20
        for _ in range(2):
            device.waits.clear()
            trainer.take_step()
    waits = Counter()
    for place, count in device.waits.items():
        waits[place.rsplit(":", 1)[0]] += count
    return waits


def rich_scene(width=16, height=12):
    """The wall with everything that a frame can have."""

    def enriched(frame):
        mask = torch.ones(frame.image.shape[:2], dtype=torch.bool)
        mask[:5, :4] = False
        points = SparseDepth(torch.tensor([[10.5, 10.5], [12.2, 5.1]]), torch.tensor([19.0, 19.0]))
        return replace(frame.with_maps(mask=mask, depth_confidence=torch.ones(mask.shape)), sparse_depth=points)

    scene = wall_scene(width=width, height=height)
    tests = {name: [enriched(frame) for frame in frames] for name, frames in scene.test_sets.items()}
    points = PointCloud(scene.points.positions, torch.full((len(scene.points), 3), 128, dtype=torch.uint8))
    return replace(scene, train=[enriched(frame) for frame in scene.train], test_sets=tests, points=points)


def test_what_cuda_refuses_is_refused():
    with PretendedCuda():
        there, here = torch.ones(3, device="cuda"), torch.ones(3)
        number, index = torch.tensor(2.0), torch.tensor([0, 2])
        assert (there * number).is_cuda and there[index].is_cuda  # a number and an index of the host are allowed
        for mixing in (
            lambda: there + here,
            lambda: torch.stack([there[0], number]),
            lambda: here[index.to("cuda")],
            lambda: there.index_put_((index,), here[:2]),
            lambda: torch.rand(3, device="cuda", generator=torch.Generator()),
        ):
            with pytest.raises(MixedDevicesError):
                mixing()


class Careless(TritonRenderer):
    """The triton renderer without its check of devices."""

    devices = frozenset({"cpu"})


def test_kernels_are_given_tensors_of_the_device_alone():
    pytest.importorskip("triton")
    here, camera = scene("random")
    here = cast(here, torch.float32)
    expected = render_gaussians(here, camera).rgb
    with PretendedCuda():
        there = replace(here, **{name: getattr(here, name).to("cuda") for name in (*INPUTS, "source_index")})
        drawn = render_gaussians(there, camera, renderer=TritonRenderer).rgb
        assert drawn.is_cuda
        torch.testing.assert_close(drawn.cpu(), expected, atol=1e-5, rtol=1e-5)
        with pytest.raises(MixedDevicesError, match=r"argument \w+ of kernel"):
            render_gaussians(here, camera, renderer=Careless)


@pytest.mark.thorough
@pytest.mark.parametrize("method", ["coliags", *METHODS])
def test_trains_evaluates_and_resumes_on_the_device(method, tmp_path):
    with PretendedCuda():
        trainer = make_trainer(tmp_path / "run", method)
        trainer.start()
        trainer.train()
        scorer = Scorer("paper", only=("psnr",))
        compared = scorer.compare(trainer.model, trainer.scene.test_sets["test"][0], CUDA)
        assert scorer.score(compared).values["psnr"] > 0
        last = trainer.run.newest_checkpoint
        first = read_checkpoint(last, method, torch.device("cpu"))
        shutil.rmtree(last)
        again = make_trainer(tmp_path / "run", method)
        again.resume()
        again.train()
    second = read_checkpoint(again.run.newest_checkpoint, method, torch.device("cpu"))
    assert all(torch.equal(tensor, second.tensors[name]) for name, tensor in first.tensors.items())


def test_a_loaded_run_launches_on_its_own_device(tmp_path):
    write_wall(tmp_path / "wall")
    options = {"field.voxel_size": 4.0, "datamanager.points_count": 200}
    run = cp.train("coliags", tmp_path / "wall", tmp_path / "run", steps=1, settings=options, device="cpu")
    with PretendedCuda() as device:
        run = cp.load_run(run.path, device="cuda")
        for _ in range(2):  # another run may have made its own device the current one in between
            assert run.load().device == CUDA
    assert device.made_current == [CUDA, CUDA]


@pytest.mark.parametrize(
    "method", [pytest.param(name, marks=() if name in QUICK else pytest.mark.thorough) for name in STEPS]
)
def test_a_step_waits_for_its_losses_and_for_lists_only(method, tmp_path):
    pytest.importorskip("triton")  # without it, anchors are decoded by PyTorch, with more lists
    # The device has no room for the frames: they are sent at every step.
    with mock.patch("coliags_plugin.engine.trainer._size", lambda frame: 2**40):
        waits = waits_of_a_step(tmp_path / "run", method, *STEPS[method])
    waits = Counter({place: count for place, count in waits.items() if "renderers/" not in place})
    assert waits <= WAITS and waits["tolist engine/trainer.py"] == 1


@pytest.mark.thorough
@pytest.mark.parametrize("method", ["coliags", "2dgs", "reim-nerf-small"])
def test_triton_kernels_wait_for_the_number_of_pairs_and_the_volume_renderer_for_nothing_besides(method, tmp_path):
    pytest.importorskip("triton")
    if method == "reim-nerf-small":
        waits = waits_of_a_step(tmp_path / "run", method, *STEPS[method])
        assert waits == Counter({"tolist engine/trainer.py": 1})
        return
    waits = waits_of_a_step(tmp_path / "run", method, "renderer=triton")
    assert waits <= WAITS + Counter({"local_scalar_dense renderers/triton_kernels/placing.py": 1})
