"""Files that are mutated: a tiny scene in every layout, and one of everything else that is read."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import open3d

from coliags_plugin.api.runs import train
from coliags_plugin.core.intrinsics import Intrinsics
from coliags_plugin.export.splats.formats import READERS, write_splats
from coliags_plugin.geometry.meshes.mesh import TriangleMesh, read_mesh, write_mesh
from coliags_plugin.geometry.poses.formats import write_trajectory
from coliags_plugin.geometry.poses.trajectory import Trajectory
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
    """Make a folder of seeds for each target (:mod:`tests.fuzz.targets`)."""
    work = folder / "work"
    for name in KINDS:
        write_kind(folder / name, name, FRAMES)
    phantom = write_phantom(work / "phantom", "c3vd", frames=FRAMES, mesh_spacing=3.0, texture_spacing=1.0)
    poses = np.load(phantom / "truth/camera_to_world.npy")
    surface = read_mesh(phantom / "truth/mesh.ply")
    _rich_transforms(folder / "nerfstudio", folder / "nerfstudio-rich", surface)
    _trajectories(folder / "poses", poses)
    _meshes(folder / "meshes", surface)
    _splats(folder / "splats", folder / "c3vd")
    _runs(folder)
    _methods(folder / "methods")
    _depth_maps(folder / "depth-maps", phantom)
    _points(folder / "points", folder / "c3vd")
    (folder / "video").mkdir()
    frames = [cv2.imread(str(path))[..., ::-1] for path in sorted((phantom / "images").iterdir())]
    write_video(np.stack(frames), folder / "video/film.mp4", 10.0)
    write_long(folder / "long-video")
    write_short(folder / "short-video")
    shutil.rmtree(work)


def _rich_transforms(scene: Path, target: Path, surface: TriangleMesh) -> None:
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


def _trajectories(folder: Path, poses: np.ndarray) -> None:
    """A trajectory in every format."""
    folder.mkdir()
    names = tuple(f"{index:04d}.png" for index in range(len(poses)))
    trajectory = Trajectory(poses, names, np.arange(len(poses)) / 30.0, Intrinsics(50.0, 50.0, 32.0, 25.5, 64, 51))
    for name, file in TRAJECTORIES.items():
        (folder / file).parent.mkdir(exist_ok=True)
        write_trajectory(folder / file, trajectory, name)
    write_trajectory(folder / "reference.txt", replace(trajectory, names=None), "tum")


def _meshes(folder: Path, surface: TriangleMesh) -> None:
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


def _splats(folder: Path, scene: Path) -> None:
    folder.mkdir()
    for name in READERS:
        write_splats(folder / f"cloud.{name}", random_cloud(20, degree=1), name, "a comment")
    shutil.copytree(scene, folder / "scene", ignore=shutil.ignore_patterns("truth", "rotation"))


def _runs(folder: Path) -> None:
    """A run that can be resumed, and one with results."""
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


def _methods(folder: Path) -> None:
    folder.mkdir()
    shipped = Path(__file__).parents[2] / "method_configs"
    for name in METHODS:
        shutil.copy(shipped / f"{name}.yaml", folder / f"{name}.yaml")
    shutil.copy(shipped / "benchmarks/phantoms-8.yaml", folder / "benchmark.yaml")
    shutil.copy(shipped / "benchmarks/ablations/embedding-sizes.yaml", folder / "ablation.yaml")


def _depth_maps(folder: Path, scene: Path) -> None:
    """Depth maps by others, beside images that they belong to."""
    for part in ("npy", "png"):
        (folder / part).mkdir(parents=True)
    for path in sorted((scene / "depths").iterdir())[:3]:
        depth = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        cv2.imwrite(str(folder / f"png/{path.stem[:4]}.png"), depth)
        np.save(folder / f"npy/{path.stem[:4]}.npy", depth.astype(np.float32))


def _points(folder: Path, scene: Path) -> None:
    """A scene whose initial points are in files of their own."""
    shutil.copytree(scene, folder, ignore=shutil.ignore_patterns("truth", "rotation"))
    random = np.random.default_rng(0)
    positions = random.uniform(-20, 20, (300, 3)).astype(np.float32)
    np.savez(folder / "cloud.npz", positions=positions, colors=random.integers(0, 255, (300, 3)).astype(np.uint8))
    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(positions.astype(np.float64)))
    open3d.io.write_point_cloud(str(folder / "cloud.ply"), cloud)
