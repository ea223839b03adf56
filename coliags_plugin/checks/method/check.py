"""The list of checks, and running it on one method."""

from __future__ import annotations

import io
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import redirect_stderr
from dataclasses import dataclass
from pathlib import Path

from coliags_plugin.checks.method import construction, learning, other_data, rendering, rows, storage
from coliags_plugin.checks.method.context import CheckContext
from coliags_plugin.checks.method.error_location import describe
from coliags_plugin.checks.method.scenes import write_phantom
from coliags_plugin.checks.results import CheckFailedError, CheckResult, CheckSkippedError, Status
from coliags_plugin.config.method_config import method_tree
from coliags_plugin.core.errors import InputError, InterruptedRunError

#: Fewer leave nothing to stop half-way, nor between events of a strategy.
MIN_STEPS = 10


@dataclass(frozen=True)
class MethodCheck:
    """One entry of the list."""

    name: str  # short and unique
    #: does it and returns what it found; its docstring says what it is about. Raises CheckFailedError or
    #: CheckSkippedError, or whatever a component raises.
    run: Callable[[CheckContext], str]
    needs: tuple[str, ...] = ()  # checks that must have passed


CHECKS = (
    MethodCheck("resolves", construction.resolves),
    MethodCheck("options", construction.refuses_options, ("resolves",)),
    MethodCheck("builds", construction.builds, ("resolves",)),
    MethodCheck("groups", construction.has_all_groups, ("builds",)),
    MethodCheck("trains", learning.trains, ("builds",)),
    MethodCheck("terms", learning.every_term_counts, ("trains",)),
    MethodCheck("learns", learning.error_falls, ("trains",)),
    MethodCheck("gradients", learning.gradients_arrive, ("trains",)),
    MethodCheck("renders", rendering.renders_every_output, ("trains",)),
    MethodCheck("renders again", rendering.renders_again, ("renders",)),
    MethodCheck("pixels", rendering.renders_pixels, ("renders again",)),
    MethodCheck("requests", rendering.refuses_requests, ("renders",)),
    MethodCheck("loads", storage.loads, ("renders again",)),
    MethodCheck("repeats", storage.repeats, ("renders again",)),
    MethodCheck("resumes", storage.resumes, ("loads", "repeats")),
    MethodCheck("checkpoints", storage.refuses_checkpoints, ("trains",)),
    MethodCheck("rows", rows.keeps_rows_together, ("resumes",)),
    MethodCheck("evaluates", rendering.evaluates, ("loads",)),
    MethodCheck("images", rendering.writes_images, ("loads",)),
    MethodCheck("other data", other_data.copes_with_other_data, ("trains",)),
    MethodCheck("ignored pixels", other_data.ignores_masked_pixels, ("repeats",)),
)


def check_method(
    method: str,
    folder: Path,
    overrides: Sequence[str] = (),
    data: Path | None = None,
    data_format: str | None = None,
    steps: int = 20,
) -> Iterator[CheckResult]:
    """Check a method, yielding one result after the other.

    Without ``data``, the scene is a small phantom, made within ``folder``, which exists. Schedules are scaled to
    ``steps``.
    """
    method_tree(method, overrides)
    if steps < MIN_STEPS:
        raise InputError(f"--steps {steps}", f"{MIN_STEPS} or more")
    if data is not None and not data.exists():
        raise InputError(f"no folder {data}", "a scene", "Check the path, or leave --data out")
    scene = data or write_phantom(method, overrides, folder)
    context = CheckContext(method, tuple(overrides), scene, data_format, steps, folder)
    passed: set[str] = set()
    for check in CHECKS:
        result = _run(check, context, passed)
        if result.status == "passed":
            passed.add(check.name)
        yield result


def _run(check: MethodCheck, context: CheckContext, passed: set[str]) -> CheckResult:
    missing = [name for name in check.needs if name not in passed]
    if missing:
        return CheckResult(check.name, "skipped", f"needs '{missing[0]}'")
    start = time.monotonic()

    def result(status: Status, detail: str, trace: str = "") -> CheckResult:
        return CheckResult(check.name, status, detail, time.monotonic() - start, trace)

    try:
        with redirect_stderr(io.StringIO()):  # progress bars
            return result("passed", check.run(context))
    except CheckSkippedError as reason:
        return result("skipped", str(reason))
    except CheckFailedError as error:
        return result("failed", "; ".join(str(error).split("\n")), traceback.format_exc() if error.__cause__ else "")
    except InterruptedRunError as error:
        raise KeyboardInterrupt from error
    except Exception as error:
        return result("failed", describe(error, context.config), traceback.format_exc())
