"""Results made by hand and by hypothesis."""

from __future__ import annotations

from hypothesis import strategies as st

from coliags_plugin.results.hashing import metrics_sha256
from coliags_plugin.results.record import (
    CostRecord,
    MetricRecord,
    ProfileRecord,
    ProtocolRecord,
    Result,
    SceneRecord,
    SetRecord,
)

METRICS = {
    "psnr": MetricRecord(unit="dB", direction="higher"),
    "lpips": MetricRecord(unit="", direction="lower"),
    "depth_mse": MetricRecord(unit="mm^2", direction="lower"),
    "psnr_seen": MetricRecord(unit="dB", direction="higher"),
}
PREDICTIONS, TRUTH = "a" * 64, "b" * 64


def made_set(frames=("0000", "0008"), psnr=(30.0, 31.5), depth_mse=(0.25, None), **changes) -> SetRecord:
    """A test set without LPIPS."""
    values = {"psnr": psnr, "lpips": (None,) * len(frames), "depth_mse": depth_mse}
    facts = {"reasons": {"lpips": "no weights"}, "predictions_sha256": PREDICTIONS, "truth_sha256": TRUTH}
    return SetRecord(**{"frames": frames, "values": values, **facts, **changes})


def made_result(sets=None, **changes) -> Result:
    """A result whose hash fits its values."""
    sets = {"test": made_set()} if sets is None else sets
    facts = {
        "key": "0123456789abcdef",
        "method": "coliags",
        "scene": SceneRecord(name="wall", fingerprint="f", split="every-8th", train=("0001",), size=(32, 24)),
        "protocol": ProtocolRecord(name="paper", version=1),
        "seed": 0,
        "steps": 60,
        "metrics": METRICS,
        "metrics_sha256": metrics_sha256(sets),
        "cost": CostRecord(device="a processor", train_seconds=72.0, gaussians=1234.5),
        "config": {"schedule": {"steps": 60}},
        "software": {"package_version": "1.0"},
    }
    return Result(sets=sets, **{**facts, **changes})


numbers = st.floats(allow_nan=False, allow_infinity=False)
names = st.text(min_size=1, max_size=8)
plain = st.recursive(
    st.none() | st.booleans() | st.integers() | numbers | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(names, inner, max_size=3),
    max_leaves=6,
)


def profiles_of(bins: int) -> st.SearchStrategy[ProfileRecord]:
    """A profile of so many bins."""
    errors = st.tuples(*[st.none() | numbers] * bins)
    pixels = st.tuples(*[st.integers(0, 10**9)] * bins)
    return st.builds(
        ProfileRecord,
        unit=names,
        edges=st.just(tuple(range(bins + 1))),
        pixels=pixels,
        rgb_mse=errors,
        depth_mse=errors,
    )


def sets_of(frames: list[str]) -> st.SearchStrategy[SetRecord]:
    """A test set with these frames, and any of the metrics."""
    values = st.tuples(*[st.none() | numbers] * len(frames))
    return st.builds(
        SetRecord,
        frames=st.just(tuple(frames)),
        values=st.dictionaries(st.sampled_from(sorted(METRICS)), values),
        reasons=st.dictionaries(names, st.text(max_size=8), max_size=2),
        predictions_sha256=st.just(PREDICTIONS),
        truth_sha256=st.just(TRUTH),
        profiles=st.dictionaries(names, st.integers(1, 4).flatmap(profiles_of), max_size=2),
    )


def results() -> st.SearchStrategy[Result]:
    """Any result whose hash fits its values."""
    marks = st.dictionaries(names, st.none() | numbers, max_size=3)
    return st.builds(
        made_result,
        st.dictionaries(names, st.lists(names, max_size=4, unique=True).flatmap(sets_of), min_size=1, max_size=3),
        method=names,
        seed=st.integers(),
        cost=st.builds(CostRecord, device=names, train_seconds=st.none() | numbers, seconds_to_psnr=marks),
        config=st.dictionaries(names, plain, max_size=3),
        provenance=st.dictionaries(names, plain, max_size=3),
    )
