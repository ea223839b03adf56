"""A synthetic procedure with exact truth: phantoms in a row, with contact, blur and wash between them.

python benchmarks/procedure.py make FOLDER
python benchmarks/procedure.py run FOLDER/procedure-6000.mp4 OUT
python benchmarks/procedure.py judge FOLDER OUT
python benchmarks/procedure.py run FOLDER/procedure-1500.mp4 OUT2 --nodes 2 --kill
python benchmarks/procedure.py same OUT1 OUT2

``make`` renders the phantoms, and writes a video for each of the lengths. ``run`` reconstructs one by two processes
here, or on a cluster of nodes of one processor each, of which one may be killed on the way. ``judge`` compares poses,
joins and coverage with the truth, ``same`` the files of two runs.
"""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any, Self

import cv2
import numpy as np
import tyro
from in_vivo import FEWEST, PREDICTED, REACH, WRONG_DEG, WRONG_FACTOR, WRONG_MM, path_length
from machine import markdown_table, show
from scipy.spatial.transform import Rotation

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.images import read_rgb
from coliags_plugin.core.json_files import read_json
from coliags_plugin.core.scene_files import read_intrinsics
from coliags_plugin.datamanagers.colmap import read_atlas
from coliags_plugin.datamanagers.file_formats import C3VD_DEPTH
from coliags_plugin.geometry.lenses.models import PinholeLens
from coliags_plugin.geometry.meshes.mesh import TriangleMesh, read_mesh
from coliags_plugin.geometry.meshes.truth import TrueSurface, compare_meshes
from coliags_plugin.geometry.poses.alignment import Similarity
from coliags_plugin.geometry.poses.colmap import model_suffix, read_images, read_points
from coliags_plugin.geometry.poses.trajectory import inverse, rigid
from coliags_plugin.pipeline.contents import SegmentContents, SubmapContents, read_contents
from coliags_plugin.pipeline.joins import ModelKey, SegmentJoin
from coliags_plugin.pipeline.stages import Record
from coliags_plugin.reporting.video import write_video
from coliags_plugin.surface.coverage.measure import PartialCoverage, measure_coverage
from coliags_plugin.surface.coverage.visibility import CoverageSettings, CoverageView, Level

#: Of each phantom: seeds count from here; lengths of the withdrawals, mm; frames, and frames between two phantoms.
SEED, LENGTHS, FRAMES, BETWEEN = 4100, (60, 45, 55, 35, 60, 50, 40, 60), 700, 50
SETTINGS: dict[str, Any] = {
    "preset": "in-vivo", "frames": FRAMES, "width": 192, "height": 192, "rotation_views": 0, "polyps": 2,
    "frame_rate": 30.0, "turns": 7, "contacts": 2, "washes": 1, "mesh_spacing": 1.0, "texture_spacing": 0.2,
}  # fmt: skip
RATE = 30.0


@dataclass(frozen=True)
class Make:
    """Command that renders the phantoms and writes the videos."""

    folder: tyro.conf.Positional[Path]
    """Output folder; phantoms and videos that it holds already are kept."""
    lengths: tuple[int, ...] = (1500, 3000, 6000)
    """Frames of the videos: each is the beginning of the next."""

    def run(self) -> None:
        """Render the phantoms and write the videos that are missing."""
        from coliags_plugin.api.scenes import make_phantom

        for number, length in enumerate(LENGTHS[: -(-max(self.lengths) // (FRAMES + BETWEEN))]):
            if not (self.folder / f"phantom-{number}").is_dir():
                make_phantom(
                    self.folder / f"phantom-{number}", **SETTINGS, seed=SEED + number, path_length=float(length)
                )
        for length in self.lengths:
            video = self.folder / f"procedure-{length}.mp4"
            if not video.is_file():
                frames = (image for image, _ in zip(_frames(self.folder), range(length), strict=False))
                write_video(frames, video, RATE)


def _frames(folder: Path) -> Iterator[np.ndarray]:
    """Frames of all phantoms, and between two of them by turns wall contact, fast motion and a wash."""
    rng = np.random.default_rng(0)
    for number in range(len(LENGTHS)):
        files = sorted((folder / f"phantom-{number}" / "images").glob("*.png"))
        for file in files:
            yield read_rgb(file)
        following = folder / f"phantom-{number + 1}" / "images"
        after = read_rgb(min(following.glob("*.png")) if following.is_dir() else files[0])
        last = read_rgb(files[-1])
        disturbed = (_contact, _fast, _washed)[number % 3]
        for place in np.linspace(0.0, 1.0, BETWEEN):
            yield disturbed(last if place < 0.5 else after, float(1.0 - abs(2.0 * place - 1.0)), rng)


def _contact(image: np.ndarray, strength: float, rng: np.random.Generator) -> np.ndarray:
    """Wall contact: an image out of focus, red and overexposed."""
    blurred = cv2.GaussianBlur(image, (0, 0), 0.1 + 40.0 * min(1.0, 4.0 * strength)).astype(np.float32)
    share = 0.8 * min(1.0, 2.0 * strength)
    return _noisy((1.0 - share) * blurred + share * np.array([235.0, 120.0, 95.0]), rng)


def _fast(image: np.ndarray, strength: float, rng: np.random.Generator) -> np.ndarray:
    """Motion blur along a random direction, of an image shifted by a random amount."""
    size, angle = image.shape[0], rng.uniform(0.0, np.pi)
    length = max(3, round(0.5 * size * min(1.0, 3.0 * strength)))
    kernel = np.zeros((length, length), np.float32)
    reach = 0.5 * (length - 1) * np.array([np.cos(angle), np.sin(angle)])
    ends = [tuple(np.rint(0.5 * (length - 1) + sign * reach).astype(int).tolist()) for sign in (-1, 1)]
    cv2.line(kernel, ends[0], ends[1], 1.0)
    moved = np.roll(image, rng.integers(-size // 2, size // 2, 2) if strength > 0.1 else (0, 0), (0, 1))
    return _noisy(cv2.filter2D(moved.astype(np.float32), -1, kernel / kernel.sum()), rng)


def _washed(image: np.ndarray, strength: float, rng: np.random.Generator) -> np.ndarray:
    """Wash: a random smooth distortion of an image, blur and glare."""
    height, width = image.shape[:2]
    shifts = 300.0 * min(1.0, 3.0 * strength) * rng.standard_normal((2, height, width)).astype(np.float32)
    columns, rows = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
    moved = [grid + cv2.GaussianBlur(shift, (0, 0), 8.0) for grid, shift in zip((columns, rows), shifts, strict=True)]
    seen = cv2.remap(image, moved[0], moved[1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT_101).astype(np.float32)
    glare = cv2.GaussianBlur(rng.random((height, width)).astype(np.float32), (0, 0), 6.0)
    glare = strength * 160.0 * np.clip((glare - glare.mean()) / glare.std() - 0.8, 0.0, 1.0)
    return _noisy(cv2.GaussianBlur(seen, (0, 0), 0.1 + 3.0 * strength) + glare[..., None], rng)


def _noisy(image: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    return np.clip(np.rint(image + rng.normal(0.0, 1.5, image.shape)), 0, 255).astype(np.uint8)


#: Options of ``coliags reconstruct``: little training, and no surface of what is posed for less than a second.
OPTIONS = ("--set", "frames.segment=400", "--set", "least_submap=30", "--diameter", "40", "--steps", "100")
#: Names of files that hold times or places, or what ended a worker.
_TIMED = (
    *("reconstruction.json", "metrics.jsonl", "provenance.json", "result.json", "*.log", "*.html", ".*", "costs*"),
    *("check.json", "state.json", "SHA256SUMS"),
)


@dataclass(frozen=True)
class Run:
    """Command that reconstructs a video by two processes of one thread, and prints time and memory."""

    video: tyro.conf.Positional[Path]
    """The video."""
    out: tyro.conf.Positional[Path]
    """New folder of the procedure."""
    nodes: int = 0
    """Nodes of a Ray cluster on this machine, of one processor each; 0: no cluster, two processes."""
    kill: bool = False
    """Whether a node is killed, and another one added, when a third of the segments have poses."""

    def run(self) -> None:
        """Reconstruct."""
        if self.kill and not self.nodes:
            raise InputError("--kill without --nodes", "a cluster whose node can be killed")
        command = [sys.executable, "-c", "from coliags_plugin.cli import main; main()", "reconstruct", str(self.video)]
        command += ["--output", str(self.out), *OPTIONS, "--jobs", "2", "--threads", "1"]
        start = time.monotonic()
        with _cluster(self.nodes) if self.nodes else nullcontext() as cluster:
            if cluster is not None:
                command += ["--executor", "ray", "--ray-address", cluster.address]
            child = subprocess.Popen(command, env={**os.environ, "OMP_NUM_THREADS": "1"})
            if self.kill:
                self._disturb(cluster, child)
            _, status, used = os.wait4(child.pid, 0)
        row = {"status": status, "wall, s": time.monotonic() - start}
        if not self.nodes:  # whose workers are not children
            row |= {"CPU, s": used.ru_utime + used.ru_stime, "largest process, MB": used.ru_maxrss / 1024}
        print(markdown_table([row]))

    def _disturb(self, cluster: Any, child: subprocess.Popen[bytes]) -> None:
        """Kill a node while it works, and add another one."""
        while child.poll() is None:
            record, posed = Record.of(self.out), len(list(self.out.glob("segment-*/poses")))
            segments = read_contents(self.out, record).segments if record.is_done("survey") else ()
            if segments and 3 * posed >= len(segments):
                print(f"a node is killed after {posed} of {len(segments)} segments", flush=True)
                cluster.remove_node(cluster.worker_nodes.copy().pop(), allow_graceful=False)
                cluster.add_node(num_cpus=1)
                return
            time.sleep(1.0)


@contextmanager
def _cluster(nodes: int) -> Iterator[Any]:
    """Nodes of one processor each, and a head that does no work."""
    from ray.cluster_utils import Cluster

    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 0, "include_dashboard": False})
    try:
        for _ in range(nodes):
            cluster.add_node(num_cpus=1)
        cluster.wait_for_nodes(timeout=120)
        yield cluster
    finally:
        cluster.shutdown()


@dataclass(frozen=True)
class Same:
    """Command that compares the files of two folders byte by byte, but those that hold times."""

    first: tyro.conf.Positional[Path]
    """One folder."""
    second: tyro.conf.Positional[Path]
    """The other."""

    def run(self) -> None:
        """Print how many are equal, and which are not."""
        one, other = (
            {path.relative_to(folder): path for path in folder.rglob("*") if path.is_file()}
            for folder in (self.first, self.second)
        )
        names = [name for name in sorted(one | other) if not any(name.match(pattern) for pattern in _TIMED)]
        differ = [
            name
            for name in names
            if name not in one or name not in other or one[name].read_bytes() != other[name].read_bytes()
        ]
        print(f"{len(names) - len(differ)} of {len(names)} files are equal")
        print("\n".join(map(str, differ)))


#: What is measured of a sub-map where it can be.
_MEASURED = (
    "path, mm", "ATE, mm", "rotation, degrees", "scale", "scale varies, %", "depth of points, %", "wall seen, mm2",
    "there, %", "measured - true unseen, %",
)  # fmt: skip


@dataclass(frozen=True)
class Judge:
    """Command that compares poses, joins, meshes and coverage of a procedure with the truth."""

    folder: tyro.conf.Positional[Path]
    """Of the phantoms."""
    out: tyro.conf.Positional[Path]
    """Of the procedure."""
    json: Path | None = None
    """Also write the rows of the sub-maps here."""

    def run(self) -> None:
        """Print the tables."""
        contents, truth = read_contents(self.out), Truth(self.folder)
        models = {one.key: truth.model(self.out, one) for one in contents.submaps}
        rows = [truth.row(self.out, one, models[one.key]) for one in contents.submaps]
        numbers = np.arange(contents.video.first, contents.video.stop)
        is_tissue, is_posed = truth.phantom(numbers) >= 0, np.isin(numbers, list(contents.posed))
        segments = [truth.is_wrong(join, models) for join in contents.joins if join.joined]
        within = [wrong for one in contents.segments for wrong in truth.wrong_within(self.out, one, models)]
        show(rows, self.json)
        print()
        counts = {
            "frames": len(numbers),
            "of tissue": is_tissue.sum(),
            "of these posed, %": 100.0 * is_posed[is_tissue].mean(),
            "others posed": is_posed[~is_tissue].sum(),
            "sub-maps": len(rows),
            "meshes": sum(row["wall seen, mm2"] is not None for row in rows),
            "ATE, mm": _spread(rows, "ATE, mm"),
            "rotation, degrees": _spread(rows, "rotation, degrees"),
            "depth of points, %": _spread(rows, "depth of points, %"),
            "scale within sub-maps varies, %": _spread(rows, "scale varies, %"),
            "scale of sub-maps, of mm": _spread(rows, "scale"),
            "poses of another phantom": sum(row["of another"] for row in rows),
            "joins of segments": _told(segments),
            "refused": sum(not join.joined for join in contents.joins),
            "joins within models": _told(within),
            "wall seen that is there, %": _spread(rows, "there, %"),
            "measured - true unseen, %": _spread(rows, "measured - true unseen, %"),
        }
        print(markdown_table([{"of the procedure": what, "": value} for what, value in counts.items()]))


@dataclass(frozen=True)
class Model:
    """Poses and scales of the frames of a sub-map."""

    frames: np.ndarray  # numbers of the frames, ascending [N]
    poses: np.ndarray  # camera to world [N, 4, 4]
    scales: np.ndarray  # median ratio of the true depth to that of the points that the frame sees; NaN: unknown [N]
    errors: np.ndarray  # median error of their depths at that scale, % [N]

    def moved(self, transform: np.ndarray) -> Self:
        """In another world, by a similarity."""
        scale = float(np.cbrt(np.linalg.det(transform[:3, :3])))
        poses = transform @ self.poses
        poses[:, :3, :3] /= scale
        return replace(self, poses=poses, scales=self.scales / scale)

    def part(self, kept: np.ndarray | slice) -> Self:
        """Some of the frames."""
        return type(self)(self.frames[kept], self.poses[kept], self.scales[kept], self.errors[kept])

    def beside(self, other: Self) -> Self:
        """With those frames of another that this has not, in order."""
        new = other.part(~np.isin(other.frames, self.frames))
        order = np.argsort(np.concatenate([self.frames, new.frames]))
        pairs = ((getattr(self, name), getattr(new, name)) for name in ("frames", "poses", "scales", "errors"))
        return type(self)(*(np.concatenate(pair)[order] for pair in pairs))

    def placed(self, truth: np.ndarray) -> Similarity:
        """The similarity to true poses: by orientations and depths, as short ways tell neither rotation nor scale."""
        turn = Rotation.from_matrix(truth[:, :3, :3] @ self.poses[:, :3, :3].transpose(0, 2, 1)).mean()
        scale = float(np.nanmedian(self.scales))
        shift = (truth[:, :3, 3] - scale * turn.apply(self.poses[:, :3, 3])).mean(0)
        return Similarity(scale, turn.as_matrix(), shift)


def _degrees(true: np.ndarray, poses: np.ndarray) -> float:
    """Median angle between orientations."""
    turns = Rotation.from_matrix(true[:, :3, :3]).inv() * Rotation.from_matrix(poses[:, :3, :3])
    return float(np.degrees(np.median(turns.magnitude())))


class Truth:
    """Poses relative to the wall in view of all frames, each in the world of its phantom, depths, and walls at rest."""

    def __init__(self, folder: Path) -> None:
        self._folders = sorted(folder.glob("phantom-*"))
        between = np.full((BETWEEN, 4, 4), np.nan)
        poses = [np.load(phantom / "truth" / "camera_to_wall.npy") for phantom in self._folders]
        self._poses = np.concatenate([part for own in poses for part in (own, between)])

    def model(self, out: Path, submap: SubmapContents) -> Model:
        """A sub-map of a procedure, with its scales."""
        folder = out / submap.segment / "poses" / submap.model
        suffix = model_suffix(folder, ("images", "points3D"))
        places = {point.number: point.position for point in read_points(folder / f"points3D{suffix}")}
        images = {image.name: image for image in read_images(folder / f"images{suffix}")}
        numbers = [number for number, name in submap.names.items() if name in images]
        to_camera, scales, errors = [], [], []
        for number in numbers:
            image = images[submap.names[number]]
            turn = Rotation.from_quat(image.quat_wxyz, scalar_first=True).as_matrix()
            to_camera.append(rigid(turn[None], np.array([image.translation]))[0])
            known = np.isin(image.points, list(places))
            points = np.array([places[point] for point in image.points[known].tolist()]).reshape(-1, 3)
            ratios = self._depths(number, image.observed[known]) / (points @ turn[2] + image.translation[2])
            ratios = ratios[np.isfinite(ratios) & (ratios > 0.0)]
            scales.append(float(np.median(ratios)) if len(ratios) else np.nan)
            errors.append(100.0 * float(np.median(np.abs(ratios / scales[-1] - 1.0))) if len(ratios) else np.nan)
        return Model(np.array(numbers), inverse(np.stack(to_camera)), np.array(scales), np.array(errors))

    def _depths(self, number: int, pixels: np.ndarray) -> np.ndarray:
        """Ground-truth z-depth at pixels of a frame, mm; NaN where it is unknown. [K]"""
        phantom, index = divmod(number, FRAMES + BETWEEN)
        if index >= FRAMES:
            return np.full(len(pixels), np.nan)
        depth, _ = C3VD_DEPTH.decode(C3VD_DEPTH.read(self._folders[phantom] / "depths" / f"{index:04d}_depth.png"))
        column, row = np.clip(pixels.astype(int), 0, np.array(depth.shape[::-1]) - 1).T
        return np.asarray(depth[row, column])

    def phantom(self, numbers: np.ndarray) -> np.ndarray:
        """Number of the phantom that each frame shows; -1 between two. [N]"""
        return np.where(numbers % (FRAMES + BETWEEN) < FRAMES, numbers // (FRAMES + BETWEEN), -1)

    def row(self, out: Path, submap: SubmapContents, model: Model) -> dict[str, Any]:
        """Poses, mesh and coverage of a sub-map, aligned with the phantom that most of its frames show."""
        shown = self.phantom(model.frames)
        most = int(np.bincount(shown[shown >= 0], minlength=1).argmax())
        model = model.part(shown == most)
        row: dict[str, Any] = {
            "sub-map": submap.name,
            "phantom": most,
            "frames": len(shown),
            "of another": len(shown) - len(model.frames),
        } | dict.fromkeys(_MEASURED)
        if len(model.frames) < FEWEST:
            return row
        true = self._poses[model.frames]
        fit = model.placed(true)
        row |= {
            "path, mm": path_length(true),
            "ATE, mm": float(np.sqrt(np.square(fit.points(model.poses[:, :3, 3]) - true[:, :3, 3]).sum(1).mean())),
            "rotation, degrees": _degrees(true, fit.rotation @ model.poses[:, :3, :3]),
            "scale": fit.scale,
            "scale varies, %": 100.0 * float(np.nanstd(np.log(model.scales))),
            "depth of points, %": float(np.nanmedian(model.errors)),
        }
        run = out / submap.folder / "run"
        if not (run / "coverage" / "coverage.json").is_file():
            return row
        lens = PinholeLens.of(read_intrinsics(self._folders[most] / "camera.json"))
        wall = _wall(self._folders[most] / "truth" / "mesh.ply")
        views = [CoverageView(str(number), self._poses[number], lens) for number in model.frames]
        of_wall = measure_coverage(wall, views, CoverageSettings())
        seen = of_wall.views.seen[: len(wall)]  # guessed wall is behind it
        mesh = read_mesh(run / "mesh" / "mesh.ply")
        mesh = replace(mesh, vertices=fit.points(mesh.vertices))
        try:
            compared = compare_meshes(mesh, TrueSurface(run, wall, seen, "cast rays"), samples=20_000)
        except InputError:  # elsewhere
            return row | {"wall seen, mm2": wall.areas[seen].sum(), "there, %": 0.0}
        row |= {"wall seen, mm2": compared.seen_area, "there, %": 100.0 * compared.scores[-1].recall}
        measured = read_json(run / "coverage" / "coverage.json", "coverage")["seen"]
        if measured is None or isinstance(of_wall, PartialCoverage):
            return row
        unseen = of_wall.area(of_wall.level == Level.UNSEEN) / of_wall.area()
        return row | {"measured - true unseen, %": 100.0 * (1.0 - measured - unseen)}

    def is_wrong(self, join: SegmentJoin, models: Mapping[ModelKey, Model]) -> bool | None:
        """Whether a join of two segments contradicts the true poses; None for too few frames."""
        first, second = (models[key] for key in join.keys)
        return self._wrong(first.beside(second.moved(np.array(join.transform))), int(first.frames.max()))

    def wrong_within(self, out: Path, segment: SegmentContents, models: Mapping[ModelKey, Model]) -> list[bool | None]:
        """Whether each join within the models of a segment contradicts the true poses; None for too few frames."""
        atlas, numbers = read_atlas(out / segment.span.name / "poses"), {name: n for n, name in segment.used.items()}
        after = [numbers[atlas.frames[place.after]] for place in atlas.joins if place.joined] if atlas else []
        owners = [[one for one in segment.submaps if number in one.names] for number in after]
        return [self._wrong(models[own[0].key], number) for own, number in zip(owners, after, strict=True) if own]

    def _wrong(self, model: Model, after: int) -> bool | None:
        """Whether the longer side of a join, aligned with the true poses, mispredicts the other's nearest frames."""
        model = model.part(self.phantom(model.frames) >= 0)
        shown = self.phantom(model.frames)
        before, behind = np.flatnonzero(model.frames <= after)[-REACH:], np.flatnonzero(model.frames > after)[:REACH]
        if min(len(before), len(behind)) < FEWEST:
            return None
        if shown[before[-1]] != shown[behind[0]]:
            return True
        sides = [model.part(side[shown[side] == shown[before[-1]]]) for side in (before, behind)]
        forwards = len(before) >= len(behind)
        longer, other = sides if forwards else sides[::-1]
        other = other.part(slice(PREDICTED) if forwards else slice(-PREDICTED, None))
        fit, true = longer.placed(self._poses[longer.frames]), self._poses[other.frames]
        off = np.linalg.norm(fit.points(other.poses[:, :3, 3]) - true[:, :3, 3], axis=1)
        return bool(
            _degrees(true, fit.rotation @ other.poses[:, :3, :3]) > WRONG_DEG
            or np.median(off) > WRONG_MM
            or abs(np.log(np.nanmedian(other.scales) / fit.scale)) > np.log(WRONG_FACTOR)
        )


@cache
def _wall(path: Path) -> TriangleMesh:
    return read_mesh(path)


def _told(wrong: Sequence[bool | None]) -> str:
    counts = [sum(one is value for one in wrong) for value in (False, True, None)]
    return "{} right, {} wrong, {} not judged".format(*counts)


def _spread(rows: Sequence[Mapping[str, Any]], key: str) -> str:
    values = [row[key] for row in rows if row[key] is not None]
    if not values:
        return ""
    return f"{np.median(values):.2f} (median of {len(values)}), {min(values):.2f} to {max(values):.2f}"


Options = Make | Run | Judge | Same


def main(options: Options) -> None:
    """Run the chosen command."""
    options.run()


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
