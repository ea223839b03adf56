"""Everything that is done with a run, on a CUDA device that is not there, and what it gives on a CPU."""

import numpy as np
import pytest
import torch

import coliags_plugin as cp
from coliags_plugin.api.runs import import_splats
from coliags_plugin.comparison import compare
from coliags_plugin.comparison.compare import carry_out
from coliags_plugin.config.options import CompareOptions
from coliags_plugin.core.images import read_rgb
from coliags_plugin.engine import scoring
from coliags_plugin.engine.rendering import CameraPath, Keyframe
from coliags_plugin.export.baking import distillation
from coliags_plugin.export.splats.formats import WRITERS
from coliags_plugin.export.viewer.live import Viewer
from coliags_plugin.geometry.meshes.mesh import read_mesh
from tests.commands import run as command
from tests.comparison.small import InlineExecutor
from tests.pretended_cuda import CUDA, PretendedCuda
from tests.scenes import write_wall

pytestmark = pytest.mark.thorough

#: Methods, and what makes them small and, after two steps, opaque.
METHODS = {
    "3dgs": {"field.initial_opacity": 0.95, "datamanager.points_count": 400},
    "coliags-plus": {"field.voxel_size": 4.0, "datamanager.points_count": 300},
    "pr-endo": {"field.initial_opacity": 0.95, "datamanager.points_count": 400},
    "2dgs": {"field.initial_opacity": 0.95, "datamanager.points_count": 400},
    "reim-nerf-small": {"field.width": 16, "sampler.pixels": 64, "renderer.samples": 8},
}
OF_GAUSSIANS = [name for name in METHODS if not name.startswith("reim")]


def options_of(method):
    """Changes of the method config; all but radiance fields are drawn by PyTorch, wherever they are."""
    return METHODS[method] | ({} if method.startswith("reim") else {"renderer": "torch"})


@pytest.fixture(autouse=True)
def few_steps(monkeypatch):
    """Fits to a run take two steps."""
    monkeypatch.setattr(distillation, "STEPS", 2)
    monkeypatch.setattr(scoring, "STEPS", 2)


@pytest.fixture(scope="module")
def wall(tmp_path_factory):
    return write_wall(tmp_path_factory.mktemp("scene") / "wall", width=24, height=16)


@pytest.fixture(scope="module")
def trained(wall, tmp_path_factory):
    """A run of each method, trained on the device when it is first asked for."""
    folders = {}

    def on_device(method):
        if method not in folders:
            folder, steps = tmp_path_factory.mktemp("runs") / method, 8 if method == "coliags-plus" else 2
            with PretendedCuda():
                cp.train(method, wall, folder, steps=steps, settings=options_of(method), device="cuda")
            folders[method] = folder
        return folders[method]

    return on_device


def both(argv, folder):
    """A command on the device and on the CPU; its outputs."""
    for device in ("cuda", "cpu"):
        with PretendedCuda():
            assert command(*argv, "--output", folder / device, "--device", device) == 0
    return folder / "cuda", folder / "cpu"


def check_images(there, here):
    """Images of the same names, whose pixels differ by rounding."""
    files = sorted(file.relative_to(here) for file in here.rglob("*.png"))
    assert files and files == sorted(file.relative_to(there) for file in there.rglob("*.png"))
    for file in files:
        differences = np.abs(read_rgb(there / file).astype(int) - read_rgb(here / file))
        assert np.quantile(differences, 0.99) <= 1, file


@pytest.mark.parametrize(
    ("method", "options"),
    [
        *((method, ("--frames", "all", "--depth-tiff")) for method in METHODS),
        *(("pr-endo", lamp) for lamp in (("--light", "offset=[2,0,0]"), ("--flatten",))),
    ],
)
def test_renders(method, options, trained, tmp_path):
    check_images(*both(["render", trained(method), *options], tmp_path))


def test_a_camera_path_is_rendered(trained, tmp_path):
    start, end = (frame.camera for frame in cp.load_run(trained("3dgs"), device="cpu").load().scene.train[:2])
    CameraPath(keyframes=(Keyframe.of(start), Keyframe.of(end)), seconds=0.2).write(tmp_path / "path.json")
    there, here = both(["render", trained("3dgs"), "--path", tmp_path / "path.json"], tmp_path)
    assert {file.name for file in there.iterdir()} == {file.name for file in here.iterdir()}


@pytest.mark.parametrize("method", METHODS)
def test_evaluates_with_refined_poses(method, trained):
    values = {}
    for device in ("cuda", "cpu"):
        with PretendedCuda():
            result = cp.load_run(trained(method), device=device).evaluate(refine_poses=True)
        values[device] = result.sets["test"].values
    assert None not in values["cuda"]["psnr_pose_refined"]
    for name, expected in values["cpu"].items():
        if None not in expected:
            assert values["cuda"][name] == pytest.approx(expected, rel=2e-3), name


@pytest.mark.parametrize("method", ["3dgs", "pr-endo"])
def test_meshes_and_coverage(method, trained, tmp_path):
    there, here = both(["mesh", trained(method), "--texture"], tmp_path)
    meshes = [read_mesh(folder / "mesh.ply") for folder in (there, here)]
    assert len(meshes[0]) == pytest.approx(len(meshes[1]), rel=0.01)
    with PretendedCuda():
        assert command("coverage", trained(method), "--output", tmp_path / "coverage", "--device", "cuda") == 0


@pytest.mark.parametrize(
    ("method", "light"),
    [("3dgs", "mean"), ("2dgs", "mean"), ("coliags-plus", "flattened"), ("coliags-plus", "recorded")],
)
def test_exports(method, light, trained, wall, tmp_path):
    formats = tuple(WRITERS)
    argv = ["export", trained(method), "--light", light, "--seconds", 1, "--no-measure", "--format", *formats]
    with PretendedCuda():
        for device in ("cuda", "cpu"):
            assert command(*argv, "--output", tmp_path / device / "splats.ply", "--device", device) == 0
    for suffix in formats:
        sizes = [(tmp_path / device / f"splats.{suffix}").stat().st_size for device in ("cuda", "cpu")]
        assert sizes[0] == pytest.approx(sizes[1], rel=0.05)
    with PretendedCuda():
        imported = import_splats(tmp_path / "cuda/splats.ply", wall, tmp_path / "imported", device="cuda")
        assert min(imported.evaluate().sets["test"].values["psnr"]) > 0


@pytest.mark.parametrize("method", METHODS)
def test_is_shown_in_a_browser(method, trained, tmp_path):
    with PretendedCuda():
        loaded = cp.load_run(trained(method), device="cuda").load()
        with Viewer(loaded, port=0, threaded=False) as viewer:
            for kind in ("colour", "depth"):
                assert viewer.picture(loaded.scene.train[1].camera, kind).any()
            if loaded.model.field.knows_lamp:
                assert viewer.picture(loaded.scene.train[1].camera, "colour", "flattened").any()
        if method in OF_GAUSSIANS:
            assert command("view", trained(method), "--output", tmp_path / "page.html", "--device", "cuda") == 0


@pytest.mark.parametrize(("first", "method"), [*(("cuda", method) for method in METHODS), ("cpu", "coliags-plus")])
def test_checkpoints_are_read_on_either_device(method, first, wall, tmp_path):
    other = {"cuda": "cpu", "cpu": "cuda"}[first]
    with PretendedCuda():
        cp.train(method, wall, tmp_path / "run", steps=2, settings=options_of(method), device=first)
        cp.train(method, wall, tmp_path / "run", steps=4, device=other, resume=True)
        run = cp.train(method, wall, tmp_path / "run", steps=6, device=first, resume=True)
        assert run.step == 6 and np.isfinite(run.history["loss"]).all()
        for device, place in (("cuda", CUDA), ("cpu", torch.device("cpu"))):
            field = cp.load_run(run.path, device=device).load().model.field
            assert {value.device for value in field.parameters()} == {place}


def test_a_scene_is_reconstructed(wall, tmp_path):
    method = tmp_path / "opaque.yaml"
    method.write_text("base: 3dgs\nrenderer: {name: torch}\nfield: {initial_opacity: 0.95}\n")
    with PretendedCuda():
        settings = {"method": str(method), "steps": 4}
        record = cp.reconstruct(wall, tmp_path / "out", settings=settings, device="cuda")
    assert record.stages["train"].state == record.stages["evaluate"].state == "done"


def test_methods_are_compared(wall, tmp_path):
    options = CompareOptions((wall,), tmp_path / "compared", steps=2, settings=options_of("3dgs"), device="cuda")
    with pytest.MonkeyPatch.context() as patch, PretendedCuda():
        patch.setattr(compare, "make_executor", lambda options: InlineExecutor())
        comparison = carry_out("3dgs", options)
    assert not comparison.failures
    (result,) = (tmp_path / "compared" / "results").rglob("*.json")
    assert "a pretended device" in result.read_text(encoding="utf-8")
