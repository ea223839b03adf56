"""Folder of a run."""

from __future__ import annotations

import itertools
import json
import logging
import math
import os
import shlex
from collections.abc import Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from coliags_plugin.config.method_config import LoadedMethod, MethodConfig, load_method
from coliags_plugin.core import __version__
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.files import atomic_folder, atomic_write, reporting_unwritable, write_json
from coliags_plugin.core.jobs import locked
from coliags_plugin.core.json_files import JsonObject, parse_json, read_json, scalars
from coliags_plugin.core.provenance import Provenance
from coliags_plugin.core.registry import PLUGIN_PATH_VARIABLE, REGISTRIES
from coliags_plugin.core.settings import validated
from coliags_plugin.results.hashing import code_key
from coliags_plugin.results.record import TRUTH_SUFFIX

if TYPE_CHECKING:
    import numpy as np
    from jaxtyping import Float

    from coliags_plugin.core.scenes import Scene  # with torch, which commands about runs do without

logger = logging.getLogger(__name__)

FORMAT = 2


@dataclass(frozen=True)
class RunIdentity:
    """Identity of a run, from its provenance."""

    method: str
    scene_name: str
    scene_path: Path  # that it was read from
    fingerprint: str  # of the scene's files
    scale: float  # factor on the lengths of the scene in training
    seed: int
    steps: int  # of the whole training


@dataclass(frozen=True)
class RunFolder:
    """``config.yaml``, ``provenance.json``, ``metrics.jsonl``, ``checkpoints/`` and ``eval/`` of one run."""

    path: Path

    @property
    def config_file(self) -> Path:
        """The resolved method config."""
        return self.path / "config.yaml"

    @property
    def provenance_file(self) -> Path:
        """Provenance of the run."""
        return self.path / "provenance.json"

    @property
    def log_file(self) -> Path:
        """One JSON object per logged step."""
        return self.path / "metrics.jsonl"

    @property
    def checkpoints(self) -> Path:
        """One folder per checkpoint."""
        return self.path / "checkpoints"

    def owned(self, wait: float = 0.0) -> AbstractContextManager[None]:
        """Keep other processes from training this run; see :func:`coliags_plugin.core.jobs.locked`."""
        return locked(self.path.with_name(f".{self.path.name}.lock"), self.path, wait)

    @property
    def evaluations(self) -> Path:
        """One folder per protocol."""
        return self.path / "eval"

    def evaluation(self, protocol: str, against_truth: bool = False) -> Path:
        """Folder of the results of a protocol: on the run's own scene, or against another scene's true depth."""
        return self.evaluations / (f"{protocol}{TRUTH_SUFFIX}" if against_truth else protocol)

    @property
    def step(self) -> int:
        """Steps taken until the newest checkpoint; 0 without one."""
        return max(map(checkpoint_step, checkpoints_in_order(self.checkpoints)), default=0)

    @property
    def newest_checkpoint(self) -> Path:
        """The checkpoint of the highest step; refused where there is none."""
        checkpoints = checkpoints_in_order(self.checkpoints)
        if not checkpoints:
            raise InputError(
                f"no checkpoint in {self.checkpoints}", "at least one step-* folder", "Train first: `coliags train`"
            )
        return checkpoints[-1]

    @classmethod
    def default(cls, scene: str, method: str) -> RunFolder:
        """A new ``runs/<scene>/<method>/<stamp>`` under the working directory; numbered after the first of a second."""
        parent, stamp = Path("runs") / scene / method, datetime.now().strftime("%Y%m%d-%H%M%S")
        names = itertools.chain([stamp], (f"{stamp}-{number:02d}" for number in itertools.count(2)))
        return cls(next(parent / name for name in names if not (parent / name).exists()))

    @classmethod
    def newest(cls, scene: str, method: str) -> RunFolder:
        """The latest run of a method on a scene under the working directory."""
        parent = Path("runs") / scene / method
        runs = sorted(path for path in parent.glob("*") if (path / "config.yaml").is_file())
        if not runs:
            raise InputError(f"no run under {parent}", "one to resume", "Name it with `output=RUN`")
        return cls(runs[-1])

    @classmethod
    def existing(cls, path: Path) -> RunFolder:
        """An existing run."""
        folder = cls(path)
        if not folder.config_file.is_file() or not folder.provenance_file.is_file():
            raise InputError(f"{path} is not a run folder", "a folder with config.yaml and provenance.json")
        return folder

    def create(self, config_yaml: str, provenance: JsonObject, overwrite: bool) -> None:
        """Create the folder atomically with config and provenance."""
        self.check_free(overwrite)
        if self.path.is_dir() and not any(self.path.iterdir()):
            self.rewrite(config_yaml, provenance)  # perhaps somebody's working directory, which must not be replaced
            return
        with atomic_folder(self.path, overwrite=True) as scratch:
            RunFolder(scratch).rewrite(config_yaml, provenance)

    def rewrite(self, config_yaml: str, provenance: JsonObject) -> None:
        """Write config and provenance again."""
        write_json(self.provenance_file, {"format": FORMAT, **provenance})
        atomic_write(self.config_file, config_yaml)

    def check_free(self, overwrite: bool) -> None:
        """Refuse a folder that holds anything, or that is not a run and would be overwritten."""
        if not self.path.exists() or (self.path.is_dir() and not any(self.path.iterdir())):
            return
        if not overwrite:
            raise InputError(
                f"{self.path} already exists",
                "a new folder",
                "Choose another `output`, or pass `resume=True` or `overwrite=True`",
            )
        if not self.config_file.is_file():
            raise InputError(f"{self.path} is not a run folder", "a run to overwrite", "Choose another `output`")

    def relative(self, path: str | Path) -> str:
        """A path from the folder, so that run and data can be moved together and nothing says where they were."""
        return Path(os.path.relpath(Path(path).resolve(), self.path.resolve())).as_posix()

    def method(self) -> LoadedMethod:
        """The run's resolved config."""
        self.check_plugins()
        return load_method(str(self.config_file.resolve()))

    def check_plugins(self) -> None:
        """Refuse a run of which a component is missing, and tell the file or package that it came from."""
        for component, plugin in self.provenance().get("plugins", {}).items():
            kind, _, name = component.partition(".")
            if name not in REGISTRIES[kind]:
                file = f"{plugin['file']}, SHA-256 {plugin['sha256'][:8]}..." if "file" in plugin else plugin["class"]
                is_file = plugin["source"] == PLUGIN_PATH_VARIABLE
                raise InputError(
                    f"{self.path} needs {REGISTRIES[kind].noun} '{name}', from {plugin['source']} ({file})",
                    "all components that the run was trained with",
                    f"Set {PLUGIN_PATH_VARIABLE} to the path of {plugin['file']}"
                    if is_file
                    else "Install or register it",
                )

    def provenance(self) -> JsonObject:
        """Content of the provenance file."""
        provenance: JsonObject = read_json(self.provenance_file, "what `coliags train` wrote", finite=True)
        if (written := provenance.get("format")) != FORMAT:
            version = provenance.get("package_version", "?")
            raise InputError(
                f"{self.provenance_file} is of coliags_plugin {version}, in format {written}",
                f"format {FORMAT}, of version {__version__}",
                "Train again, or use the version that wrote it",
            )
        return provenance

    def identity(self) -> RunIdentity:
        """Method, scene, seed and length of the run."""
        provenance = self.provenance()
        try:
            scene = provenance["scene"]
            origin = validated(Provenance, scene["provenance"], f"{self.provenance_file}:")
            return RunIdentity(
                method=provenance["method"],
                scene_name=scene["name"],
                scene_path=(self.path.resolve() / scene["path"]).resolve(),
                fingerprint=origin.fingerprint,
                scale=origin.training_scale,
                seed=int(provenance["seed"]),
                steps=int(provenance["steps"]),
            )
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            raise InputError(f"{self.provenance_file} lacks {error}", "what `coliags train` wrote") from error

    def resume_command(self, method: str, data: str) -> str:
        """Command line that resumes the run."""
        return shlex.join(["coliags", "train", method, "--data", data, "--output", str(self.path), "--resume"])

    def check_method(self, name: str) -> None:
        """Refuse to resume with another method."""
        owner = self.provenance().get("method")
        if owner != name:
            raise InputError(f"{self.path} is a run of method '{owner}'", f"one of '{name}'")

    def check_same(self, method: LoadedMethod, scene: Scene, scene_path: str) -> None:
        """Refuse to resume with another method, other settings (the schedule apart) or other data."""
        self.check_method(method.name)
        ignored = {"schedule", "description"}
        saved, now = (config.model_dump(exclude=ignored) for config in (self.method().config, method.config))
        differing = [key for key in now if now[key] != saved[key]]
        if differing:
            raise InputError(
                f"{self.path} was trained with other settings of {', '.join(differing)}",
                "the settings it was started with",
                f"Compare with {self.config_file}",
            )
        if self.identity().fingerprint != scene.provenance.fingerprint:
            raise InputError(f"{scene_path} is not the data this run was started on", "unchanged data")

    def record_schedule(self, config: MethodConfig, step: int, plan: str) -> None:
        """Write a schedule that differs from the run's own into its config; change and plan into its provenance."""
        before, now = self.method().config.schedule, config.schedule
        if now.steps < step:
            raise InputError(f"{self.path} has taken {step} steps already", f"`steps={step}` or more, not {now.steps}")
        if now == before:
            return
        provenance = self.provenance()
        change = {"at_step": step, "from": before.model_dump(), "to": now.model_dump()}
        changes = [*provenance.get("schedule_changes", []), change]
        changed = {"steps": now.steps, "plan": plan, "schedule_changes": changes}
        self.rewrite(config.to_yaml(), {**provenance, **changed})
        if (now.steps, now.written_for) != (before.steps, before.written_for):
            logger.warning(
                "the schedule changes at step %d from %d to %d steps: rates and weights jump there, and the result is "
                "not that of a run of %d steps",
                step,
                before.steps,
                now.steps,
                now.steps,
            )

    def record_code(self, step: int, plugins: Mapping[str, JsonObject]) -> None:
        """Write into the provenance by which code and plugins the run goes on from a step, if those were others."""
        provenance = self.provenance()
        changes = provenance.get("code_changes", [])
        now = {"code": code_key(), **({"plugins": plugins} if plugins else {})}
        before = changes[-1] if changes else provenance
        if now != {key: before[key] for key in ("code", "plugins") if key in before}:
            changes = [*changes, {"at_step": step, **now}]
            write_json(self.provenance_file, {**provenance, "code_changes": changes})
            logger.warning("the code has changed since %s was begun; its result will have a key of its own", self.path)

    def log(self, row: Mapping[str, Any]) -> None:
        """Append a row to the training log."""
        with reporting_unwritable(self.path), self.log_file.open("a", encoding="utf-8") as file:
            file.write(json.dumps(row, allow_nan=False) + "\n")

    @property
    def logged_step(self) -> int:
        """Step of the last whole row of the training log; 0 without one."""
        lines = self.log_file.read_text(errors="replace").splitlines() if self.log_file.is_file() else []
        rows = filter(None, map(_log_row, reversed(lines)))
        return int(next(rows, {"step": 0})["step"])

    def log_rows(self, until: float = math.inf) -> list[JsonObject]:
        """Rows of the training log up to a step, without lines that a kill cut short; none without a log."""
        try:
            with self.log_file.open(encoding="utf-8") as lines:
                return [row for row in map(_log_row, lines) if row and row["step"] <= until]
        except FileNotFoundError:
            return []
        except (OSError, ValueError) as error:
            raise InputError(f"cannot read {self.log_file}: {error}", "what `coliags train` wrote") from error

    def history(self) -> dict[str, Float[np.ndarray, "T"]]:
        """Numbers of the training log by dotted name (``terms.l1``), NaN where a row has none. [T] each"""
        import numpy as np

        rows = [{"step": float(row["step"]), **scalars(row)} for row in self.log_rows()]
        names = dict.fromkeys(name for row in rows for name in row)
        return {name.replace("/", "."): np.array([row.get(name, math.nan) for row in rows]) for name in names}


def checkpoints_in_order(folder: Path) -> list[Path]:
    """The checkpoints of a folder, by their steps."""
    return sorted((path.parent for path in folder.glob("step-*/state.json")), key=checkpoint_step)


def checkpoint_step(checkpoint: Path) -> int:
    """The step that a checkpoint's folder is named for."""
    return int(checkpoint.name.split("-")[1])


def _log_row(line: str) -> JsonObject | None:
    """A row of the training log; None where the line is damaged."""
    try:
        row = parse_json(line)
    except ValueError:
        return None
    whole = isinstance(row, dict) and all(
        isinstance(row.get(name), (int, float)) for name in ("step", "psnr", "seconds")
    )
    return row if whole else None
