"""Stages from a scene with depth to a report: training, evaluation, mesh, coverage, report."""

from __future__ import annotations

import logging

from coliags_plugin.config.method_config import method_name
from coliags_plugin.core.errors import InputError, InterruptedRunError, NotWritableError
from coliags_plugin.geometry.meshes.files import MESH_FORMATS
from coliags_plugin.pipeline.context import StageContext
from coliags_plugin.pipeline.stages import StageOutcome

log = logging.getLogger(__name__)

#: Largest time between two checkpoints, seconds, and the number of checkpoints kept.
_SAVE_SECONDS, _KEPT = 60.0, 2


def method_for(context: StageContext) -> str:
    """Name of the method to train: the one given, or else by what is known of the depth."""
    given = context.settings.method
    return given or ("coliags-estimated-depth" if context.estimates_depth or context.has_estimates else "coliags")


def train(context: StageContext) -> StageOutcome:
    """Train, or go on from the newest checkpoint."""
    from coliags_plugin.engine.run_folder import RunFolder
    from coliags_plugin.engine.training import TrainingRequest, open_training
    from coliags_plugin.reconstruction.depth.scene import training_options

    settings = context.settings
    steps = f"schedule.steps={settings.steps}"
    options = [*training_options(context.open_posed()), steps]
    data_format = None if context.estimates_depth else context.data_format
    request = TrainingRequest(
        method_for(context), context.scene, options, settings.seed, data_format, context.anonymous
    )
    folder = RunFolder(context.run)
    with open_training(request, folder, context.device, "continue") as trainer:
        try:
            trainer.train(_SAVE_SECONDS, _KEPT)
        except InterruptedRunError as error:
            raise InterruptedRunError(
                f"stopped after step {trainer.step} of {trainer.steps}, which is saved; the same command goes on from "
                "there"
            ) from error
    rows = folder.log_rows()
    last = f", {rows[-1]['psnr']:.2f} dB in the last view" if rows else ""
    return StageOutcome(f"{method_name(request.method)}, {trainer.steps} steps{last}", {"run": "the trained run"})


def evaluate(context: StageContext) -> StageOutcome:
    """Evaluate the held-out frames."""
    from coliags_plugin.engine import evaluator
    from coliags_plugin.engine.trained import load_trained
    from coliags_plugin.results.reading import RESULT_FILE, read_result

    trained = load_trained(context.run, context.device, context.scene)
    folder = evaluator.evaluate(trained, trained.config.protocol)
    result = read_result(folder / RESULT_FILE)
    values = [(name, result.mean(name)) for name in ("psnr", "ssim")]
    shown = ", ".join(f"{name.upper()} {value:.4g}" for name, value in values if value is not None)
    return StageOutcome(
        f"held-out frames: {shown}", {str(folder.relative_to(context.out)): "metrics and rendered frames"}
    )


def mesh(context: StageContext) -> StageOutcome:
    """Fuse the rendered depth into a mesh."""
    from coliags_plugin.engine.trained import load_trained
    from coliags_plugin.surface.meshing.writing import mesh_run

    trained = load_trained(context.run, context.device, context.scene)
    made = mesh_run(trained, context.run / "mesh", context.settings.mesh, overwrite=True)
    area = made.mesh.areas.sum()
    shown = f"{area / 100.0:.1f} cm²" if trained.scene.is_metric else f"{area:,.0f} square units"
    files = {f"run/mesh/mesh.{kind}": f"the surface as {kind.upper()}" for kind in MESH_FORMATS}
    return StageOutcome(f"{len(made.mesh):,} triangles, {shown}", files)


def coverage(context: StageContext) -> StageOutcome:
    """Measure the share of the wall seen in the video; left out where it cannot be measured."""
    from coliags_plugin.geometry.meshes.files import read_mesh
    from coliags_plugin.surface.coverage.page import summary
    from coliags_plugin.surface.coverage.writing import measure_scene

    scene = context.open_posed()
    if not scene.is_metric:
        return StageOutcome("left out, as the unit of length is unknown (--diameter gives one)")
    folder = context.run / "coverage"
    try:
        made = measure_scene(
            scene, read_mesh(context.run / "mesh" / "mesh.ply"), folder, context.settings.coverage, overwrite=True
        )
    except NotWritableError:
        raise
    except InputError as error:
        log.warning("no coverage: %s", error)
        return StageOutcome(f"left out: {error}")
    what = "what was seen and missed, for research use only"
    return StageOutcome(
        "; ".join(" ".join(line.split()).rstrip(";") for line in summary(made.coverage, made.evaluation)),
        {"run/coverage/coverage.html": what, "run/coverage/coverage.ply": "the same on the mesh"},
    )


def report(context: StageContext) -> StageOutcome:
    """Write the report of the run."""
    from coliags_plugin.comparison.report.page import Choices
    from coliags_plugin.comparison.report.report import write_report
    from coliags_plugin.engine.run_folder import RunFolder

    protocol = RunFolder(context.run).method().config.protocol
    title = f"Reconstruction of {context.source.name}"
    write_report([context.run], context.out / "report.html", ("html",), Choices(title=title), protocol)
    return StageOutcome("report.html", {"report.html": "views, metrics, training, provenance"})
