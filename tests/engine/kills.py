"""Kill a run with SIGKILL again and again, resume it, and compare with one that nobody disturbed.

    python -m tests.engine.kills --kills 50

One life of a run is train, eval, render and report. An attempt at a life is killed at a random moment, or the moment a
file or folder of a random kind is being written beside its place; the next attempt goes on, until the life is complete
and its results are compared. Then a new life begins, until there were as many kills as asked for.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

import torch

from coliags_plugin.engine.checkpoints import latest_checkpoint, newest_checkpoint, read_checkpoint
from coliags_plugin.engine.run_folder import RunFolder
from coliags_plugin.results.reading import RESULT_FILE, read_result

METHOD = "coliags"
STEPS = 24
SETTINGS = (
    *("field.features=8", "field.children=4", "field.voxel_size=4"),
    *("schedule.checkpoint_every=2", "schedule.log_every=1", f"schedule.written_for={STEPS}"),
    *("strategy.statistics_from=0", "strategy.growth_from=2", "strategy.until=16", "strategy.every=3"),
    *("strategy.gradient_threshold=1e-6", "strategy.pixels_per_birth=100"),
)
CLOCK = "clock"
#: Scratch names of a stage hold one of these; a kill waits for one, or for a moment of the clock.
MOMENTS = (CLOCK, CLOCK, "step-", ".run.", "metrics.jsonl", "paper", "renders", "report.html")


@dataclass
class Kills:
    """Kills so far, by the stage they hit, and how many lives were lived to the end."""

    stages: Counter[str] = field(default_factory=Counter)
    moments: Counter[str] = field(default_factory=Counter)
    lives: int = 0

    @property
    def count(self) -> int:
        """Kills in all."""
        return sum(self.stages.values())


def coliags(*argv: object) -> list[str]:
    """A ``coliags`` command line."""
    return [sys.executable, "-c", "from coliags_plugin.cli import main; main()", *map(str, argv)]


def stages(data: Path, run: Path) -> dict[str, list[str]]:
    """The commands of one life, as a user would give them after whatever happened before."""
    train = ["train", METHOD, "--data", data, "--output", run]
    if (run / "config.yaml").is_file():
        train += ["--resume"]
    else:
        train += ["--steps", STEPS, *(word for setting in SETTINGS for word in ("--set", setting))]
    return {
        "train": coliags(*train),
        "eval": coliags("eval", run),
        "render": coliags("render", run, "--overwrite"),
        "report": coliags("report", run, "--output", run.parent / "report.html"),
    }


def attempt(data: Path, run: Path, moment: str, after: float) -> str | None:
    """Live a life until the moment comes; the stage that was killed, or None where the life was complete before."""
    began, left = time.monotonic(), scratch(run)
    for stage, command in stages(data, run).items():
        process = subprocess.Popen(
            command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, start_new_session=True
        )
        while process.poll() is None:
            if moment == CLOCK:
                now = time.monotonic() - began > after
            else:
                now = any(moment in name for name in scratch(run) - left)
            if now:
                os.killpg(process.pid, signal.SIGKILL)
                process.communicate()
                return stage
            time.sleep(0.0005)
        _, errors = process.communicate()
        if process.returncode != 0:
            raise AssertionError(f"{stage} ended with {process.returncode}:\n{errors}")
    return None


def scratch(run: Path) -> set[str]:
    """Names of everything that is being written beside its place, or was when a kill came."""
    folders = (run.parent, run, run / "checkpoints", run / "eval")
    return {path.name for folder in folders for path in folder.glob(".*")}


def check_whole(run: Path) -> None:
    """Whatever lies at its final place can be read."""
    if not run.is_dir():
        return
    folder = RunFolder.existing(run)
    folder.method()
    newest = newest_checkpoint(folder.checkpoints)
    if newest is not None:
        read_checkpoint(newest, METHOD, torch.device("cpu"))
    for file in run.glob("eval/*/metrics.json"):
        json.loads(file.read_text(encoding="utf-8"))
        read_result(file.with_name(RESULT_FILE))


def results(run: Path) -> dict[str, object]:
    """What must not depend on kills: tensors, log without its clock, figures."""
    saved = read_checkpoint(latest_checkpoint(run / "checkpoints"), METHOD, torch.device("cpu"))
    result = read_result(run / "eval" / "paper" / RESULT_FILE)
    log = [json.loads(line) for line in (run / "metrics.jsonl").read_text(encoding="utf-8").splitlines()]
    return {
        **{name: tensor.numpy().tobytes() for name, tensor in saved.tensors.items()},
        "step": saved.step,
        "log": [{key: value for key, value in row.items() if key != "seconds"} for row in log],
        "figures": (run / "eval" / "paper" / "per_frame.csv").read_text(encoding="utf-8"),
        "result": result.model_dump(include={"key", "sets", "metrics_sha256"}),
        "config": (run / "config.yaml").read_text(encoding="utf-8"),
    }


def kill_and_compare(folder: Path, kills: int, seed: int = 0) -> Kills:
    """Kill so many times; every life that ends must end like the undisturbed one.

    Args:
        folder: Empty; runs are made in it.
        kills: How often.
        seed: Of moments.

    Raises:
        AssertionError: A stage failed, something at its final place was broken, or a result differed.
    """
    random_moments = random.Random(seed)
    data = folder / "phantom"
    subprocess.run(
        coliags("phantom", data, "--frames", 9, "--size", "64x52", "--rotation-views", 1),
        check=True,
        capture_output=True,
    )
    whole = folder / "whole" / "run"
    began = time.monotonic()
    assert attempt(data, whole, CLOCK, float("inf")) is None
    duration = time.monotonic() - began
    expected, found = results(whole), Kills()
    while found.count < kills:
        run = folder / f"life-{found.lives}" / "run"
        while True:
            moment = random_moments.choice(MOMENTS) if found.count < kills else CLOCK
            after = random_moments.uniform(0.0, duration) if found.count < kills else float("inf")
            stage = attempt(data, run, moment, after)
            if stage is None:
                break
            found.stages[stage] += 1
            found.moments[moment] += 1
            check_whole(run)
        ended = results(run)
        assert ended.keys() == expected.keys()
        differing = [name for name, value in expected.items() if ended[name] != value]
        assert not differing, f"life {found.lives} differs in {', '.join(differing)}"
        found.lives += 1
    return found


def main() -> None:
    """Kill as often as asked and say what was hit."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--kills", type=int, default=50)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        found = kill_and_compare(Path(folder), options.kills, options.seed)
    print(f"{found.count} kills in {found.lives} lives, every life like the undisturbed one")
    print("by stage:", dict(found.stages))
    print("by moment:", dict(found.moments))


if __name__ == "__main__":
    main()
