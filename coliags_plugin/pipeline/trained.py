"""Stages from a scene with depth to a report: training, evaluation, mesh, coverage, report."""

from __future__ import annotations

import logging

from coliags_plugin.config.method_config import method_name
from coliags_plugin.core.errors import InputError, InterruptedRunError, NotWritableError
from coliags_plugin.geometry.meshes.files import MESH_FORMATS
from coliags_plugin.pipeline.stages import Outcome
from coliags_plugin.pipeline.workplace import Workplace

log = logging.getLogger(__name__)

#: Largest time between two checkpoints, seconds, and the number of checkpoints kept.
_SAVE_SECONDS, _KEPT = 60.0, 2


def method_for(place: Workplace) -> str:
    """Name of the method to train: the one given, or else by what is known of the depth."""
    given = place.settings.method
    return given or ("coliags-estimated-depth" if place.estimates_depth or place.has_estimates else "coliags")


def train(place: Workplace) -> Outcome:
    """Train, or go on from the newest checkpoint.

    Raises:
        InterruptedRunError: Ctrl-C, after the state was saved.
    """
    from coliags_plugin.engine.run_folder import RunFolder
    from coliags_plugin.engine.training import TrainingRequest, open_training
    from coliags_plugin.reconstruction.depth.scene import training_options

    settings = place.settings
    steps = f"schedule.steps={settings.steps}"
    options = [*training_options(place.open_posed()), steps]
    data_format = None if place.estimates_depth else place.data_format
    request = TrainingRequest(method_for(place), place.scene, options, settings.seed, data_format, place.anonymous)
    folder = RunFolder(place.run)
    with open_training(request, folder, place.device, "continue") as trainer:
        try:
            trainer.train(_SAVE_SECONDS, _KEPT)
        except InterruptedRunError as error:
            raise InterruptedRunError(
                f"stopped after step {trainer.step} of {trainer.steps}, which is saved; the same command goes on from "
                "there"
            ) from error
    rows = folder.log_rows()
    last = f", {rows[-1]['psnr']:.2f} dB in the last view" if rows else ""
    return Outcome(f"{method_name(request.method)}, {trainer.steps} steps{last}", {"run": "the trained run"})


def evaluate(place: Workplace) -> Outcome:
    """Evaluate the held-out frames."""
    from coliags_plugin.engine import evaluator
    from coliags_plugin.engine.trained import load_trained
    from coliags_plugin.results.reading import RESULT_FILE, read_result

    trained = load_trained(place.run, place.device, place.scene)
    folder = evaluator.evaluate(trained, trained.config.protocol)
    result = read_result(folder / RESULT_FILE)
    values = [(name, result.mean(name)) for name in ("psnr", "ssim")]
    shown = ", ".join(f"{name.upper()} {value:.4g}" for name, value in values if value is not None)
    return Outcome(f"held-out frames: {shown}", {str(folder.relative_to(place.out)): "metrics and rendered frames"})


def mesh(place: Workplace) -> Outcome:
    """Fuse the rendered depth into a mesh."""
    from coliags_plugin.engine.trained import load_trained
    from coliags_plugin.surface.meshing.writing import mesh_run

    trained = load_trained(place.run, place.device, place.scene)
    made = mesh_run(trained, place.run / "mesh", place.settings.mesh, overwrite=True)
    area = made.mesh.areas.sum()
    shown = f"{area / 100.0:.1f} cm²" if trained.scene.is_metric else f"{area:,.0f} square units"
    files = {f"run/mesh/mesh.{kind}": f"the surface as {kind.upper()}" for kind in MESH_FORMATS}
    return Outcome(f"{len(made.mesh):,} triangles, {shown}", files)


def coverage(place: Workplace) -> Outcome:
    """Coverage stage: measure the share of the wall seen in the video; skipped where it cannot be measured.

    Raises:
        NotWritableError: It could be measured, but not written.
    """
    from coliags_plugin.geometry.meshes.files import read_mesh
    from coliags_plugin.surface.coverage.page import summary
    from coliags_plugin.surface.coverage.writing import measure_scene

    scene = place.open_posed()
    if not scene.is_metric:
        return Outcome("left out, as the unit of length is unknown (--diameter gives one)")
    folder = place.run / "coverage"
    try:
        made = measure_scene(
            scene, read_mesh(place.run / "mesh" / "mesh.ply"), folder, place.settings.coverage, overwrite=True
        )
    except NotWritableError:
        raise
    except InputError as error:
        log.warning("no coverage: %s", error)
        return Outcome(f"left out: {error}")
    what = "what was seen and missed, for research use only"
    return Outcome(
        "; ".join(" ".join(line.split()).rstrip(";") for line in summary(made.coverage, made.evaluation)),
        {"run/coverage/coverage.html": what, "run/coverage/coverage.ply": "the same on the mesh"},
    )


def report(place: Workplace) -> Outcome:
    """Write the report of the run."""
    from coliags_plugin.comparison.report.content import Choices
    from coliags_plugin.comparison.report.report import write_report
    from coliags_plugin.engine.run_folder import RunFolder

    protocol = RunFolder(place.run).method().config.protocol
    title = f"Reconstruction of {place.source.name}"
    write_report([place.run], place.out / "report.html", ("html",), Choices(title=title), protocol)
    return Outcome("report.html", {"report.html": "views, metrics, training, provenance"})
