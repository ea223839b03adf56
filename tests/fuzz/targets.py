"""What is driven: for every kind of file, the way by which a user has it read."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tests.datamanagers.kinds import KINDS
from tests.fuzz import geometry
from tests.fuzz.seeds import METHOD


@dataclass(frozen=True)
class Target:
    """One way to read files.

    Attributes:
        seeds: Folder of the seeds.
        files: Glob patterns of the files that are mutated, from that folder, each as likely as another.
        read: Reads the folder, of which files are mutated. Raises what the user would see, or
            :class:`geometry.AbsurdError`.
        writes: Whether reading changes the folder.
        weight: How many of all cases.
    """

    seeds: str
    files: tuple[str, ...]
    read: Callable[[Path], None]
    writes: bool = False
    weight: float = 1.0


def _scene(path: str, **settings: object) -> Callable[[Path], None]:
    def read(folder: Path) -> None:
        from coliags_plugin.api.scenes import load_scene

        geometry.check_scene(load_scene(folder / path, settings=settings))

    return read


def _points(file: str) -> Callable[[Path], None]:
    return _scene(".", initial_points="file", points_file=file, points_count=200)


def _data_check(folder: Path) -> None:
    _command("data", "check", folder, "--json")


def _command(*argv: object) -> None:
    """A command in this process, with nothing shown."""
    import tyro

    from coliags_plugin.cli import Command

    command = tyro.cli(Command, prog="coliags", args=[str(arg) for arg in argv], config=(tyro.conf.FlagCreatePairsOff,))
    try:
        command.run()
    except SystemExit as stopped:
        if stopped.code not in (0, 1):
            raise RuntimeError(f"exit status {stopped.code}") from stopped


def _poses(name: str) -> Callable[[Path], None]:
    def read(folder: Path) -> None:
        from coliags_plugin.geometry.poses.formats import format_of

        found = folder / (name if name in ("colmap", "colmap-text", "nerfstudio", "endogslam") else f"{name}.txt")
        if name in ("nerfstudio", "endogslam"):
            found /= "transforms.json" if name == "nerfstudio" else "params.npz"
        _command("poses", "convert", found, "-o", folder / "converted.txt", "--to", "tum")
        trajectory = format_of(found).read(found)
        geometry.check_poses(trajectory.camera_to_world)
        if trajectory.timestamps is not None and not np.isfinite(trajectory.timestamps).all():
            raise geometry.AbsurdError("timestamps")
        _command("poses", "align", found, folder / "reference.txt", "--scale", "--json")

    return read


def _mesh(name: str) -> Callable[[Path], None]:
    def read(folder: Path) -> None:
        from coliags_plugin.geometry.meshes.files import read_mesh
        from coliags_plugin.geometry.meshes.truth import compare_meshes, read_true_surface

        surface = read_true_surface(folder / name)
        if not np.abs(surface.mesh.vertices).max() <= 2e6:
            raise geometry.AbsurdError(f"vertices to {np.abs(surface.mesh.vertices).max()}")
        ours = read_mesh(folder / "mesh.ply") if name != "mesh.ply" else surface.mesh
        compare_meshes(ours, surface, 500)

    return read


def _splats(name: str) -> Callable[[Path], None]:
    def read(folder: Path) -> None:
        from coliags_plugin.export.splats.files import read_splats

        cloud = read_splats(folder / f"cloud.{name}")
        for what in ("means", "quats_wxyz", "scales", "opacities", "harmonics"):
            if not np.isfinite(getattr(cloud, what)).all():
                raise geometry.AbsurdError(what)
        if not np.abs(cloud.means).max() <= 2e6:
            raise geometry.AbsurdError(f"means to {np.abs(cloud.means).max()}")

    return read


def _import(name: str) -> Callable[[Path], None]:
    def read(folder: Path) -> None:
        _command("import", folder / f"cloud.{name}", "--data", folder / "scene", "--output", folder / "imported")

    return read


def _resume(folder: Path) -> None:
    from coliags_plugin.core.checksums import CHECKSUMS, write_checksums

    # Whoever can change a checkpoint can change its checksums too; of half of the cases they are made right.
    for checkpoint in sorted((folder / "run/checkpoints").glob("step-*")):
        readable = checkpoint.is_dir() and all(path.is_file() for path in checkpoint.iterdir())
        if readable and sum(map(len, (path.read_bytes() for path in checkpoint.iterdir()))) % 2 == 0:
            (checkpoint / CHECKSUMS).unlink(missing_ok=True)
            write_checksums(checkpoint)
    _command("train", METHOD, "--data", folder / "scene", "--output", folder / "run", "--resume", "--steps", 4)


def _load_run(folder: Path) -> None:
    from coliags_plugin.api.runs import load_run

    run = load_run(folder / "run", data=folder / "scene")
    repr(run), run.history, run.results
    run.load()
    run.render("0000_color")


def _results(folder: Path) -> None:
    _command("results", "show", folder)
    _command("report", folder / "run", "--output", folder / "report.html")


def _method(folder: Path) -> None:
    from coliags_plugin.config.method_config import load_method

    for name in ("coliags", "3dgs", "reim-nerf", "pr-endo"):
        load_method(str(folder / f"{name}.yaml"))


def _benchmark(folder: Path) -> None:
    from coliags_plugin.comparison.named_files import load_benchmark

    load_benchmark(str(folder / "benchmark.yaml"))


def _ablation(folder: Path) -> None:
    from coliags_plugin.comparison.named_files import load_ablation

    load_ablation(str(folder / "ablation.yaml"))


def _prior(folder: Path) -> None:
    import torch

    from coliags_plugin.core.cameras import Camera
    from coliags_plugin.core.scenes import Frame
    from coliags_plugin.reconstruction.depth.priors import FilePrior

    camera = Camera(50.0, 50.0, 32.0, 25.5, 64, 51, torch.eye(4, dtype=torch.float64))
    frames = [Frame(f"{index:04d}", index, torch.zeros(51, 64, 3, dtype=torch.uint8), camera) for index in range(3)]
    known, weight = np.full((51, 64), np.log(30.0), np.float32), np.ones((51, 64), np.float32)
    for part in ("npy", "png"):
        prior = FilePrior.of(folder / part, frames)
        for frame in frames:
            found = prior.log_depth(frame, np.ones((51, 64), bool), known, weight, 30.0)
            if not np.isfinite(found).all():
                raise geometry.AbsurdError("prior")


def _video(folder: Path) -> None:
    from coliags_plugin.pipeline.frame_sources import frame_source

    source = frame_source(folder / "film.mp4")
    assert source.expected > 0
    for count, _ in enumerate(source):
        if count > 200:
            break


def _procedure_page(folder: Path) -> None:
    from coliags_plugin.pipeline.procedure.page import write_procedure_page

    write_procedure_page(folder)


def _procedure_export(folder: Path) -> None:
    _command("poses", "export", folder, "--output", folder.with_name("exported"), "--overwrite")


#: Files of a scene besides its images.
_FILES = (
    *("*.json", "*.txt", "*.xml", "*.npz", "*.ply", "*.png", "sparse/0/*"),
    *("rotation/*.txt", "rotation/*.json", "*.yaml"),
)

TARGETS: dict[str, Target] = {
    **{
        name: Target(
            name,
            tuple(
                f"{kind.scene}/{part}" if kind.scene != "." else part
                for part in (*_FILES, *dict.fromkeys((kind.images, kind.depths or kind.images, "truth/seen/*")))
            )
            + (("C3VD_endogslam_optimized/**/*.*",) if name == "pr-endo" else ()),
            _scene(kind.scene),
            weight=2.0,
        )
        for name, kind in KINDS.items()
    },
    "nerfstudio-rich": Target(
        "nerfstudio-rich", ("transforms.json", "transforms.json", "cloud.ply", "*/*.png"), _scene("."), weight=2.0
    ),
    "points-npz": Target("points", ("cloud.npz",), _points("cloud.npz")),
    "points-ply": Target("points", ("cloud.ply",), _points("cloud.ply")),
    "data-check": Target("rgbd", ("*.txt", "camera.json", "rgb/*", "depth/*"), _data_check, True, 0.05),
    **{
        f"poses-{name}": Target("poses", (f"{name}*", f"{name}/*"), _poses(name), True)
        for name in ("c3vd", "tum", "colmap", "colmap-text", "nerfstudio", "endogslam")
    },
    **{
        f"mesh-{name}": Target("meshes", (name, name, "mesh_seen.npz"), _mesh(name))
        for name in ("mesh.ply", "mesh.obj", "mesh.glb", "text.ply")
    },
    **{f"splats-{name}": Target("splats", (f"cloud.{name}",), _splats(name)) for name in ("ply", "spz", "splat")},
    **{
        f"import-{name}": Target("splats", (f"cloud.{name}",), _import(name), True, 0.2)
        for name in ("ply", "spz", "splat")
    },
    "resume": Target("run", ("run/*.*", "run/checkpoints/*/*"), _resume, True, 0.3),
    "load-run": Target("run", ("run/*.*", "run/checkpoints/*/*"), _load_run, True, 0.3),
    "results": Target("results", ("run/*.*", "run/eval/*/*.*", "run/eval/*/*/*/*"), _results, True, 0.2),
    "method": Target("methods", ("coliags.yaml", "3dgs.yaml", "reim-nerf.yaml", "pr-endo.yaml"), _method),
    "benchmark": Target("methods", ("benchmark.yaml",), _benchmark),
    "ablation": Target("methods", ("ablation.yaml",), _ablation),
    "prior": Target("depth-maps", ("npy/*", "png/*"), _prior),
    "video": Target("video", ("*",), _video),
    "procedure-page": Target(
        "procedure", ("*.*", "*/*.json", "*/*/*.json", "*/*/images/*", "*/run/eval/*/*.json"), _procedure_page, True
    ),
    "procedure-export": Target(
        "procedure", ("*.json", "*/*/*.json", "*/poses/sparse/0/*"), _procedure_export, True, 0.3
    ),
}


def files_of(target: Target, seeds: Path) -> dict[str, int]:
    """The files that are mutated, each with its share: every pattern has the same."""
    folder, found = seeds / target.seeds, {}
    for pattern in target.files:
        names = sorted(str(path.relative_to(folder)) for path in folder.glob(pattern) if path.is_file())
        for name in names:
            found[name] = found.get(name, 0) + max(1, 1000 // len(names))
    return found
