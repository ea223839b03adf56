"""Digests of what short runs of every method end in, to prove that a change of the code changes no result.

    python -m tests.engine.fingerprints --data PHANTOM --out before.json
    python -m tests.engine.fingerprints --data PHANTOM --out after.json --compare before.json

Each run is taken to its end, then resumed from its middle and taken there again. Digests are compared without the
tensors' names, which a refactoring may change. They hold for one machine and one set of library versions.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from safetensors.torch import load_file

from coliags_plugin.config.method_config import load_method, method_files

STEPS = 60
#: Few pixels, few anchors, and growth from the first steps on.
SETTINGS = (
    *("datamanager.width=84", "datamanager.height=67", "datamanager.points_count=5000"),
    *(f"schedule.written_for={STEPS}", "schedule.checkpoint_every=30", "schedule.log_every=1"),
)
#: Growth within so few steps, by strategy.
GROWTH = {
    "anchor-growth": (
        *("strategy.statistics_from=0", "strategy.growth_from=2", "strategy.until=50", "strategy.every=10"),
        *("strategy.gradient_threshold=1e-6", "strategy.pixels_per_birth=100"),
    ),
    "adaptive-density": (
        *("strategy.densify_from=2", "strategy.until=50", "strategy.every=10", "strategy.reset_every=25"),
        "strategy.gradient_threshold=1e-4",
    ),
}
RENDERERS = ("torch",)


def coliags(*argv: object) -> None:
    """Run a ``coliags`` command, or stop with what it said."""
    command = [sys.executable, "-c", "from coliags_plugin.cli import main; main()", *map(str, argv)]
    process = subprocess.run(command, capture_output=True, text=True, check=False)
    if process.returncode:
        sys.exit(f"{' '.join(map(str, argv))}:\n{process.stderr}")


def digests(run: Path) -> list[str]:
    """Shape and SHA-256 of every tensor of the last checkpoint, sorted."""
    tensors = load_file(run / "checkpoints" / f"step-{STEPS:06d}" / "state.safetensors").values()
    return sorted(f"{list(tensor.shape)} {hashlib.sha256(tensor.numpy().tobytes()).hexdigest()}" for tensor in tensors)


def fingerprint(data: Path, method: str, seed: int, changes: tuple[str, ...], folder: Path) -> dict[str, object]:
    """Digest of the state that a run ends in, and of a resumed one."""
    run = folder / "run"
    shutil.rmtree(run, ignore_errors=True)
    growth = GROWTH.get(load_method(method).config.strategy.name, ())
    words = [word for change in (*SETTINGS, *growth, *changes) for word in ("--set", change)]
    coliags("train", method, "--data", data, "--seed", seed, "--steps", STEPS, "--output", run, *words)
    straight = digests(run)
    shutil.rmtree(run / "checkpoints" / f"step-{STEPS:06d}")
    coliags("train", method, "--data", data, "--output", run, "--resume")
    rows = [json.loads(line) for line in (run / "metrics.jsonl").read_text(encoding="utf-8").splitlines()]
    return {
        "tensors": straight,
        "resumed_alike": digests(run) == straight,
        "grown": sum(row.get("grown", 0) for row in rows),
        "last_loss": rows[-1]["loss"],
    }


def main() -> None:
    """Take the fingerprints, write them, and compare."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--methods", nargs="*", default=sorted(method_files()))
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--compare", type=Path)
    options = parser.parse_args()
    jobs = [(method, seed, ()) for method in options.methods for seed in range(options.seeds)]
    jobs += [("coliags", 0, (f"renderer.name={name}",)) for name in RENDERERS]
    before = json.loads(options.compare.read_text(encoding="utf-8")) if options.compare else {}
    fingerprints = {}
    with tempfile.TemporaryDirectory() as folder:
        for method, seed, changes in jobs:
            key = " ".join([method, str(seed), *changes])
            fingerprints[key] = fingerprint(options.data, method, seed, changes, Path(folder))
            verdict = "new" if key not in before else "same" if fingerprints[key] == before[key] else "DIFFERENT"
            print(
                f"{key}: grown {fingerprints[key]['grown']}, resumed {fingerprints[key]['resumed_alike']} {verdict}",
                flush=True,
            )
            options.out.write_text(json.dumps(fingerprints, indent=1) + "\n", encoding="utf-8")
    sys.exit(any(fingerprints[key] != before[key] for key in before.keys() & fingerprints.keys()))


if __name__ == "__main__":
    main()
