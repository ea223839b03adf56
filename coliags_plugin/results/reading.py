"""Reading and writing of results files."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.files import write_json
from coliags_plugin.core.json_files import read_json
from coliags_plugin.core.settings import invalid_reported
from coliags_plugin.results.hashing import metrics_sha256
from coliags_plugin.results.record import FORMAT, VERSION, Result

#: Name of the results file in the folder of an evaluation.
RESULT_FILE = "result.json"

_EXPECTED = "a results file, as `coliags eval` writes it"
_AGAIN = "Restore it, or run `coliags eval` again"
_MARK = f'"{FORMAT}"'.encode()


class NewerResultError(InputError):
    """A results file is from a newer version of the package."""


def write_result(path: Path, result: Result) -> None:
    """Write a results file atomically."""
    write_json(path, result.model_dump(mode="json"))


def read_result(path: Path) -> Result:
    """Read a results file, and check its values against their hash.

    Raises:
        NewerResultError: It is of a newer version of the schema.
        InputError: There is none, it is damaged, or its values are not those that were written.
    """
    content = read_json(path, _EXPECTED, _AGAIN)
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        raise InputError(f'{path} is not a results file: it lacks "format": "{FORMAT}"', _EXPECTED)
    version = content.get("version")
    if type(version) is not int or version < 1:
        raise InputError(f"{path}: version is {json.dumps(version)}", f"a number from 1 to {VERSION}", _AGAIN)
    if version > VERSION:
        raise NewerResultError(
            f"{path} is from a newer version of coliags_plugin: version {version} of the schema",
            f"version {VERSION} or older",
            "Update the package",
        )
    with invalid_reported(f"{path}: ", _EXPECTED, _AGAIN):
        result = Result.model_validate_json(json.dumps(content), strict=True)
    if metrics_sha256(result.sets) != result.metrics_sha256:
        raise InputError(
            f"{path}: the values do not have the hash metrics_sha256; the file was changed or damaged",
            "the values as `coliags eval` wrote them",
            _AGAIN,
        )
    return result


def find_results(paths: Sequence[Path]) -> list[Result]:
    """Read the results at some paths, each once: of files with one key the first counts; other values are refused.

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
        files = sorted(path.rglob("*.json"))
        seen = [file for file in files if not any(part.startswith(".") for part in file.relative_to(path).parts)]
        matches = [file for file in seen if file.is_file() and _MARK in file.read_bytes()]
    except OSError as error:
        raise InputError(f"{error.filename or path} cannot be read: {error.strerror}", "a readable folder") from error
    if not matches:
        raise InputError(
            f"{path} holds no results", "results files, as `coliags eval` writes them", "Run `coliags eval RUN` first"
        )
    return matches
