"""Scenes of a comparison: folders, and those of benchmarks; phantoms are made when they are missing."""

from __future__ import annotations

import logging
import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from coliags_plugin.comparison.named_files import load_benchmark, shipped
from coliags_plugin.config.method_config import is_path
from coliags_plugin.core.errors import InputError, check_name, did_you_mean
from coliags_plugin.core.files import user_path
from coliags_plugin.core.jobs import Progress, locked
from coliags_plugin.core.json_files import json_text, parse_json
from coliags_plugin.core.registry import phantom_layouts
from coliags_plugin.phantom.generate import generate, resolve
from coliags_plugin.phantom.settings import PhantomSettings

log = logging.getLogger(__name__)

#: Where the scenes of benchmarks are, under the working directory, in a folder of the benchmark's name.
SCENES = Path("scenes")


@dataclass(frozen=True)
class SceneSource:
    """A scene on disk, or a phantom to make there."""

    name: str  # unique within a comparison
    path: Path  # its folder, absolute
    overrides: tuple[str, ...] = ()  # ``key.path=value`` changes of a method config with which it is read
    data_format: str | None = None  # name of a data manager; None: recognised from the files
    phantom: PhantomSettings | None = None  # settings to make it with; None for a dataset

    @property
    def is_there(self) -> bool:
        """Tell whether the folder is there."""
        return self.path.is_dir()


def find_scenes(names: Sequence[str], data: Path | None) -> list[SceneSource]:
    """The scenes that names stand for.

    Each is a benchmark, ``BENCHMARK/SCENE``, the path of a benchmark's YAML file, or the folder of a scene. Those of a
    benchmark are in the folder ``data``, or else in ``scenes/BENCHMARK``.
    """
    sources: list[SceneSource] = []
    benchmarks: set[str] = set()
    for name in names:
        file, scene = _benchmark(name)
        if file:
            benchmarks.add(Path(file).stem)
            sources += _scenes_of(file, scene, data or SCENES / Path(file).stem)
        elif (folder := user_path(name)).is_dir():
            sources.append(SceneSource(folder.resolve().name, folder.resolve()))
        else:
            raise InputError(
                f"no scene '{name}'",
                f"the folder of a scene, or a benchmark: {', '.join(shipped())}",
                did_you_mean(name, shipped()) or "`coliags list benchmarks` describes them",
            )
    if data is not None and len(benchmarks) != 1:
        many = ", ".join(sorted(benchmarks)) or "none"
        raise InputError(f"`data={data}` with these benchmarks: {many}", "one benchmark, whose scenes are there")
    twice = [name for name, count in Counter(source.name for source in sources).items() if count > 1]
    if twice:
        raise InputError(f"more than one scene is named {', '.join(twice)}", "scenes of different names")
    missing = [source for source in sources if not source.is_there and source.phantom is None]
    if missing:
        folders = ", ".join(dict.fromkeys(str(source.path.parent) for source in missing))
        raise InputError(
            f"{len(missing)} of {len(sources)} scenes are not there: {', '.join(source.name for source in missing)}",
            f"a folder for each in {folders}",
            "Get the dataset (docs/data.md), or name its folder with `data`",
        )
    for source in sources:
        if source.is_there and source.phantom is not None:
            _check_same_phantom(source.path, source.phantom)
    return sources


def make_phantoms(sources: Sequence[SceneSource], progress: Progress) -> None:
    """Make every phantom that is missing."""
    for source in sources:
        if source.phantom is None or source.is_there:
            continue
        with locked(source.path.parent / f".{source.path.name}.lock", source.path, wait=math.inf):
            if not source.is_there:  # another comparison may have made it meanwhile
                log.info("making phantom %s", source.path)
                generate(source.phantom, source.path, progress=progress)


def _benchmark(name: str) -> tuple[str, str | None]:
    """Split a name into its benchmark (empty: the name is a folder) and a scene of it (None: all)."""
    files = shipped()
    if name in files or is_path(name):
        return name, None
    first, _, scene = name.rpartition("/")
    is_scene = (first in files or is_path(first)) and scene and not user_path(name).is_dir()
    return (first, scene) if is_scene else ("", None)


def _scenes_of(file: str, only: str | None, data: Path) -> list[SceneSource]:
    """Scenes of a benchmark, or one of them, each in the first of its folders that is there."""
    benchmark, sources = load_benchmark(file), []
    if only is not None:
        check_name(f"scene of benchmark '{Path(file).stem}'", only, benchmark.scenes)
    for name in benchmark.scenes if only is None else [only]:
        entry = benchmark.scenes[name]
        folders = [(data / user_path(folder)).resolve() for folder in entry.folders(name)]
        folder = next((path for path in folders if path.is_dir()), folders[0])
        data_format = entry.format or benchmark.format
        sources.append(SceneSource(name, folder, benchmark.overrides(name), data_format, entry.phantom))
    return sources


def _check_same_phantom(folder: Path, phantom: PhantomSettings) -> None:
    """Refuse a folder with another phantom than the benchmark's; defaults of its layout and light are compared too."""
    file = folder / "phantom.json"
    try:
        settings = dict(parse_json(json_text(file))["settings"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(
            f"{folder} is not a phantom: {file.name} cannot be read", "the benchmark's phantom, or no folder"
        ) from error
    expected = resolve(phantom, phantom_layouts.get(phantom.layout)()).model_dump(mode="json")
    differing = [key for key in {**expected, **settings} if settings.get(key, ...) != expected.get(key, ...)]
    if differing:
        differences = ", ".join(
            f"{key} {settings.get(key, 'missing')!r} instead of {expected.get(key, 'none')!r}" for key in differing
        )
        raise InputError(
            f"{folder} is another phantom than the benchmark's: {differences}",
            "the benchmark's phantom as this version makes it, or no folder",
            "Remove it, so that it is made again, or choose another `data`",
        )
