"""The list of checks, and running it on one method."""

from __future__ import annotations

import io
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import redirect_stderr
from dataclasses import dataclass
from pathlib import Path

from coliags_plugin.checks.method import construction, learning, other_data, outcomes, rows, storage, views
from coliags_plugin.checks.method.bench import Bench
from coliags_plugin.checks.method.blame import describe
from coliags_plugin.checks.method.results import CheckFailedError, CheckSkippedError, Result
from coliags_plugin.checks.method.scenes import write_phantom
from coliags_plugin.config.method_config import method_tree
from coliags_plugin.core.errors import InputError, InterruptedRunError

#: Fewer leave nothing to stop half-way, nor between events of a strategy.
LEAST_STEPS = 10


@dataclass(frozen=True)
class Check:
    """One entry of the list.

    Attributes:
        name: Short and unique.
        run: Does it and returns what it found; its docstring says what it is about. Raises CheckFailedError or
            CheckSkippedError, or whatever a component raises.
        needs: Checks that must have passed.
    """

    name: str
    run: Callable[[Bench], str]
    needs: tuple[str, ...] = ()


CHECKS = (
    Check("resolves", construction.resolves),
    Check("options", construction.refuses_options, ("resolves",)),
    Check("builds", construction.builds, ("resolves",)),
    Check("groups", construction.has_all_groups, ("builds",)),
    Check("trains", learning.trains, ("builds",)),
    Check("terms", learning.every_term_counts, ("trains",)),
    Check("learns", learning.error_falls, ("trains",)),
    Check("gradients", learning.gradients_arrive, ("trains",)),
    Check("renders", views.renders_every_output, ("trains",)),
    Check("renders again", views.renders_again, ("renders",)),
    Check("pixels", views.renders_pixels, ("renders again",)),
    Check("requests", views.refuses_requests, ("renders",)),
    Check("loads", storage.loads, ("renders again",)),
    Check("repeats", storage.repeats, ("renders again",)),
    Check("resumes", storage.resumes, ("loads", "repeats")),
    Check("checkpoints", storage.refuses_checkpoints, ("trains",)),
    Check("rows", rows.keeps_rows_together, ("resumes",)),
    Check("evaluates", outcomes.evaluates, ("loads",)),
    Check("images", outcomes.writes_images, ("loads",)),
    Check("other data", other_data.copes_with_other_data, ("trains",)),
    Check("ignored pixels", other_data.ignores_masked_pixels, ("repeats",)),
)


def check_method(
    method: str,
    folder: Path,
    overrides: Sequence[str] = (),
    data: Path | None = None,
    data_format: str | None = None,
    steps: int = 20,
) -> Iterator[Result]:
    """Check a method, yielding one result after the other.

    Args:
        method: Name or path of a method config.
        folder: An existing folder for what the checks write.
        overrides: ``key.path=value`` assignments.
        data: A scene's folder; None: a small phantom, made within ``folder``.
        data_format: Name of a data manager; None: the method's, or the one that recognises the folder.
        steps: Length of the runs, 10 or more; schedules are scaled to it.

    Raises:
        InputError: No such method or data, or ``steps`` is too small.
    """
    method_tree(method, overrides)
    if steps < LEAST_STEPS:
        raise InputError(f"--steps {steps}", f"{LEAST_STEPS} or more")
    if data is not None and not data.exists():
        raise InputError(f"no folder {data}", "a scene", "Check the path, or leave --data out")
    scene = data or write_phantom(method, overrides, folder)
    bench = Bench(method, tuple(overrides), scene, data_format, steps, folder)
    passed: set[str] = set()
    for check in CHECKS:
        result = _run(check, bench, passed)
        if result.status == "passed":
            passed.add(check.name)
        yield result


def _run(check: Check, bench: Bench, passed: set[str]) -> Result:
    lacking = [name for name in check.needs if name not in passed]
    if lacking:
        return Result(check.name, "skipped", 0.0, f"needs '{lacking[0]}'")
    began = time.monotonic()

    def result(status: str, detail: str, trace: str = "") -> Result:
        return Result(check.name, status, time.monotonic() - began, detail, trace)  # type: ignore[arg-type]

    try:
        with redirect_stderr(io.StringIO()):  # progress bars
            return result("passed", check.run(bench))
    except CheckSkippedError as reason:
        return result("skipped", str(reason))
    except CheckFailedError as error:
        return result("failed", "; ".join(str(error).split("\n")), traceback.format_exc() if error.__cause__ else "")
    except InterruptedRunError as error:
        raise KeyboardInterrupt from error
    except Exception as error:
        return result("failed", describe(error, bench.config), traceback.format_exc())
