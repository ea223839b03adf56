"""Measures of predicted against true unseen surface, on one mesh."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from coliags_plugin.surface.coverage.regions import large_regions


@dataclass(frozen=True)
class CoverageScores:
    """How well unseen surface was found; shares of area in [0, 1], None where there is no such surface.

    Attributes:
        face_iou: Intersection over union of predicted and true unseen surface.
        region_iou: Intersection over union of each true region with the predicted regions that overlap it, other true
            regions left out; mean weighted by area.
        mean_region_iou: The same, every region counting alike.
        recall: Share of the true regions of whose area at least half is predicted unseen.
        false_reassurance: Share of the unseen surface that is called seen.
        false_alarm: Share of the surface called unseen that was seen.
        unseen_among_called_seen: Share of the surface called seen that is unseen.
        called_unseen_among_seen: Share of the seen surface that is called unseen.
        true_regions, predicted_regions: Numbers of regions.
    """

    face_iou: float | None
    region_iou: float | None
    mean_region_iou: float | None
    recall: float | None
    false_reassurance: float | None
    false_alarm: float | None
    unseen_among_called_seen: float | None
    called_unseen_among_seen: float | None
    true_regions: int
    predicted_regions: int

    @property
    def main_scores(self) -> dict[str, float | None]:
        """Those of texts and tables, by their names."""
        return {
            "face IoU": self.face_iou,
            "region IoU": self.region_iou,
            "recall": self.recall,
            "false reassurance": self.false_reassurance,
            "false alarm": self.false_alarm,
        }

    def as_json(self) -> dict[str, float | int | None]:
        """By name."""
        return asdict(self)


def score_unseen(
    predicted: Bool[np.ndarray, "F"],
    true: Bool[np.ndarray, "F"],
    areas: Float[np.ndarray, "F"],
    pairs: Int[np.ndarray, "E 2"],
    smallest: float,
) -> CoverageScores:
    """Compare predicted with true unseen triangles; only regions larger than ``smallest`` mm^2 are regions.

    Triangles of area 0 do not count; ``pairs`` are those with a common edge.
    """
    counted = areas > 0.0
    predicted, true = predicted & counted, true & counted

    def share(part: Bool[np.ndarray, "F"], whole: Bool[np.ndarray, "F"]) -> float | None:
        total = float(areas[whole].sum())
        return float(areas[part & whole].sum()) / total if total else None

    truth = large_regions(true, pairs, areas, smallest)
    called = large_regions(predicted, pairs, areas, smallest)
    caught = [float(areas[region[predicted[region]]].sum()) >= 0.5 * float(areas[region].sum()) for region in truth]
    ious = _region_ious(truth, called, areas)
    return CoverageScores(
        face_iou=share(predicted & true, predicted | true),
        region_iou=float(np.average(ious, weights=[areas[region].sum() for region in truth])) if ious else None,
        mean_region_iou=float(np.mean(ious)) if ious else None,
        recall=float(np.mean(caught)) if caught else None,
        false_reassurance=share(~predicted, true),
        false_alarm=share(~true, predicted),
        unseen_among_called_seen=share(true, counted & ~predicted),
        called_unseen_among_seen=share(predicted, counted & ~true),
        true_regions=len(truth),
        predicted_regions=len(called),
    )


def _region_ious(
    truth: Sequence[Int[np.ndarray, "K"]], called: Sequence[Int[np.ndarray, "K"]], areas: Float[np.ndarray, "F"]
) -> list[float]:
    """Of each true region with all predicted regions that overlap it, leaving out the surface of other true regions.

    The adjusted sIoU of Chan et al., SegmentMeIfYouCan, NeurIPS 2021 Datasets and Benchmarks.
    """
    owner = np.full(len(areas), -1)
    for number, region in enumerate(truth):
        owner[region] = number
    common, more = np.zeros(len(truth)), np.zeros(len(truth))
    for region in called:
        inside = region[owner[region] >= 0]
        overlap = np.bincount(owner[inside], areas[inside], minlength=len(truth))
        common += overlap
        more[overlap > 0.0] += areas[region[owner[region] < 0]].sum()
    whole = np.array([areas[region].sum() for region in truth])
    return [float(value) for value in common / (whole + more)]
