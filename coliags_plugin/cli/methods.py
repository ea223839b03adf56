"""Commands on methods and the installation: ``coliags list``, ``config show``, ``check``, ``doctor``, ``weights``."""

from __future__ import annotations

import logging
import shutil
import sys
import tempfile
from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import partial
from io import TextIOWrapper
from pathlib import Path
from typing import Annotated, Literal

import tyro

from coliags_plugin.cli.texts import in_flags, print_summary
from coliags_plugin.config import options


@dataclass(frozen=True)
class ListCommand:
    """List methods, benchmarks and registered components."""

    kind: tyro.conf.Positional[str] = "all"
    """A kind (methods, benchmarks, ablations, datamanagers, fields, renderers, ...); default: all of them."""
    json: options.AsJson = False

    def run(self) -> None:
        """Print names by kind, with the source of those that are not built in."""
        from coliags_plugin.comparison.named_files import ABLATIONS, shipped
        from coliags_plugin.config.method_config import descriptions, method_files
        from coliags_plugin.core.errors import check_name
        from coliags_plugin.core.registry import REGISTRIES

        def sources(kind: str) -> dict[str, str]:
            named = {name: REGISTRIES[kind].source(name) for name in REGISTRIES[kind]}
            return {name: "" if source == "built in" else f"({source})" for name, source in named.items()}

        texts: dict[str, Callable[[], dict[str, str]]] = {
            "methods": lambda: descriptions(method_files()),
            "benchmarks": lambda: descriptions(shipped()),
            "ablations": lambda: descriptions(shipped(ABLATIONS)),
            **{kind: partial(sources, kind) for kind in REGISTRIES},
        }
        check_name("kind", self.kind, ("all", *texts))
        listed = {kind: texts[kind]() for kind in (texts if self.kind == "all" else [self.kind])}
        lines = []
        for kind, rows in listed.items():
            lines += [f"{kind}:"] if self.kind == "all" else []
            indent = "  " if self.kind == "all" else ""
            lines += [f"{indent}{name:<28}{text}".rstrip() for name, text in rows.items()]
        print_summary("\n".join(lines), listed, as_json=self.json)


@dataclass(frozen=True)
class ConfigCommand:
    """Show a method config with everything inherited and every default filled in."""

    action: tyro.conf.Positional[Literal["show"]]
    """Action."""
    method: tyro.conf.Positional[str]
    """Name of a method or path of a YAML file."""
    origin: bool = False
    """Also print the file and line, option or default that each value comes from."""
    set: options.Assignments = ()
    """Change a value, as for train."""

    def run(self) -> None:
        """Print YAML."""
        from coliags_plugin.config.method_config import load_method

        loaded = load_method(self.method, self.set)
        print(in_flags(loaded.with_origins()) if self.origin else loaded.config.to_yaml(), end="")


@dataclass(frozen=True)
class CheckCommand:
    """Check that a method trains, resumes, renders and fails as it should, on the CPU; exit status 1 if not."""

    method: tyro.conf.Positional[str]
    """Name of a method (`coliags list methods`) or path of a YAML file."""
    steps: int = 20
    """Length of the runs; schedules are scaled to it."""
    keep: bool = False
    """Keep the folder with the phantom and the runs, and print its path."""
    traceback: bool = False
    """Print the whole traceback of every exception."""
    set: options.Assignments = ()
    """Change a value of the method config, as for train."""
    data_format: options.DataFormat = None
    data: options.OptionalPath = None
    """A scene's folder; default: a small phantom."""
    json: options.AsJson = False

    def run(self) -> None:
        """Print one line per check, then a summary."""
        logger = logging.getLogger("coliags_plugin")
        level, folder = logger.level, Path(tempfile.mkdtemp(prefix="coliags-check-"))
        logger.setLevel(logging.WARNING)  # the plans of a dozen runs
        try:
            failed = self._print_results(folder)
        finally:
            logger.setLevel(level)
            if not self.keep:
                shutil.rmtree(folder, ignore_errors=True)
        if failed:
            sys.exit(1)

    def _print_results(self, folder: Path) -> bool:
        """Print each result; True if a check failed."""
        from coliags_plugin.checks.results import line, summary, tracebacks
        from coliags_plugin.testing import METHOD_CHECKS, CheckContext, name_of_check

        if isinstance(sys.stdout, TextIOWrapper):
            sys.stdout.reconfigure(errors="backslashreplace")  # where an encoding has no ticks
        width = max(len(name_of_check(check)) for check in METHOD_CHECKS)
        context = CheckContext(self.method, folder, self.set, self.data, self.data_format, self.steps)
        results = []
        for check in METHOD_CHECKS:
            results.append(context.outcome(check))
            if not self.json:
                print(in_flags(line(results[-1], width)), flush=True)
        text = summary(results)
        if self.traceback:
            text += "\n" + "".join(tracebacks(results))
        facts = {"checks": [asdict(result) for result in results]}
        print_summary(text, facts, written=[folder] if self.keep else [], as_json=self.json)
        return any(result.status == "failed" for result in results)


@dataclass(frozen=True)
class DoctorCommand:
    """Report versions and devices, which renderer would be used and why, and where the weights of LPIPS are.

    On a CUDA device the renderers are tried: their errors on small views, and frames per second.
    """

    device: Annotated[str, tyro.conf.arg(metavar="auto|cpu|cuda|cuda:N")] = "auto"
    """Device whose renderers are tried; auto: the first CUDA device, or none."""
    json: options.AsJson = False

    def run(self) -> None:
        """Print the results; exit with status 1 where a requirement is missing or a renderer is wrong."""
        from coliags_plugin.checks.installation import check_installation
        from coliags_plugin.reporting.model import Fact, FactList
        from coliags_plugin.reporting.text_formats import terminal_text

        results = check_installation(self.device)
        marks = {"passed": "ok ", "failed": "BAD", "skipped": "-  "}
        facts = [Fact(f"{marks[each.status]} {each.name}", each.detail) for each in results]
        text = terminal_text([FactList(facts)])
        print_summary(text, {"checks": [asdict(each) for each in results]}, as_json=self.json)
        if any(each.status == "failed" for each in results):
            sys.exit(1)


@dataclass(frozen=True)
class WeightsCommand:
    """Download the weights that LPIPS needs, or copy them; nothing else in this package downloads."""

    metric: tyro.conf.Positional[Literal["lpips"]]
    """Whose weights."""
    net: Literal["vgg", "alex", "squeeze", "all"] | None = None
    """Backbone: VGG's has 528 MiB, AlexNet's 233, SqueezeNet's 5; default: vgg and squeeze, for the protocol paper."""
    folder: options.OptionalPath = None
    """Folder to install them in; default: torch's download cache, where LPIPS finds them."""
    from_folder: Annotated[options.OptionalPath, tyro.conf.arg(name="from")] = None
    """Copy the files from this folder instead of downloading them."""

    def run(self) -> None:
        """Install what is missing, and print where the weights of each net are."""
        from coliags_plugin.metrics.lpips import (
            DEFAULT_NETS,
            SOURCES,
            WEIGHTS_VARIABLE,
            find_weights,
            install,
            searched_folders,
        )

        nets = DEFAULT_NETS if self.net is None else tuple(SOURCES) if self.net == "all" else (self.net,)
        folder = None if self.folder is None else self.folder.resolve()
        written = install(nets, folder, self.from_folder)
        for net in nets:
            backbone, heads = find_weights(net, folder)
            print(f"LPIPS {net}: backbone {backbone}, linear heads {heads}")
        if not written:
            print("Everything was there already.")
        if folder is not None and folder not in searched_folders():
            print(f"Set {WEIGHTS_VARIABLE}={folder} for LPIPS to find them.")
