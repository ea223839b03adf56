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


@st.composite
def profile_records(draw) -> ProfileRecord:
    """A profile of one to four bins."""
    bins = draw(st.integers(1, 4))
    errors = st.tuples(*[st.none() | numbers] * bins)
    return ProfileRecord(
        unit="mm",
        edges=tuple(range(bins + 1)),
        pixels=draw(st.tuples(*[st.integers(0, 10**9)] * bins)),
        rgb_mse=draw(errors),
        depth_mse=draw(errors),
    )


@st.composite
def set_records(draw) -> SetRecord:
    """A test set with any frames, and any of the metrics."""
    frames = draw(st.lists(names, max_size=4, unique=True))
    values = st.tuples(*[st.none() | numbers] * len(frames))
    listed = draw(st.lists(st.sampled_from(sorted(METRICS)), unique=True))
    return SetRecord(
        frames=tuple(frames),
        values={name: draw(values) for name in listed},
        reasons=draw(st.dictionaries(names, st.text(max_size=8), max_size=2)),
        predictions_sha256=PREDICTIONS,
        truth_sha256=TRUTH,
        profiles=draw(st.dictionaries(names, profile_records(), max_size=2)),
    )


@st.composite
def results(draw) -> Result:
    """Any result whose hash fits its values."""
    cost = CostRecord(
        device=draw(st.text(max_size=8)),
        train_seconds=draw(st.none() | numbers),
        seconds_to_psnr=draw(st.dictionaries(names, st.none() | numbers, max_size=3)),
    )
    return made_result(
        draw(st.dictionaries(names, set_records(), min_size=1, max_size=3)),
        method=draw(names),
        seed=draw(st.integers()),
        cost=cost,
        config=draw(st.dictionaries(names, plain, max_size=3)),
        provenance=draw(st.dictionaries(names, plain, max_size=3)),
    )
