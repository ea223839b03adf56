"""Plan of a comparison: which cells it has, and where their runs and results are, as ``plan.json`` holds it."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.json_files import read_json
from coliags_plugin.core.settings import invalid_reported

#: Names within the folder of a comparison.
PLAN_FILE, RESULTS, RUNS, FAILURES, LOGS = "plan.json", "results", "runs", "failures", "logs"
#: Version of the schema below.
VERSION = 2
_EXPECTED = "what `coliags compare` wrote"


class _PlanPart(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class PlannedScene(_PlanPart):
    """A scene of a plan."""

    phantom: dict[str, Any] | None  # settings it is made with; None for a dataset
    fingerprint: str
    package_version: str  # that computed the fingerprint


class Decision(_PlanPart):
    """Pre-registered analysis: reference method and primary metrics, fixed before the first run."""

    reference: str  # method that the others are compared with
    primary: tuple[str, ...] = Field(min_length=1)  # metrics whose p-values are not exploratory
    date: str  # YYYY-MM-DD, UTC


class _NamedCell(_PlanPart):
    scene: str  # with the name of the split where it is not the scene's own
    method: str
    seed: int
    protocol: str
    key: str  # of the result


class PlannedCell(_NamedCell):
    """A cell of a plan, and its places relative to the folder; what else archived plans say of it is not read."""

    model_config = ConfigDict(extra="ignore", frozen=True)

    run: str = Field(pattern=f"^{RUNS}/")  # run folder; protocols share it
    result: str = Field(pattern=f"^{RESULTS}/")  # results file; there once the cell is done

    @property
    def identity(self) -> tuple[str, str, int, str]:
        """Name of the cell: scene, method, seed, protocol."""
        return self.scene, self.method, self.seed, self.protocol

    @property
    def failure(self) -> str:
        """File with the reason why it failed."""
        return f"{FAILURES}/{self.result.removeprefix(f'{RESULTS}/')}"

    @property
    def log(self) -> str:
        """Messages of the processes that worked on its run."""
        return f"{LOGS}/{self.run.removeprefix(f'{RUNS}/')}.log"


class FailureRecord(_NamedCell):
    """Reason why a cell failed."""

    reason: str  # one line
    attempts: int  # processes that tried
    log: str  # their messages, relative to the comparison's folder


class ComparisonPlan(_PlanPart):
    """Content of ``plan.json``: all that was ever asked for in this folder."""

    format: Literal["coliags-comparison"] = "coliags-comparison"
    version: int = VERSION  # of this schema
    steps: int | None = None  # length of all runs; None: each method's own
    overrides: tuple[str, ...] = ()  # changes of all methods
    decided: Decision | None = None  # when the plan was first written
    scenes: dict[str, PlannedScene] = {}
    cells: tuple[PlannedCell, ...] = ()  # in the order in which they were asked for


def read_plan(folder: Path) -> ComparisonPlan | None:
    """The plan of a folder; None where there is none."""
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
    with invalid_reported(f"{file}: ", _EXPECTED):
        return ComparisonPlan.model_validate(content)
