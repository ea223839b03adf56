"""Runs as files of Gaussians, with a record of what they are and what they lose; and such files as runs."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch

from coliags_plugin.config.options import ExportOptions, ImportOptions
from coliags_plugin.contracts import GaussianField
from coliags_plugin.core.errors import InputError, check_name
from coliags_plugin.core.files import atomic_folder, file_sha256, refuse_existing, write_json
from coliags_plugin.core.lamps import HeldLight
from coliags_plugin.core.scenes import Frame
from coliags_plugin.engine.data_formats import at_scale, load_method_for, load_scene, training_scale
from coliags_plugin.engine.devices import software
from coliags_plugin.engine.held_light import held_light, render_held
from coliags_plugin.engine.model import Model
from coliags_plugin.engine.progress import ProgressReport
from coliags_plugin.engine.run_folder import RunFolder
from coliags_plugin.engine.scoring import Scorer, shows_nothing
from coliags_plugin.engine.trained import TrainedRun
from coliags_plugin.engine.trainer import Trainer
from coliags_plugin.export.baking.baking import bake
from coliags_plugin.export.baking.distillation import adjusted_camera, model_of_gaussians
from coliags_plugin.export.splats.cloud import SplatCloud, field_of_cloud, load_cloud
from coliags_plugin.export.splats.formats import READERS, WRITERS, read_splats, write_splats
from coliags_plugin.reporting.numbers import counted

log = logging.getLogger(__name__)

#: Of the record beside a file; incremented when a reader of the older version would misread it.
RECORD_VERSION = 2
#: Metrics of protocols that are compared.
_METRICS = ("psnr", "depth_mse")
#: What each light is in a file (:data:`~coliags_plugin.engine.held_light.LIGHTS`).
_LIGHTS = {
    "recorded": "the lamp of every training camera, averaged",
    "mean": "a lamp that stays at the mean training camera",
    "flattened": "the same everywhere",
}
#: Warned of where the light alone costs more, against the recorded frames, dB.
_MUCH = 1.0
#: Methods of imported Gaussians, by the number of their scales.
_METHODS = {3: "3dgs", 2: "2dgs"}
#: Views, approximately, of which an imported file must show something.
_VIEWS = 16


@dataclass(frozen=True)
class Exported:
    """A written file of Gaussians, and the JSON file beside it with its content."""

    file: Path
    record_file: Path
    record: Mapping[str, Any]

    @property
    def measured(self) -> Mapping[str, Mapping[str, Any]]:
        """What :func:`measure` found, by test set; empty where nothing was measured."""
        return self.record["measured"] or {}

    @property
    def text(self) -> str:
        """Number of Gaussians and file size; PSNR as viewers show the file, and in the baked light. Several lines."""
        record, baking = self.record, self.record["baking"] or {}
        text = f"{self.file.name}: {record['gaussians']:,} Gaussians, {record['file']['bytes'] / 1e6:.1f} MB"
        lines = [text, *psnr_lines(self.measured, "recorded", "in a viewer, against the recorded frames")]
        if light := baking.get("light"):
            said = f"in the baked light, {light['name']} ({_LIGHTS[light['name']]})"
            lines += psnr_lines(self.measured, "in_light", said)
        return "\n".join(lines)


def export_run(trained: TrainedRun, options: ExportOptions) -> list[Exported]:
    """Write the Gaussians of a run to files by their formats, and ``FILE.json`` beside each.

    Explicit Gaussians are written as they are. Surfels, and Gaussians that a field decodes for each view, or lights,
    are baked (:func:`~coliags_plugin.export.baking.baking.bake`) once, under a light that is held, given by its name;
    it has no effect where colours know no lamp. With ``measure``, each file is compared with the run on the held-out
    views, with a warning where the baked light looks much different from the recorded one.
    """
    scene, formats = trained.scene, options.formats
    file = options.output or trained.run.path / "export" / f"{trained.provenance['scene']['name']}.{formats[0]}"
    outputs = {form: file.with_suffix(f".{form}") if len(formats) > 1 else file for form in formats}
    for form, output in outputs.items():
        check_name("format", form, WRITERS)
        for target in (output, _record_file(output)):
            refuse_existing(target, options.overwrite, "a new file")
    field = _gaussian_field(trained)
    light = held_light(options.light, trained.model, [frame.camera for frame in scene.train])
    cloud, facts = bake(trained, light, options.seconds)
    cloud = cloud.with_thickness().checked(trained.run.path)
    comment = f"{trained.method} on {scene.name}, exported by coliags_plugin; lengths in {scene.length_unit}"
    exported = []
    for form, output in outputs.items():
        write_splats(output, cloud, form, comment)
        stored = READERS[form](output) if form in READERS else cloud
        size, sha256 = output.stat().st_size, file_sha256(output)
        record = {
            "format": "coliags-export",
            "version": RECORD_VERSION,
            "file": {"name": output.name, "format": form, "bytes": size, "sha256": sha256},
            "gaussians": len(cloud),
            "sh_degree": cloud.degree,
            "bounds": {"min": cloud.means.min(axis=0).tolist(), "max": cloud.means.max(axis=0).tolist()},
            "unit": scene.length_unit,
            "frame": "world of the scene",
            "run": {
                "method": trained.method,
                "scene": scene.name,
                "fingerprint": scene.provenance.fingerprint,
                "seed": trained.seed,
                "step": trained.step,
            },
            "baking": {"light": light_facts(options.light, field, light), **facts} if facts else None,
            "measured": measure(trained, stored, light if field.knows_lamp else None) if options.measure else None,
            "software": software(),
        }
        write_json(_record_file(output), record)
        exported.append(Exported(output, _record_file(output), record))
    _warn_of_light(exported[0], options.light if field.knows_lamp else "recorded")
    return exported


def _warn_of_light(exported: Exported, light: str) -> None:
    """Warn where the brightness of a file differs much from that of the recorded frames."""
    pairs = [(test_set["in_light"], test_set["recorded"]) for test_set in exported.measured.values()]
    lost = max((held["psnr"] - recorded["psnr"] for held, recorded in pairs if "psnr" in recorded), default=0.0)
    cause, nearer = "frames have no gains", ""
    if light != "recorded":
        cause, nearer = "the lamp that moved with the camera is baked", ", and `light=recorded` comes nearer"
    if lost > _MUCH:
        log.warning(
            "%s: brightness differs from the video (%.1f dB), as %s; `coliags view RUN` shows the run itself%s",
            *(exported.file.name, lost, cause, nearer),
        )


def light_facts(name: str, field: GaussianField, light: HeldLight | None) -> dict[str, Any] | None:
    """Name and parameters of a light as JSON values; None where a field's colours do not depend on a lamp."""
    return {"name": name, **(light.described if light else {})} if field.knows_lamp else None


def _record_file(output: Path) -> Path:
    return output.with_name(f"{output.name}.json")


def _gaussian_field(trained: TrainedRun) -> GaussianField:
    field = trained.model.field
    if trained.lamp is not None:
        raise InputError(
            "export of a relit run", "the lamp that the data were recorded with", "Export the run as loaded"
        )
    if not isinstance(field, GaussianField):
        raise InputError(
            f"{trained.run.path} is a run of '{trained.method}', whose field '{trained.config.field.name}' is density "
            "and colour in space and has no Gaussians",
            "a splatting method",
            "`coliags mesh RUN` writes its surface",
        )
    if trained.model.view_modules:
        names = ", ".join(trained.model.view_modules)
        log.warning("what view modules do to single frames is no part of a file of Gaussians: %s", names)
    return field


def measure(trained: TrainedRun, cloud: SplatCloud, light: HeldLight | None) -> dict[str, dict[str, Any]]:
    """Compare a cloud with its run on every held-out frame, by the run's protocol; means per test set.

    Against the frames as recorded, the cloud's values are those that an import of its file evaluates to: it has no
    lamp that moves, and no frame's own gain. In the held light it is compared with the frames brought to it: the run's
    own render there, from where the run's view modules place the view, plus what the run's render misses of the
    frame. By that the run's PSNR is that of its evaluation, and the cloud's differs by baking alone.

    Returns:
        By test set: ``frames``, their number; ``run``, ``recorded`` and ``in_light``, means by metric (``psnr``, dB,
        and ``depth_mse``, mm^2) of the run, and of the cloud against frames as recorded and in the light; and
        ``psnr_between``, dB, of the cloud against the run in that light.
    """
    scorer = Scorer(trained.config.protocol, _METRICS)
    baked = model_of_gaussians(field_of_cloud(cloud), trained)
    sets = {name: frames for name, frames in trained.scene.test_sets.items() if frames}
    measured, count = {}, 0
    with ProgressReport("compare with the run", sum(map(len, sets.values()))) as progress:
        for name, frames in sets.items():
            rows = []
            for frame in frames:
                rows.append(_scores(trained, scorer, baked, frame.to(trained.device), light))
                progress.update(count := count + 1)
            means = {part: _means([row[part] for row in rows]) for part in rows[0]}
            between = means.pop("between").get("psnr")
            measured[name] = {"frames": len(rows), **means, "psnr_between": between}
    return measured


def psnr_lines(measured: Mapping[str, Mapping[str, Any]], part: str, said: str) -> list[str]:
    """PSNR of what :func:`measure` returns under ``part``, beside the run's: a line for each test set that has it."""
    return [
        f"{said}: {test_set[part]['psnr']:.2f} dB on {counted(test_set['frames'], 'held-out frame')} ({name}), "
        f"the run {test_set['run']['psnr']:.2f} dB"
        for name, test_set in measured.items()
        if "psnr" in test_set[part]
    ]


@torch.no_grad()
def _scores(
    trained: TrainedRun, scorer: Scorer, baked: Model, frame: Frame, light: HeldLight | None
) -> dict[str, dict[str, float]]:
    """Values by metric, of ``run``, ``recorded``, ``in_light`` and ``between``."""
    run = scorer.protocol.compare(scorer.render(trained.model, frame), frame)
    recorded = scorer.protocol.compare(scorer.render(baked, frame), frame)
    frame = replace(frame, camera=adjusted_camera(trained, frame))
    export = scorer.protocol.compare(scorer.render(baked, frame), frame)
    relit = scorer.protocol.compare(render_held(trained.model, frame.camera, light, scorer.wants), frame)
    at_light = relit.rgb + (run.true_rgb - run.rgb)
    return {
        "run": scorer.score(run).values,
        "recorded": scorer.score(recorded).values,
        "in_light": scorer.score(replace(export, true_rgb=at_light)).values,
        "between": scorer.score(replace(export, true_rgb=relit.rgb)).values,
    }


def _means(rows: list[dict[str, float]]) -> dict[str, float]:
    """Means of the metrics that some frame has, over the frames that have them."""
    values = {name: [row[name] for row in rows if name in row] for name in _METRICS}
    return {name: sum(numbers) / len(numbers) for name, numbers in values.items() if numbers}


def import_run(options: ImportOptions, output: RunFolder, device: torch.device) -> None:
    """Make a run of a file of Gaussians: a run folder at step 0, to evaluate, render and report like any other.

    The file is in the frame and unit of the scene; ``device`` is recorded.
    """
    file, data = options.file, options.data
    output.check_free(options.overwrite)
    cloud = read_splats(file)
    method = load_method_for(data, _METHODS[cloud.scales.shape[1]], data_format=options.data_format)
    config = method.config
    scene = load_scene(config, data)
    # As in training: the near plane and other constants are lengths in mm.
    scale = training_scale(scene)
    scene, cloud = at_scale(scene, scale, config.near_plane), cloud.scaled(scale)
    field = config.field.target(config.field.settings, len(cloud))
    load_cloud(field, cloud)
    trainer = Trainer(method, scene, str(data.resolve()), output, 0, device, field)
    _warn_of_another_frame(trainer, file)
    provenance = trainer.provenance()
    del provenance["plan"]
    provenance["imported"] = {"file": file.name, "gaussians": len(cloud), "sh_degree": cloud.degree}
    with atomic_folder(output.path, overwrite=True) as scratch:
        trainer.run = RunFolder(scratch)
        trainer.run.rewrite(config.to_yaml(), provenance)
        trainer.save()


@torch.no_grad()
def _warn_of_another_frame(trainer: Trainer, file: Path) -> None:
    """Warn where views show nothing of the Gaussians."""
    scene = trainer.scene
    views = [frame for frames in scene.test_sets.values() for frame in frames] or scene.train
    placed = [frame.to(trainer.device) for frame in views[:: max(1, len(views) // _VIEWS)]]
    shown = (trainer.model.render(frame.camera, view=frame.view(trained=False)).alpha for frame in placed)
    blank = sum(map(shows_nothing, shown, placed))
    if blank:
        log.warning(
            "%s: %d of %d views of it show nothing, nothing nearer than near_plane is drawn; "
            "is it in the world frame and unit (%s) of scene '%s'?",
            *(file, blank, len(placed), scene.length_unit, scene.name),
        )
