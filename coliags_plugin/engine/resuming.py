"""Resuming of runs with their own method, data and schedule."""

from __future__ import annotations

import logging
import shlex
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from coliags_plugin.config.method_config import LoadedMethod, MethodConfig, method_name
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.scenes import Scene
from coliags_plugin.engine.data_formats import load_method_for
from coliags_plugin.engine.run_folder import RunFolder

logger = logging.getLogger(__name__)


def resume_command(run: RunFolder, method: str, data: str) -> str:
    """Command line that resumes a run."""
    return shlex.join(["coliags", "train", method, "--data", data, "--output", str(run.path), "--resume"])


def resumed_method(
    run: RunFolder, method: str, data: Path, overrides: Sequence[str] = (), data_format: str | None = None
) -> LoadedMethod:
    """Load the method config stored in a run folder, with the overrides applied to it.

    ``method`` is what the user believes the run to be of; ``data_format`` replaces the run's own data manager.
    """
    name = method_name(method)
    _check_method(run, name)
    loaded = load_method_for(data, str(run.config_file.resolve()), overrides, data_format)
    return replace(loaded, name=name)


def _check_method(run: RunFolder, name: str) -> None:
    owner = run.provenance().get("method")
    if owner != name:
        raise InputError(f"{run.path} is a run of method '{owner}'", f"one of '{name}'")


def check_same_run(run: RunFolder, method: LoadedMethod, scene: Scene, scene_path: str) -> None:
    """Refuse to resume with another method, other settings (the schedule apart) or other data."""
    _check_method(run, method.name)
    ignored = {"schedule", "description"}
    saved = run.method().config.model_dump(exclude=ignored)
    now = method.config.model_dump(exclude=ignored)
    differing = [key for key in now if now[key] != saved[key]]
    if differing:
        raise InputError(
            f"{run.path} was trained with other settings of {', '.join(differing)}",
            "the settings it was started with",
            f"Compare with {run.config_file}",
        )
    if run.provenance()["scene"]["provenance"].get("fingerprint") != scene.provenance.get("fingerprint"):
        raise InputError(f"{scene_path} is not the data this run was started on", "unchanged data")


def record_schedule(run: RunFolder, config: MethodConfig, step: int) -> None:
    """Write a schedule that differs from the run's own into its config, and the change into its provenance."""
    before, now = run.method().config.schedule, config.schedule
    if now.steps < step:
        raise InputError(f"{run.path} has taken {step} steps already", f"--steps {step} or more, not {now.steps}")
    if now == before:
        return
    provenance = run.provenance()
    change = {"at_step": step, "from": before.model_dump(), "to": now.model_dump()}
    changes = [*provenance.get("schedule_changes", []), change]
    run.rewrite(config.to_yaml(), {**provenance, "steps": now.steps, "schedule_changes": changes})
    if (now.steps, now.written_for) != (before.steps, before.written_for):
        logger.warning(
            "the schedule changes at step %d from %d to %d steps: rates and weights jump there, and the result is not "
            "that of a run of %d steps",
            step,
            before.steps,
            now.steps,
            now.steps,
        )
