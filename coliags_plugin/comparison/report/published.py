"""Published numbers of the benchmarks on which the method's paper compares, and when they belong beside ours."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

from coliags_plugin.comparison.report.study import Part
from coliags_plugin.results.record import MAIN_SET, Result

_METHODS = ("REIM-NeRF", "2DGS", "Gaussian Pancakes", "3DGS", "Scaffold-GS", "PR-Endo", "ColIAGS")


@dataclass(frozen=True)
class PublishedBenchmark:
    """Means over a benchmark's scenes as printed in the paper of ColIAGS."""

    title: str
    methods: Mapping[str, Mapping[str, str]]  # printed numbers by method and metric

    @property
    def note(self) -> str:
        """Source of the numbers, as a sentence."""
        return (
            f"published: as printed in the paper of ColIAGS for {self.title}, trained and evaluated by its authors; "
            "not ranked with ours"
        )


def _table(title: str, metrics: tuple[str, ...], *rows: str) -> PublishedBenchmark:
    numbers = {
        method: MappingProxyType(dict(zip(metrics, row.split(), strict=True)))
        for method, row in zip(_METHODS, rows, strict=True)
    }
    return PublishedBenchmark(title, MappingProxyType(numbers))


_C3VD = _table(
    "C3VD, 22 sequences",
    ("depth_mse", "psnr", "ssim", "lpips"),
    "1.480 33.96 0.86 0.32",
    "4.839 32.93 0.88 0.24",
    "1.222 32.93 0.88 0.24",
    "0.355 34.10 0.89 0.22",
    "0.195 34.26 0.89 0.21",
    "0.674 34.15 0.89 0.23",
    "0.042 36.30 0.91 0.15",
)
_C3VD_ENDOGSLAM = _table(
    "C3VD with EndoGSLAM's initialisation, 10 sequences",
    ("depth_mse", "psnr", "ssim", "lpips"),
    "0.495 34.34 0.88 0.34",
    "0.682 32.05 0.88 0.34",
    "1.630 32.28 0.88 0.32",
    "0.333 33.56 0.89 0.29",
    "0.215 33.61 0.89 0.29",
    "0.351 34.00 0.89 0.29",
    "0.122 35.58 0.91 0.23",
)
_ROTATECOLON = _table(
    "RotateColon",
    ("psnr", "ssim", "lpips"),
    "10.96 0.62 0.57",
    "19.58 0.87 0.29",
    "20.10 0.88 0.27",
    "20.53 0.87 0.26",
    "22.58 0.89 0.22",
    "21.90 0.87 0.28",
    "23.29 0.90 0.21",
)

#: Frames of C3VD's registered sequences (docs/layouts/c3vd.md 6). Folders may have other names.
_C3VD_FRAMES = MappingProxyType(
    {
        "cecum_t1_a": 276, "cecum_t1_b": 765, "cecum_t2_a": 370, "cecum_t2_b": 1142, "cecum_t2_c": 595,
        "cecum_t3_a": 730, "cecum_t4_a": 465, "cecum_t4_b": 425, "desc_t4_a": 148, "sigmoid_t1_a": 700,
        "sigmoid_t2_a": 514, "sigmoid_t3_a": 613, "sigmoid_t3_b": 536, "trans_t1_a": 61, "trans_t1_b": 700,
        "trans_t2_a": 194, "trans_t2_b": 103, "trans_t2_c": 235, "trans_t3_a": 250, "trans_t3_b": 214,
        "trans_t4_a": 382, "trans_t4_b": 597,
    }
)  # fmt: skip
_C3VD_SIZE = (338, 270)
_ENDOGSLAM_SEQUENCES = 10
_ROTATECOLON_FRAMES = (381, 223)


def published_for(part: Part) -> PublishedBenchmark | None:
    """Published numbers of the benchmark that a part is; None where it is another, or not all of it."""
    if part.set_name != MAIN_SET:
        return None
    by_name = {run.scene: run.result for run in part.study.runs if part.record(run) is not None}
    scenes = [*by_name.values()]
    frames = [(len(scene.scene.train), len(scene.sets[MAIN_SET].frames)) for scene in scenes]  # training, test
    if _all_of(scenes, "c3vd", "every-8th"):
        sizes = {scene.scene.size for scene in scenes}
        is_whole = sizes == {_C3VD_SIZE} and sorted(map(sum, frames)) == sorted(_C3VD_FRAMES.values())
        return _C3VD if is_whole else None
    if _all_of(scenes, "c3vd-endogslam", "endogslam"):
        named = all(scene.scene.name in _C3VD_FRAMES for scene in scenes)
        return _C3VD_ENDOGSLAM if named and len(scenes) == _ENDOGSLAM_SEQUENCES else None
    return _ROTATECOLON if _all_of(scenes, "rotatecolon", "all-train") and frames == [_ROTATECOLON_FRAMES] else None


def _all_of(scenes: list[Result], dataset: str, split: str) -> bool:
    """Tell whether the scenes are different ones, all of one dataset and split."""
    recorded = [scene.provenance.get("scene") for scene in scenes]
    return (
        len({scene.scene.fingerprint for scene in scenes}) == len(scenes)
        and all(isinstance(own, Mapping) and own.get("dataset") == dataset for own in recorded)
        and all(scene.scene.split == split for scene in scenes)
    )
