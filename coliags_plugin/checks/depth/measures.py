"""Statistics of relative depth errors: over all pixels, by distance, and by stated confidence."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from coliags_plugin.checks.depth.pairing import Samples

#: DepthErrors below this share of the depth are good, as in the definition of the confidence.
WITHIN = 0.05
#: Confidence from which an estimate is rather good than not.
SURE = 0.5
#: Lower edge of a band of distances, scene units; every band is twice as far as the one before.
_BAND_EDGE = 5.0
#: Number of bins of confidence.
_BINS = 10


@dataclass(frozen=True)
class DepthErrors:
    """Relative depth errors of an estimate over the pixels that have a truth; None without such pixels."""

    pixels: int  # their number
    coverage: float  # share of the truth's pixels that have an estimate
    median: float | None = None  # median of |dz| / z
    p90: float | None = None  # 90th percentile of |dz| / z
    within: float | None = None  # share with |dz| / z below 5 %
    bias: float | None = None  # median of dz / z; positive where the estimate is too far
    median_length: float | None = None  # median and 90th percentile of |dz|, units of the truth
    p90_length: float | None = None


@dataclass(frozen=True)
class Band:
    """Depth errors of the pixels with a true depth in [low, high), units of the truth."""

    low: float
    high: float
    errors: DepthErrors


@dataclass(frozen=True)
class ConfidenceBin:
    """Stated confidence of one bin of pixels and the accuracy observed there; bins are [low, high), the last closed."""

    low: float  # ends of the bin
    high: float
    pixels: int  # their number
    stated: float  # mean confidence
    observed: float  # share of them with |dz| / z below 5 %


@dataclass(frozen=True)
class DepthStatistics:
    """Statistics of a set of samples."""

    errors: DepthErrors  # over all of them
    #: the same with only the estimates of a confidence of 0.5 or more; None where there is no confidence
    sure: DepthErrors | None
    bands: list[Band]  # by distance, the nearest first; those without a pixel of known truth are left out
    bins: list[ConfidenceBin]  # by confidence; empty where there is none
    #: expected calibration error: mean of |stated - observed| over the bins of confidence above 0, weighted by their
    #: pixels; None without such pixels
    calibration_error: float | None


def measure(samples: Samples, scale: float = 1.0) -> DepthStatistics:
    """All statistics of samples of one frame or several, the estimates times ``scale``."""
    true = samples.true.astype(np.float64)
    relative = samples.estimated.astype(np.float64) * scale / true - 1.0
    bins = _bins(samples.confidence, relative)
    stated = [entry for entry in bins if entry.high > 0.0]
    total = sum(entry.pixels for entry in stated)
    gap = sum(entry.pixels * abs(entry.stated - entry.observed) for entry in stated)
    sure = None
    if samples.confidence is not None:
        sure = _errors(np.where(samples.confidence >= SURE, relative, np.nan), true)
    return DepthStatistics(_errors(relative, true), sure, _bands(relative, true), bins, gap / total if total else None)


def median_scale(samples: Samples) -> float:
    """Median of true / estimated depth over the pixels, at least one, that have both."""
    known = np.isfinite(samples.estimated)
    return float(np.median(samples.true[known].astype(np.float64) / samples.estimated[known]))


def pooled(parts: Sequence[Samples | None]) -> Samples | None:
    """Samples of several frames concatenated, None without any; where only some have confidence, others count as 0."""
    there = [part for part in parts if part is not None and len(part.true)]
    if not there:
        return None
    confidence = None
    if any(part.confidence is not None for part in there):
        confidence = np.concatenate(
            [np.zeros(len(part.true), np.float32) if part.confidence is None else part.confidence for part in there]
        )
    estimated, true = (np.concatenate(values) for values in zip(*((p.estimated, p.true) for p in there), strict=True))
    return Samples(estimated, true, confidence)


def _errors(relative: Float[np.ndarray, "N"], true: Float[np.ndarray, "N"]) -> DepthErrors:
    known = np.isfinite(relative)
    signed = relative[known]
    coverage = float(known.mean()) if len(known) else 0.0
    if not len(signed):
        return DepthErrors(0, coverage)
    size = np.abs(signed)
    median, p90 = (float(value) for value in np.quantile(size, (0.5, 0.9)))
    lengths = (float(value) for value in np.quantile(size * true[known], (0.5, 0.9)))
    within, bias = float((size < WITHIN).mean()), float(np.median(signed))
    return DepthErrors(len(signed), coverage, median, p90, within, bias, *lengths)


def _bands(relative: Float[np.ndarray, "N"], true: Float[np.ndarray, "N"]) -> list[Band]:
    if not len(true):
        return []
    octaves = np.maximum(np.floor(np.log2(true / _BAND_EDGE)), -1.0)
    bands = []
    for octave in np.unique(octaves):
        inside = octaves == octave
        low = 0.0 if octave < 0 else _BAND_EDGE * 2.0**octave
        bands.append(Band(low, float(_BAND_EDGE * 2.0 ** (octave + 1)), _errors(relative[inside], true[inside])))
    return bands


def _bins(confidence: Float[np.ndarray, "N"] | None, relative: Float[np.ndarray, "N"]) -> list[ConfidenceBin]:
    if confidence is None:
        return []
    known = np.isfinite(relative)
    stated, good = confidence[known].astype(np.float64), np.abs(relative[known]) < WITHIN
    index = np.minimum((stated * _BINS).astype(np.int64), _BINS - 1)
    ends = [(0.0, 0.0, stated == 0.0)]
    ends += [(k / _BINS, (k + 1) / _BINS, (index == k) & (stated > 0.0)) for k in range(_BINS)]
    return [
        ConfidenceBin(low, high, int(inside.sum()), float(stated[inside].mean()), float(good[inside].mean()))
        for low, high, inside in ends
        if inside.any()
    ]
