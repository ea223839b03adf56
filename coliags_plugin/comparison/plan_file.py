"""Plan of a comparison: which cells it has, and where their runs and results are, as ``plan.json`` holds it."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, ValidationError

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.json_files import read_json
from coliags_plugin.core.settings import first_error

#: Names within the folder of a comparison.
PLAN_FILE, RESULTS, RUNS, FAILURES = "plan.json", "results", "runs", "failures"
#: Of the schema below.
VERSION = 1
_EXPECTED = "what `coliags compare` wrote"


class _PlanPart(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class PlannedScene(_PlanPart):
    """A scene of a plan.

    Attributes:
        phantom: Settings it is made with; None for a dataset.
        fingerprint: Of its files.
        package_version: That computed the fingerprint.
    """

    phantom: dict[str, Any] | None
    fingerprint: str
    package_version: str


class PlannedCell(_PlanPart):
    """A cell of a plan.

    Attributes:
        scene: Name of the scene; with that of the split where it is not the scene's own.
        method: Name of the method.
        seed: Of the run.
        protocol: Name of the evaluation protocol.
        key: Of the result.
        run: Run folder, relative to the comparison's.
        result: Results file, relative to the comparison's folder; there once the cell is done.
    """

    scene: str
    method: str
    seed: int
    protocol: str
    key: str
    run: str
    result: str

    @property
    def identity(self) -> tuple[str, str, int, str]:
        """What it is called: scene, method, seed, protocol."""
        return self.scene, self.method, self.seed, self.protocol


class ComparisonPlan(_PlanPart):
    """Content of ``plan.json``: all that was ever asked for in this folder.

    Attributes:
        format: Marks the file.
        version: Of this schema.
        steps: Length of all runs; None: each method's own.
        overrides: Changes of all methods.
        scenes: By name.
        cells: In the order in which they were asked for.
    """

    format: Literal["coliags-comparison"] = "coliags-comparison"
    version: int = VERSION
    steps: int | None = None
    overrides: tuple[str, ...] = ()
    scenes: dict[str, PlannedScene] = {}
    cells: tuple[PlannedCell, ...] = ()


class FailureRecord(_PlanPart):
    """Why a cell failed.

    Attributes:
        scene, method, seed, protocol, key: As in the plan.
        reason: One line.
        attempts: Processes that tried.
        log: Their messages, relative to the comparison's folder.
    """

    scene: str
    method: str
    seed: int
    protocol: str
    key: str
    reason: str
    attempts: int
    log: str


def read_plan(folder: Path) -> ComparisonPlan | None:
    """The plan of a folder; None where there is none.

    Raises:
        InputError: The file is damaged or from a newer version.
    """
    file = folder / PLAN_FILE
    if not file.is_file():
        return None
    content = read_json(file, _EXPECTED, finite=True)
    version = content.get("version") if isinstance(content, dict) else None
    if isinstance(version, int) and version > VERSION:
        raise InputError(
            f"{file} is from a newer version of coliags_plugin: version {version}",
            f"version {VERSION} or older",
            "Update the package",
        )
    try:
        return ComparisonPlan.model_validate(content)
    except ValidationError as error:
        key, message, _ = first_error(error)
        raise InputError(f"{file}: {key}: {message}", _EXPECTED) from error
