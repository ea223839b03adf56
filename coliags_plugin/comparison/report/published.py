"""Published numbers of the benchmarks on which the method's paper compares, and when they belong beside ours."""

from __future__ import annotations

from collections.abc import Mapping

from coliags_plugin.comparison.report.study import TestSet
from coliags_plugin.results.record import MAIN_SET

#: Means as printed in the paper of ColIAGS; columns are those of the benchmarks below, one behind the other.
_PRINTED = """
    REIM-NeRF          1.480 33.96 0.86 0.32    0.495 34.34 0.88 0.34    10.96 0.62 0.57
    2DGS               4.839 32.93 0.88 0.24    0.682 32.05 0.88 0.34    19.58 0.87 0.29
    Gaussian-Pancakes  1.222 32.93 0.88 0.24    1.630 32.28 0.88 0.32    20.10 0.88 0.27
    3DGS               0.355 34.10 0.89 0.22    0.333 33.56 0.89 0.29    20.53 0.87 0.26
    Scaffold-GS        0.195 34.26 0.89 0.21    0.215 33.61 0.89 0.29    22.58 0.89 0.22
    PR-Endo            0.674 34.15 0.89 0.23    0.351 34.00 0.89 0.29    21.90 0.87 0.28
    ColIAGS            0.042 36.30 0.91 0.15    0.122 35.58 0.91 0.23    23.29 0.90 0.21
"""
_METRICS = ("depth_mse", "psnr", "ssim", "lpips")
#: Benchmarks by dataset and split: title, metrics, and their first column.
_BENCHMARKS = {
    ("c3vd", "every-8th"): ("C3VD, 22 sequences", _METRICS, 0),
    ("c3vd-endogslam", "endogslam"): ("C3VD with EndoGSLAM's initialisation, 10 sequences", _METRICS, 4),
    ("rotatecolon", "all-train"): ("RotateColon", _METRICS[1:], 8),
}

#: Frames of C3VD's registered sequences (docs/layouts/c3vd.md 6). Folders may have other names.
C3VD_FRAMES: Mapping[str, int] = {
    "cecum_t1_a": 276, "cecum_t1_b": 765, "cecum_t2_a": 370, "cecum_t2_b": 1142, "cecum_t2_c": 595,
    "cecum_t3_a": 730, "cecum_t4_a": 465, "cecum_t4_b": 425, "desc_t4_a": 148, "sigmoid_t1_a": 700,
    "sigmoid_t2_a": 514, "sigmoid_t3_a": 613, "sigmoid_t3_b": 536, "trans_t1_a": 61, "trans_t1_b": 700,
    "trans_t2_a": 194, "trans_t2_b": 103, "trans_t2_c": 235, "trans_t3_a": 250, "trans_t3_b": 214,
    "trans_t4_a": 382, "trans_t4_b": 597,
}  # fmt: skip
_C3VD_SIZE = (338, 270)
_ENDOGSLAM_SEQUENCES = 10
_ROTATECOLON_FRAMES = (381, 223)


def published_for(test_set: TestSet) -> tuple[dict[str, dict[str, str]], str]:
    """Printed means of the benchmark that a test set is, by method and metric, and their source as a sentence.

    Both are empty where it is another, or not all of it.
    """
    by_name = {run.scene: run.result for run, _ in test_set.records}
    scenes = [*by_name.values()]
    dataset, *others = {str(run.data.get("dataset")) for run, _ in test_set.records}
    key, are_different = (dataset, test_set.split), len({result.scene.fingerprint for result in scenes}) == len(scenes)
    if test_set.set_name != MAIN_SET or others or not are_different or key not in _BENCHMARKS:
        return {}, ""
    frames = [(len(result.scene.train), len(result.sets[MAIN_SET].frames)) for result in scenes]  # training, test
    is_whole = {
        "c3vd": {result.scene.size for result in scenes} == {_C3VD_SIZE}
        and sorted(map(sum, frames)) == sorted(C3VD_FRAMES.values()),
        "c3vd-endogslam": len(scenes) == _ENDOGSLAM_SEQUENCES and by_name.keys() <= C3VD_FRAMES.keys(),
        "rotatecolon": frames == [_ROTATECOLON_FRAMES],
    }
    if not is_whole[dataset]:
        return {}, ""
    title, metrics, first = _BENCHMARKS[key]
    rows = [line.split() for line in _PRINTED.split("\n") if line]
    means = {name.replace("Gaussian-", "Gaussian "): numbers[first:] for name, *numbers in rows}
    return (
        {method: dict(zip(metrics, numbers, strict=False)) for method, numbers in means.items()},
        f"published: as printed in the paper of ColIAGS for {title}, trained and evaluated by its authors; not ranked "
        "with ours",
    )
