"""Results made by hand."""

from __future__ import annotations

from coliags_plugin.results.hashing import metrics_sha256
from coliags_plugin.results.record import (
    CostRecord,
    MetricRecord,
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
