"""Runs from training and from files of Gaussians, and their handles."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from coliags_plugin.config.method_config import method_name
from coliags_plugin.config.options import (
    CoverageOptions,
    EvaluateOptions,
    ExportOptions,
    ImportOptions,
    MeshOptions,
    PageOptions,
    RenderOptions,
    TrainOptions,
    takes,
)
from coliags_plugin.config.yaml_tree import assignments, settings_of
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.files import refuse_existing, user_path
from coliags_plugin.engine.run_folder import RunFolder

if TYPE_CHECKING:
    import numpy as np
    from jaxtyping import Float

    from coliags_plugin.api.views import RenderedView
    from coliags_plugin.config.method_config import MethodConfig
    from coliags_plugin.contracts import Follower
    from coliags_plugin.core.cameras import Camera
    from coliags_plugin.core.scenes import Scene
    from coliags_plugin.engine.trained import TrainedRun
    from coliags_plugin.engine.trainer import Trainer
    from coliags_plugin.export.baking.exporting import Exported
    from coliags_plugin.export.viewer.live import Viewer
    from coliags_plugin.export.viewer.page import ScenePage
    from coliags_plugin.results.record import Result
    from coliags_plugin.surface.coverage.writing import MeasuredCoverage
    from coliags_plugin.surface.meshing.fusion import MeshedRun

log = logging.getLogger(__name__)


class Run:
    """A run folder. Scene and model are loaded when something is computed, everything else is read when asked for.

    Args:
        path: The run folder.
        data: The scene's folder, where it has moved since training.
        device: ``auto``, ``cpu``, ``cuda`` (the first CUDA device) or ``cuda:N``.

    Attributes ``path``, ``method``, ``scene_name`` and ``seed`` (of all its random generators) tell what it is.

    Raises:
        InputError: This is no run folder, or a file of it is damaged.
    """

    def __init__(self, path: str | Path, *, data: str | Path | None = None, device: str = "auto") -> None:
        self.folder = RunFolder.existing(user_path(path))
        self.path = self.folder.path
        self.data = None if data is None else user_path(data)
        self.device = device
        self._identity = identity = self.folder.identity()
        self.method, self.scene_name, self.seed = identity.method, identity.scene_name, identity.seed
        self._loaded: TrainedRun | None = None

    def __repr__(self) -> str:
        """Method, scene, seed and steps in one line."""
        relit = ", relit" if self._loaded is not None and self._loaded.relit else ""
        steps = f"step {self.step} of {self._identity.steps}"
        return f"{self.method} on {self.scene_name}, seed {self.seed}, {steps}{relit}: {self.path}"

    @property
    def step(self) -> int:
        """Steps taken until the newest checkpoint."""
        return self.folder.step

    @cached_property
    def config(self) -> MethodConfig:
        """The resolved method config."""
        return self.folder.method().config

    @property
    def history(self) -> dict[str, Float[np.ndarray, "T"]]:
        """The training log: ``step``, ``loss``, ``psnr``, ``seconds``, ``terms.NAME`` and so on over T logged steps.

        NaN where a step has no such number. [T] each

        Raises:
            InputError: The log cannot be read.
        """
        return self.folder.history()

    @property
    def results(self) -> dict[str, Result]:
        """Results of its evaluations by protocol.

        Raises:
            InputError: A results file is damaged or of a newer version.
        """
        from coliags_plugin.results.reading import RESULT_FILE, read_result

        files = sorted(self.folder.evaluations.glob(f"*/{RESULT_FILE}"))
        return {file.parent.name: read_result(file) for file in files}

    def load(self) -> TrainedRun:
        """Scene and model at the newest checkpoint, kept for the next call.

        Raises:
            InputError: There is no checkpoint, or the data are missing or have changed.
        """
        from coliags_plugin.engine.devices import choose_device
        from coliags_plugin.engine.trained import load_trained

        loaded, device = self._loaded, choose_device(self.device)
        if loaded is None or (not loaded.relit and loaded.step != self.step):
            self._loaded = loaded = load_trained(self.path, device, self.data)
        return loaded

    @takes(EvaluateOptions)
    def evaluate(self, options: EvaluateOptions) -> Result:
        """Evaluate the run on its held-out frames, writing ``eval/PROTOCOL/`` in its folder.

        Raises:
            InputError: See :meth:`load`; the protocol is unknown, no frame is held out, the run was relit, or ``truth``
                is not of the same video and world.
        """
        from coliags_plugin.engine import evaluator
        from coliags_plugin.engine.data_formats import open_scene

        trained, other = self.load(), None
        if options.truth is not None:
            camera = trained.scene.train[0].camera
            other = open_scene(options.truth, options=[f"width={camera.width}", f"height={camera.height}"])
        protocol = options.protocol or trained.config.protocol
        return evaluator.evaluate(trained, protocol, other, options.refine_poses)

    def frame_names(self, frames: str = "test") -> list[str]:
        """Names of frames that can be rendered.

        Args:
            frames: ``train``, ``all``, or the name of a test set.

        Raises:
            InputError: See :meth:`load`; or there are no such frames.
        """
        from coliags_plugin.engine.rendering import choose_frames

        return [frame.name for frame in choose_frames(self.load().scene, [frames])]

    def render(
        self, frame: str | Camera, *, depth: str = "depth_accumulated", outputs: Sequence[str] = ()
    ) -> RenderedView:
        """Render one view.

        Args:
            frame: Name of a frame of the scene, held out or not; or a free camera.
            depth: Kind of depth (docs/conventions.md 3).
            outputs: Names of further outputs, and of feature channels of the method's Gaussians.

        Raises:
            InputError: See :meth:`load`; or there is no such frame or output.
        """
        from coliags_plugin.api.views import view_of

        return view_of(self.load(), frame, depth, outputs)

    @takes(RenderOptions)
    def write_renders(self, options: RenderOptions) -> Path:
        """Write colour, depth and error images of frames, and a video along the trajectory; their folder.

        Raises:
            InputError: See :meth:`load`; no such frames or channel; the file is no camera path; or the folder exists or
                cannot be written.
        """
        from coliags_plugin.engine.rendering import render_run

        return render_run(self.load(), options)

    @takes(MeshOptions)
    def mesh(self, options: MeshOptions) -> MeshedRun:
        """Fuse the depth rendered from the training poses into a triangle mesh, and write it.

        Returns:
            The mesh, its folder, and the comparison with the true surface where there is one.

        Raises:
            InputError: See :meth:`load`; an option is unknown or invalid, the method renders no such depth, there is no
                surface, the truth is of another world or unit, or the folder exists or cannot be written.
        """
        from coliags_plugin.surface.meshing.fusion import mesh_run
        from coliags_plugin.surface.meshing.views import MeshSettings

        named = assignments({"color": options.color, "texture": 4.0 if options.texture else 0.0})
        voxel = assignments(None if options.voxel is None else {"voxel_size": options.voxel})
        settings = settings_of(MeshSettings, (*named, *options.settings, *voxel))
        folder = options.output or self.path / "mesh"
        return mesh_run(self.load(), folder, settings, options.formats, options.truth, options.overwrite)

    @takes(ExportOptions)
    def export(self, options: ExportOptions) -> list[Exported]:
        """Write the run's Gaussians to files, and a JSON record of each to ``FILE.json`` beside it.

        Raises:
            InputError: See :meth:`load`; the method has no Gaussians, the run was relit, there is no such format or
                light, or a file exists or cannot be written.
        """
        from coliags_plugin.export.baking.exporting import export_run

        return export_run(self.load(), options)

    @takes(CoverageOptions)
    def coverage(self, options: CoverageOptions) -> MeasuredCoverage:
        """Measure what the recording shows of the wall and what it misses, and write it. Research use only.

        Where no section of a lumen can be measured, ``coverage`` of the result is a ``PartialCoverage`` with the
        reason.

        Raises:
            InputError: See :meth:`load`; an option is unknown or invalid, the mesh cannot be read or is not where the
                cameras look, or the folder exists or cannot be written.
        """
        from coliags_plugin.api.scenes import measure_scene_coverage
        from coliags_plugin.surface.coverage.visibility import CoverageSettings
        from coliags_plugin.surface.coverage.writing import measure_scene
        from coliags_plugin.surface.meshing.fusion import fuse_run

        output, mesh = options.output or self.path / "coverage", options.mesh or self.path / "mesh" / "mesh.ply"
        if options.mesh is not None or mesh.is_file():
            data = self.data or self.folder.identity().scene_path
            return measure_scene_coverage(data, replace(options, mesh=mesh, output=output))
        settings = settings_of(CoverageSettings, options.settings)
        refuse_existing(output, options.overwrite)
        trained = self.load()
        return measure_scene(trained.scene, fuse_run(trained).mesh, output, settings, options.overwrite)

    def view(self, *, host: str = "127.0.0.1", port: int = 8080) -> Viewer:
        """Serve the run to browsers (docs/viewer.md), until the viewer is closed.

        Args:
            host: Name or address to listen on.
            port: 0: any free one.

        Raises:
            InputError: See :meth:`load`; viser is not installed, the port is in use or not allowed, or the host is not
                of this machine.
        """
        from coliags_plugin.export.viewer.live import Viewer

        return Viewer(self.load(), host, port)

    @takes(PageOptions)
    def save_view(self, options: PageOptions) -> ScenePage:
        """Write the scene as a page that opens in a browser offline (docs/viewer.md 3); what it is and loses.

        Raises:
            InputError: See :meth:`load`; the method has no Gaussians and the run no mesh, there is no such light, the
                page would hold no Gaussian, or the file cannot be written.
        """
        from coliags_plugin.export.viewer.page import save_page

        return save_page(self.load(), options)

    def relight(self, /, **lamp: Any) -> Run:
        """The run under another lamp, for rendering; it shares the parameters.

        Args:
            lamp: Options of :class:`~coliags_plugin.core.lamps.Lamp`, for instance ``offset=(5.0, 0.0, 0.0)`` (mm).

        Raises:
            InputError: See :meth:`load`; an option is unknown or invalid, or the field does not model the lamp.
        """
        from coliags_plugin.core.lamps import Lamp
        from coliags_plugin.core.settings import validated
        from coliags_plugin.engine.held_light import relight

        validated_lamp = validated(Lamp, lamp, "lamp option")
        return self._relit(relight(self.load(), validated_lamp))

    def flatten(self) -> Run:
        """The run in the same light everywhere, without gain, for rendering; it shares the parameters.

        Every wall point is as far from the lamp, at the same angle, as what the training cameras see in the median.

        Raises:
            InputError: See :meth:`load`; or the method does not make Gaussians.
        """
        from coliags_plugin.engine.held_light import flatten

        return self._relit(flatten(self.load()))

    def _relit(self, trained: TrainedRun) -> Run:
        relit = Run(self.path, data=self.data, device=self.device)
        relit._loaded = trained
        return relit


load_run = Run


@takes(TrainOptions)
@contextmanager
def open_training(options: TrainOptions) -> Iterator[Trainer]:
    """Trainer of a run for a loop of your own (docs/api.md 4), until the block ends; suspect data are warned of.

    Raises:
        InputError: Method, data or options are invalid or do not fit each other; nothing was written.
    """
    from coliags_plugin.engine import trainer as engine
    from coliags_plugin.engine.devices import choose_device

    if options.resume and options.overwrite:
        raise InputError("`resume=True` and `overwrite=True` together", "one of them")
    device, folder = choose_device(options.device), _run_folder(options)
    if_exists: engine.IfExists = "resume" if options.resume else "overwrite" if options.overwrite else "refuse"
    with engine.open_training(options, folder, device, if_exists) as trainer:
        if not options.resume:
            warn_of_suspect_data(trainer.scene)
        yield trainer


@takes(TrainOptions)
def train(options: TrainOptions, *, followers: Sequence[Follower] = (), view_port: int | None = None) -> Run:
    """Train a method on a scene, with the warnings of :func:`open_training`.

    Args:
        options: See below; settings by key path, for instance ``{"field.voxel_size": 1.0}``.
        followers: Told of steps and rows of the log; each may end training (docs/api.md 3).
        view_port: Port at which browsers see the run while it is trained; None: they do not; 0: any free one.

    Raises:
        InputError: See :func:`open_training`; or a logger's library is missing.
        InterruptedRunError: Ctrl-C, SIGTERM or SIGHUP, after the state was saved.
        NotFiniteError: A loss or parameter became NaN or infinite.
    """
    from coliags_plugin.engine.loggers import find_loggers

    chosen_loggers = find_loggers(options.loggers)
    if view_port is not None:
        from coliags_plugin.export.viewer.live import check_server

        check_server("127.0.0.1", view_port)
    with open_training(options) as trainer:
        run, config = trainer.run.path, trainer.method.config.model_dump()
        title = f"{trainer.method.name} on {trainer.scene.name}, seed {trainer.seed}"
        observers = [*followers, *(logger(run, title, config, trainer.step) for logger in chosen_loggers)]
        if view_port is not None:
            from coliags_plugin.export.viewer.live import Viewer

            viewer = Viewer.of_training(trainer, view_port)
            log.info("%s shows the run until training ends", viewer.url)
            observers.append(viewer)
        trainer.train(followers=observers)
    return Run(run, data=options.data, device=options.device)


def warn_of_suspect_data(scene: Scene) -> None:
    """Warn of what the quick checks of ``coliags check data`` find, in the lengths of the dataset."""
    from coliags_plugin.checks.data.check import check_scene

    stored = scene.scaled(1.0 / scene.provenance.training_scale)
    for finding in check_scene(stored, match_images=False).findings:
        log.warning("%s", finding)


def _run_folder(options: TrainOptions) -> RunFolder:
    if options.output is not None:
        return RunFolder(options.output)
    scene_name = options.data.resolve().name
    short = method_name(options.method).rsplit("/", maxsplit=1)[-1]
    return RunFolder.newest(scene_name, short) if options.resume else RunFolder.default(scene_name, short)


@takes(ImportOptions)
def import_splats(options: ImportOptions) -> Run:
    """Make a run of a file of 3D Gaussians on a scene, at step 0, to evaluate, render and mesh.

    Raises:
        InputError: The file is damaged, compressed or of another lineage, the scene cannot be read, or the folder
            exists or cannot be written.
    """
    from coliags_plugin.engine.devices import choose_device
    from coliags_plugin.export.baking.exporting import import_run

    scene = options.data.resolve().name
    folder = RunFolder.default(scene, "imported") if options.output is None else RunFolder(options.output)
    device = choose_device(options.device)
    import_run(options, folder, device)
    return Run(folder.path, data=options.data, device=options.device)
