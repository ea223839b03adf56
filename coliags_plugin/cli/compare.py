"""``coliags compare``: train and evaluate several methods on several scenes."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from coliags_plugin.cli.arguments import Assignments, OptionalInt, OptionalPath

Methods = Annotated[tuple[str, ...], tyro.conf.Positional, tyro.conf.arg(metavar="METHOD...")]
Scenes = Annotated[tuple[str, ...], tyro.conf.arg(metavar="SCENE...")]
Splits = Annotated[tuple[str, ...], tyro.conf.arg(metavar="SPLIT...")]


@dataclass(frozen=True)
class Compare:
    """Train and evaluate methods on scenes; what is done is kept, and what was interrupted goes on.

    The same command goes on after any interruption. Exit status 1 if a cell failed; the others are done all the same.
    """

    methods: Methods
    """Names of methods (`coliags list methods`) or paths of YAML files."""
    scenes: Scenes
    """Benchmarks (`coliags list benchmarks`), BENCHMARK/SCENE, paths of benchmark files, or folders of scenes."""
    output: Path
    """Folder of the comparison; one that is there is extended."""
    data: OptionalPath = None
    """Folder of the benchmark's scenes; default scenes/BENCHMARK. Phantoms that are missing are made there."""
    seeds: int = 1
    """Runs of every method on every scene, with the seeds 0, 1, ..."""
    protocol: str = "paper"
    """Evaluation protocol (`coliags list protocols`)."""
    steps: OptionalInt = None
    """Training steps of all runs; default: each method's own."""
    splits: Splits = ()
    """Splits, each trained apart, for instance every-8th block; default: the scene's own."""
    set: Assignments = ()
    """Change a value of every method config, as for train."""
    jobs: OptionalInt = None
    """Runs at a time; default: one per CPU, or per GPU."""
    threads: OptionalInt = None
    """CPU threads of each run; default: the CPUs divided by the runs at a time."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """Device to compute on."""
    executor: Annotated[str, tyro.conf.arg(metavar="local|ray")] = "local"
    """Where runs are processes: on this machine, or on a Ray cluster (`pip install "coliags_plugin[sweep]"`)."""
    retries: int = 2
    """How often a run is resumed whose process was killed or crashed."""

    def run(self) -> None:
        """Compare, print a summary, and print the folder."""
        from coliags_plugin.comparison.compare import How, compare

        done = compare(
            self.methods,
            self.scenes,
            self.output,
            data=self.data,
            seeds=self.seeds,
            protocol=self.protocol,
            splits=self.splits,
            steps=self.steps,
            overrides=self.set,
            how=How(self.jobs, self.threads, self.device, self.executor, self.retries),
        )
        print(done.table())
        for failure in done.failures:
            print(f"failed: {failure.scene} {failure.method} seed {failure.seed}: {failure.reason}")
        print(done.folder)
        if done.failures:
            sys.exit(1)
