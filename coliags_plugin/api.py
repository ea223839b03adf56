"""Python API: training, evaluation and loading of runs and scenes in one call each.

Every function is also an attribute of :mod:`coliags_plugin`, imported on first use, and does what the command of the
command line does. All of them raise :class:`~coliags_plugin.core.errors.InputError` for invalid input.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from coliags_plugin.config.method_config import method_name
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.scenes import Scene
from coliags_plugin.engine import evaluator, relighting
from coliags_plugin.engine.data_formats import load_method_for, open_scene
from coliags_plugin.engine.data_formats import load_scene as load_scene_of
from coliags_plugin.engine.devices import choose_device
from coliags_plugin.engine.resuming import resumed_method, resumed_seed
from coliags_plugin.engine.run_folder import RunFolder
from coliags_plugin.engine.trained import TrainedRun, load_trained
from coliags_plugin.engine.trainer import Trainer

log = logging.getLogger(__name__)


def load_scene(data: str | Path, data_format: str | None = None, options: Sequence[str] = ()) -> Scene:
    """Read a scene.

    Args:
        data: The scene's folder.
        data_format: Name of a data manager; None: the one that recognises the folder.
        options: ``key=value`` options of the data manager, for instance ``frame_step=4``.

    Raises:
        InputError: The folder is missing, of no known format or damaged, or an option is unknown.
    """
    return open_scene(Path(data), data_format, options)


def train(
    method: str,
    data: str | Path,
    output: str | Path | None = None,
    *,
    overrides: Sequence[str] = (),
    data_format: str | None = None,
    seed: int | None = None,
    device: str = "auto",
    resume: bool = False,
    overwrite: bool = False,
) -> Path:
    """Train a method on a scene.

    Args:
        method: Name of a method or path of a method config.
        data: The scene's folder.
        output: Run folder; None: ``runs/SCENE/METHOD/STAMP``, or the newest of these when resuming.
        overrides: ``key.path=value`` changes of the method config, for instance ``schedule.steps=5000``.
        data_format: Name of a data manager; None: the method's, or the one that recognises the folder.
        seed: Seed of all random generators; None: 0, or that of the resumed run.
        device: ``auto``, ``cpu`` or ``cuda``.
        resume: Continue from the run's latest checkpoint.
        overwrite: Replace an existing run folder.

    Returns:
        The run folder.

    Raises:
        InputError: Method, data or options are invalid or do not fit each other; nothing was written.
        InterruptedRunError: Ctrl-C, after the state was saved.
        NotFiniteError: A loss or parameter became NaN or infinite.
    """
    if resume and overwrite:
        raise InputError("--resume and --overwrite together", "one of them")
    data, on = Path(data), choose_device(device)
    run = _run_folder(method, data, output, resume)
    if resume:
        run = RunFolder.existing(run.path)
        loaded = resumed_method(run, method, data, overrides, data_format)
        seed = resumed_seed(run, seed)
    else:
        run.check_free(overwrite)
        loaded = load_method_for(data, method, overrides, data_format)
    scene = load_scene_of(loaded.config, data)
    trainer = Trainer(loaded, scene, str(data.resolve()), run, seed or 0, on)
    log.info("renderer %s: %s", trainer.chosen.name, trainer.chosen.reason)
    if resume:
        trainer.resume()
    else:
        trainer.start(overwrite)
    trainer.train()
    return run.path


def _run_folder(method: str, data: Path, output: str | Path | None, resume: bool) -> RunFolder:
    if output is not None:
        return RunFolder(Path(output))
    scene_name, short = data.resolve().name, method_name(method).rsplit("/", maxsplit=1)[-1]
    return RunFolder.newest(scene_name, short) if resume else RunFolder.default(scene_name, short)


def load_run(run: str | Path, *, data: str | Path | None = None, device: str = "auto") -> TrainedRun:
    """Load scene and model of a run at its latest checkpoint.

    Args:
        run: Run folder.
        data: The scene's folder, where it has moved since training.
        device: ``auto``, ``cpu`` or ``cuda``.

    Raises:
        InputError: There is no run or checkpoint, or the data are missing or have changed.
    """
    return load_trained(Path(run), choose_device(device), None if data is None else Path(data))


def relight(trained: TrainedRun, **lamp: Any) -> TrainedRun:
    """Exchange the lamp of a loaded run, which shares the parameters, for rendering.

    Args:
        trained: The run.
        lamp: Options of :class:`~coliags_plugin.core.lamps.Lamp`, for instance ``offset=(5.0, 0.0, 0.0)`` (mm).

    Raises:
        InputError: An option is unknown or invalid, or the run's field does not model the lamp.
    """
    return relighting.relight(trained, relighting.make_lamp(lamp))


def evaluate(
    run: str | Path | TrainedRun, protocol: str | None = None, *, data: str | Path | None = None, device: str = "auto"
) -> dict[str, Any]:
    """Evaluate a run on its held-out frames, writing ``eval/PROTOCOL/`` in its folder.

    Args:
        run: Run folder, or a loaded run.
        protocol: Name of a protocol; None: the method config's.
        data: See :func:`load_run`; not used for a loaded run.
        device: See :func:`load_run`; not used for a loaded run.

    Returns:
        Content of ``metrics.json``: means per metric, None where one is not available, with ``reasons``.

    Raises:
        InputError: As :func:`load_run`; the protocol is unknown; or no frame is held out.
    """
    trained = run if isinstance(run, TrainedRun) else load_run(run, data=data, device=device)
    folder = evaluator.evaluate(trained, protocol or trained.config.protocol)
    summary: dict[str, Any] = json.loads((folder / "metrics.json").read_text(encoding="utf-8"))
    return summary
