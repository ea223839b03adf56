"""Finding of results files in folders."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from coliags_plugin.core.errors import InputError
from coliags_plugin.results.reading import read_result
from coliags_plugin.results.record import FORMAT, Result

_MARK = f'"{FORMAT}"'.encode()


def find_results(paths: Sequence[Path]) -> list[Result]:
    """Read the results at some paths, each once: of files with one key and the same values the first counts.

    Paths are results files, and folders that are searched for them. Hidden files and folders, such as an interrupted
    evaluation leaves, are not looked into, nor are JSON files of other content.
    """
    by_key: dict[str, tuple[Path, Result]] = {}
    for path in dict.fromkeys(file.resolve() for given in paths for file in _files(given)):
        result = read_result(path)
        other, known = by_key.setdefault(result.key, (path, result))
        if known.metrics_sha256 != result.metrics_sha256:
            raise InputError(
                f"{other} and {path} are results of the same run, and their values differ",
                "each run once",
                "Name the paths of those that count",
            )
    return [result for _, result in by_key.values()]


def _files(path: Path) -> list[Path]:
    """The path itself, or the results files in a folder, sorted."""
    if not path.is_dir():
        return [path]
    try:
        files = [file for file in sorted(path.rglob("*.json")) if not _hidden(file.relative_to(path))]
        matches = [file for file in files if file.is_file() and _MARK in file.read_bytes()]
    except OSError as error:
        raise InputError(f"{error.filename or path} cannot be read: {error.strerror}", "a readable folder") from error
    if not matches:
        raise InputError(
            f"{path} holds no results", "results files, as `coliags eval` writes them", "Run `coliags eval RUN` first"
        )
    return matches


def _hidden(path: Path) -> bool:
    return any(part.startswith(".") for part in path.parts)
