"""Ways by which users have files read, and what is read: a tiny scene in every layout, and one of every other file."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import open3d
import torch
import tyro

from coliags_plugin.api.runs import load_run, train
from coliags_plugin.api.scenes import load_scene
from coliags_plugin.cli import Command
from coliags_plugin.comparison.named_files import load_ablation, load_benchmark
from coliags_plugin.config.method_config import load_method
from coliags_plugin.core import bounds
from coliags_plugin.core.cameras import Camera
from coliags_plugin.core.files import CHECKSUMS, write_checksums
from coliags_plugin.core.intrinsics import Intrinsics
from coliags_plugin.core.scenes import Frame
from coliags_plugin.export.splats.formats import READERS, read_splats, write_splats
from coliags_plugin.geometry.meshes.mesh import TriangleMesh, read_mesh, write_mesh
from coliags_plugin.geometry.meshes.truth import compare_meshes, read_true_surface
from coliags_plugin.geometry.poses.formats import format_of, write_trajectory
from coliags_plugin.geometry.poses.trajectory import Trajectory
from coliags_plugin.pipeline.frame_sources import frame_source
from coliags_plugin.pipeline.page import write_page
from coliags_plugin.reconstruction.depth.priors import FilePrior
from coliags_plugin.reporting.video import write_video
from tests.comparison.small import TINY
from tests.datamanagers.kinds import KINDS, write_kind
from tests.export.splats.clouds import random_cloud
from tests.phantom.phantom_layouts import write_phantom
from tests.pipeline.reconstructions import write_long, write_short

FRAMES = 9
METHOD = "coliags"
METHODS = ("coliags", "3dgs", "reim-nerf", "pr-endo")
#: Where the trajectory lies in each format.
TRAJECTORIES = {
    "c3vd": "c3vd.txt",
    "tum": "tum.txt",
    "colmap": "colmap",
    "colmap-text": "colmap-text",
    "nerfstudio": "nerfstudio/transforms.json",
    "endogslam": "endogslam/params.npz",
}


def make_seeds(folder: Path) -> None:
    """Make a folder of seeds for each target in :data:`TARGETS`."""
    work = folder / "work"
    for name in KINDS:
        write_kind(folder / name, name, FRAMES)
    phantom = write_phantom(work / "phantom", "c3vd", frames=FRAMES, mesh_spacing=3.0, texture_spacing=1.0)
    poses = np.load(phantom / "truth/camera_to_world.npy")
    surface = read_mesh(phantom / "truth/mesh.ply")
    _write_rich_transforms(folder / "nerfstudio", folder / "nerfstudio-rich", surface)
    _write_trajectories(folder / "poses", poses)
    _write_meshes(folder / "meshes", surface)
    _write_splats(folder / "splats", folder / "c3vd")
    _write_runs(folder)
    _write_methods(folder / "methods")
    _write_depth_maps(folder / "depth-maps", phantom)
    _write_points(folder / "points", folder / "c3vd")
    (folder / "video").mkdir()
    frames = [cv2.imread(str(path))[..., ::-1] for path in sorted((phantom / "images").iterdir())]
    write_video(np.stack(frames), folder / "video/film.mp4", 10.0)
    write_long(folder / "long-video")
    write_short(folder / "short-video")
    shutil.rmtree(work)


def _write_rich_transforms(scene: Path, target: Path, surface: TriangleMesh) -> None:
    """A scene with everything that a transforms.json can say."""
    shutil.copytree(scene, target)
    file = target / "transforms.json"
    content = json.loads(file.read_text())
    content.update(camera_model="OPENCV", k1=0.01, k2=-0.001, p1=0.0, p2=0.0, applied_scale=1.0)
    content.update(applied_transform=[[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]], ply_file_path="cloud.ply")
    names = [frame["file_path"] for frame in content["frames"]]
    content.update(train_filenames=names[1:], test_filenames=names[:1])
    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(surface.vertices.astype(np.float64)))
    open3d.io.write_point_cloud(str(target / "cloud.ply"), cloud)
    for part, value in (("masks", 255), ("confidence", 200)):
        (target / part).mkdir()
        for frame in content["frames"]:
            name = f"{part}/{Path(frame['depth_file_path']).name}"
            image = cv2.imread(str(target / frame["depth_file_path"]), cv2.IMREAD_UNCHANGED)
            cv2.imwrite(str(target / name), np.full(image.shape[:2], value, np.uint8))
            frame["mask_path" if part == "masks" else "confidence_file_path"] = name
    file.write_text(json.dumps(content))
    shutil.rmtree(target / "truth")


def _write_trajectories(folder: Path, poses: np.ndarray) -> None:
    folder.mkdir()
    names = tuple(f"{index:04d}.png" for index in range(len(poses)))
    trajectory = Trajectory(poses, names, np.arange(len(poses)) / 30.0, Intrinsics(50.0, 50.0, 32.0, 25.5, 64, 51))
    for name, file in TRAJECTORIES.items():
        (folder / file).parent.mkdir(exist_ok=True)
        write_trajectory(folder / file, trajectory, name)
    write_trajectory(folder / "reference.txt", replace(trajectory, names=None), "tum")


def _write_meshes(folder: Path, surface: TriangleMesh) -> None:
    folder.mkdir()
    part = surface.triangles[:200]
    used, triangles = np.unique(part, return_inverse=True)
    colors = None if surface.colors is None else surface.colors[used]
    small = TriangleMesh(surface.vertices[used], triangles.reshape(-1, 3), colors)
    for suffix in ("ply", "obj", "glb"):
        write_mesh(folder / f"mesh.{suffix}", small)
    mesh = open3d.io.read_triangle_mesh(str(folder / "mesh.ply"))
    open3d.io.write_triangle_mesh(str(folder / "text.ply"), mesh, write_ascii=True)
    is_seen = np.arange(len(small)) % 2 == 0
    np.savez(folder / "mesh_seen.npz", face_seen=is_seen, face_seen_by_any_frame=is_seen)


def _write_splats(folder: Path, scene: Path) -> None:
    folder.mkdir()
    for name in READERS:
        write_splats(folder / f"cloud.{name}", random_cloud(20, degree=1), name, "a comment")
    shutil.copytree(scene, folder / "scene", ignore=shutil.ignore_patterns("truth", "rotation"))


def _write_runs(folder: Path) -> None:
    target = folder / "run"
    target.mkdir()
    scene = target / "scene"
    shutil.copytree(folder / "c3vd", scene, ignore=shutil.ignore_patterns("truth", "rotation"))
    options = {key: json.loads(value) for key, value in (setting.split("=") for setting in TINY)}
    options["schedule.checkpoint_every"] = 2
    run = train(METHOD, scene, target / "run", steps=3, settings=options)
    run.evaluate()
    shutil.copytree(target / "run", folder / "results/run", ignore=shutil.ignore_patterns("checkpoints"))
    shutil.rmtree(target / "run/eval")


def _write_methods(folder: Path) -> None:
    folder.mkdir()
    shipped = Path(__file__).parents[2] / "method_configs"
    for name in METHODS:
        shutil.copy(shipped / f"{name}.yaml", folder / f"{name}.yaml")
    shutil.copy(shipped / "benchmarks/phantoms-8.yaml", folder / "benchmark.yaml")
    shutil.copy(shipped / "benchmarks/ablations/embedding-sizes.yaml", folder / "ablation.yaml")


def _write_depth_maps(folder: Path, scene: Path) -> None:
    """Depth maps by others, beside images that they belong to."""
    for part in ("npy", "png"):
        (folder / part).mkdir(parents=True)
    for path in sorted((scene / "depths").iterdir())[:3]:
        depth = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        cv2.imwrite(str(folder / f"png/{path.stem[:4]}.png"), depth)
        np.save(folder / f"npy/{path.stem[:4]}.npy", depth.astype(np.float32))


def _write_points(folder: Path, scene: Path) -> None:
    """A scene whose initial points are in files of their own."""
    shutil.copytree(scene, folder, ignore=shutil.ignore_patterns("truth", "rotation"))
    random = np.random.default_rng(0)
    positions = random.uniform(-20, 20, (300, 3)).astype(np.float32)
    np.savez(folder / "cloud.npz", positions=positions, colors=random.integers(0, 255, (300, 3)).astype(np.uint8))
    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(positions.astype(np.float64)))
    open3d.io.write_point_cloud(str(folder / "cloud.ply"), cloud)


# Ways by which users have files read


#: Poses of the worlds that readers convert between may grow by a rotation.
_LENGTH = 2.0 * bounds.LENGTH


@dataclass(frozen=True)
class Target:
    """One way to read files.

    Attributes:
        seeds: Folder of the seeds.
        files: Glob patterns of the files that are damaged, from that folder, each as likely as another.
        read: Reads the folder. Raises what the user would see; asserts that what was accepted makes sense.
        writes: Whether reading changes the folder.
    """

    seeds: str
    files: tuple[str, ...]
    read: Callable[[Path], object]
    writes: bool = False


def _within(values: Any, most: float) -> bool:
    return bool(np.all(np.abs(np.asarray(values, np.float64)) <= most))


def _scene(path: str, **settings: object) -> Callable[[Path], None]:
    def read(folder: Path) -> None:
        scene = load_scene(folder / path, settings=settings)
        for frame in [*scene.train, *(frame for frames in scene.test_sets.values() for frame in frames)]:
            camera = frame.camera
            focal = (camera.fx, camera.fy)
            assert min(focal) > 0.0 and _within([*focal, camera.cx, camera.cy], bounds.PIXELS), camera
            assert 0 < min(camera.width, camera.height) <= max(camera.width, camera.height) <= bounds.IMAGE_SIDE, camera
            assert _are_poses(camera.camera_to_world[None].double().numpy()), camera
            for pixels in (frame.image, frame.depth, frame.mask, frame.seen):
                assert pixels is None or tuple(pixels.shape[:2]) == (camera.height, camera.width), frame.name
            if frame.depth is not None:
                finite = frame.depth[~torch.isnan(frame.depth)]
                assert bool((finite > 0.0).all()) and _within(finite, _LENGTH), frame.name
        assert _within(scene.points.positions, _LENGTH) and np.isfinite(scene.extent)

    return read


def _are_poses(camera_to_world: np.ndarray) -> bool:
    turns = camera_to_world[:, :3, :3]
    gram = turns @ turns.transpose(0, 2, 1)
    return _within(camera_to_world[:, :3, 3], _LENGTH) and _within(gram - np.eye(3), 0.01)


def _points(file: str) -> Callable[[Path], None]:
    return _scene(".", initial_points="file", points_file=file, points_count=200)


def _command(*argv: object) -> None:
    """A command in this process."""
    command = tyro.cli(Command, prog="coliags", args=[str(arg) for arg in argv], config=(tyro.conf.FlagCreatePairsOff,))
    try:
        command.run()
    except SystemExit as stopped:
        assert stopped.code in (0, 1), f"exit status {stopped.code}"


def _poses(name: str) -> Callable[[Path], None]:
    def read(folder: Path) -> None:
        found = folder / TRAJECTORIES[name]
        _command("poses", "convert", found, "-o", folder / "converted.txt", "--to", "tum")
        trajectory = format_of(found).read(found)
        assert _are_poses(trajectory.camera_to_world)
        assert trajectory.timestamps is None or np.isfinite(trajectory.timestamps).all()
        _command("poses", "align", found, folder / "reference.txt", "--scale", "--json")

    return read


def _mesh(name: str) -> Callable[[Path], None]:
    def read(folder: Path) -> None:
        surface = read_true_surface(folder / name)
        assert _within(surface.mesh.vertices, 2e6)
        ours = read_mesh(folder / "mesh.ply") if name != "mesh.ply" else surface.mesh
        compare_meshes(ours, surface, 500)

    return read


def _splats(name: str) -> Callable[[Path], None]:
    def read(folder: Path) -> None:
        cloud = read_splats(folder / f"cloud.{name}")
        for values in (cloud.means, cloud.quats_wxyz, cloud.scales, cloud.opacities, cloud.harmonics):
            assert np.isfinite(values).all()
        assert _within(cloud.means, 2e6)
        _command("import", folder / f"cloud.{name}", "--data", folder / "scene", "--output", folder / "imported")

    return read


def _resume(folder: Path) -> None:
    # Whoever can change a checkpoint can change its checksums too; of half of the cases they are made right.
    for checkpoint in sorted((folder / "run/checkpoints").glob("step-*")):
        readable = checkpoint.is_dir() and all(path.is_file() for path in checkpoint.iterdir())
        if readable and sum(len(path.read_bytes()) for path in checkpoint.iterdir()) % 2 == 0:
            (checkpoint / CHECKSUMS).unlink(missing_ok=True)
            write_checksums(checkpoint)
    _command("train", METHOD, "--data", folder / "scene", "--output", folder / "run", "--resume", "--steps", 4)


def _load_run(folder: Path) -> None:
    run = load_run(folder / "run", data=folder / "scene")
    repr(run), run.history, run.results
    run.load()
    run.render("0000_color")


def _results(folder: Path) -> None:
    _command("report", folder / "run", "--format", "text", "--json")
    _command("report", folder / "run", "--output", folder / "report.html", "--overwrite")


def _methods(folder: Path) -> None:
    for name in METHODS:
        load_method(str(folder / f"{name}.yaml"))


def _prior(folder: Path) -> None:
    camera = Camera(50.0, 50.0, 32.0, 25.5, 64, 51, torch.eye(4, dtype=torch.float64))
    frames = [Frame.of(f"{index:04d}", index, torch.zeros(51, 64, 3, dtype=torch.uint8), camera) for index in range(3)]
    log_depth, weight = np.full((51, 64), np.log(30.0), np.float32), np.ones((51, 64), np.float32)
    for part in ("npy", "png"):
        prior = FilePrior(folder / part, frames)
        for frame in frames:
            assert np.isfinite(prior.log_depth(frame, np.ones((51, 64), bool), log_depth, weight, 30.0)).all()


def _video(folder: Path) -> None:
    source = frame_source(folder / "film.mp4")
    assert source.expected > 0
    for _, _ in zip(range(200), source, strict=False):
        pass


#: Files of a scene besides its images.
_FILES = ("*.json", "*.txt", "*.xml", "*.npz", "*.ply", "sparse/0/*", "rotation/*.txt", "rotation/*.json", "*.yaml")
_RUN = ("run/*.*", "run/checkpoints/*/*")
_PIPELINE = ("*.*", "*/*.json", "*/*/*.json", "*/images/*", "*/*/images/*", "**/run/eval/*/*.json")

TARGETS: dict[str, Target] = {
    **{
        name: Target(
            name,
            tuple(
                str(Path(kind.scene) / part)
                for part in (*_FILES, *dict.fromkeys((kind.images, kind.depths or kind.images, "truth/seen/*")))
            )
            + (("C3VD_endogslam_optimized/**/*.*",) if kind.params.startswith("..") else ()),
            _scene(kind.scene),
        )
        for name, kind in KINDS.items()
    },
    "nerfstudio-rich": Target("nerfstudio-rich", ("transforms.json", "cloud.ply", "*/*.png"), _scene(".")),
    "points-npz": Target("points", ("cloud.npz",), _points("cloud.npz")),
    "points-ply": Target("points", ("cloud.ply",), _points("cloud.ply")),
    "data-check": Target(
        "rgbd",
        ("*.txt", "camera.json", "rgb/*", "depth/*"),
        lambda folder: _command("check", "data", folder, "--json"),
        True,
    ),
    **{f"poses-{name}": Target("poses", (f"{name}*", f"{name}/*"), _poses(name), True) for name in TRAJECTORIES},
    **{
        f"mesh-{name}": Target("meshes", (name, "mesh_seen.npz"), _mesh(name))
        for name in ("mesh.ply", "mesh.obj", "mesh.glb", "text.ply")
    },
    **{f"splats-{name}": Target("splats", (f"cloud.{name}",), _splats(name), True) for name in READERS},
    "resume": Target("run", _RUN, _resume, True),
    "load-run": Target("run", _RUN, _load_run, True),
    "results": Target("results", ("run/*.*", "run/eval/*/*.*", "run/eval/*/*/*/*"), _results, True),
    "method": Target("methods", tuple(f"{name}.yaml" for name in METHODS), _methods),
    "benchmark": Target("methods", ("benchmark.yaml",), lambda folder: load_benchmark(f"{folder}/benchmark.yaml")),
    "ablation": Target("methods", ("ablation.yaml",), lambda folder: load_ablation(f"{folder}/ablation.yaml")),
    "prior": Target("depth-maps", ("npy/*", "png/*"), _prior),
    "video": Target("video", ("*",), _video),
    **{f"page-{name}": Target(name, _PIPELINE, write_page, True) for name in ("short-video", "long-video")},
    "poses-export": Target(
        "long-video",
        ("*.json", "*/*/*.json", "*/poses/sparse/0/*"),
        lambda folder: _command("poses", "export", folder, "--output", folder.with_name("exported"), "--overwrite"),
        True,
    ),
}
