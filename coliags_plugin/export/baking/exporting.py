"""Runs as files of Gaussians, with a record of what they are and what they lose."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from coliags_plugin.contracts import GaussianField, knows_lamp
from coliags_plugin.core.checksums import file_sha256
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.files import write_json
from coliags_plugin.engine.held_light import held_light
from coliags_plugin.engine.provenance import software
from coliags_plugin.engine.trained import TrainedRun
from coliags_plugin.export.baking.baking import bake
from coliags_plugin.export.baking.cost import export_cost
from coliags_plugin.export.baking.explicit import cloud_of_field
from coliags_plugin.export.splats.cloud import SplatCloud
from coliags_plugin.export.splats.files import FORMATS, THICKNESS_SHARE, check_format, write_splats
from coliags_plugin.fields.explicit_gaussians import ExplicitGaussians
from coliags_plugin.lighting.lamps import HeldLight

log = logging.getLogger(__name__)

#: Of the record beside a file; incremented when a reader of the older version would misread it.
RECORD_VERSION = 1


@dataclass(frozen=True)
class Exported:
    """A written file of Gaussians, and the JSON file beside it with its content."""

    file: Path
    record_file: Path
    record: Mapping[str, Any]


def export_run(
    trained: TrainedRun, output: Path, form: str, light: str, measure: bool = True, overwrite: bool = False
) -> Exported:
    """Write the Gaussians of a run to a file, and ``FILE.json`` beside it.

    Explicit fields are written as they are. Fields that decode Gaussians for each view, or light them, are baked
    (:func:`~coliags_plugin.export.baking.baking.bake`) under a light that is held.

    Args:
        trained: The run.
        output: The file.
        form: Name of its format.
        light: Name of the light to bake in; of no effect where colours know no lamp.
        measure: Compare the file with the run on the held-out views, for the record.
        overwrite: Replace a file that is there.
    """
    check_format(form)
    record_file = output.with_name(f"{output.name}.json")
    for target in (output, record_file):
        if target.exists() and not overwrite:
            raise InputError(f"{target} already exists", "a new file", "Choose another --output, or pass --overwrite")
    field = _gaussian_field(trained)
    held: HeldLight | None = None
    baking: dict[str, Any] | None = None
    if isinstance(field, ExplicitGaussians):
        cloud = cloud_of_field(field)
    else:
        baked_in = held_light(light, trained.model, [frame.camera for frame in trained.scene.train])
        held = baked_in if knows_lamp(field) else None
        cloud, facts = bake(trained, baked_in)
        baking = {"light": held and {"name": light, **held.described}, **facts}
    cloud = _checked(cloud.with_thickness(THICKNESS_SHARE), trained)
    unit = trained.scene.length_unit
    comment = f"{trained.method} on {trained.scene.name}, exported by coliags_plugin; lengths in {unit}"
    write_splats(output, cloud, form, comment)
    read = FORMATS[form].read
    kept = cloud if read is None else read(output)
    record = {
        "format": "coliags-export",
        "version": RECORD_VERSION,
        "file": {
            "name": output.name,
            "format": form,
            "keeps": FORMATS[form].keeps,
            "bytes": output.stat().st_size,
            "sha256": file_sha256(output),
        },
        "gaussians": len(cloud),
        "sh_degree": cloud.degree,
        "bounds": {"min": cloud.means.min(axis=0).tolist(), "max": cloud.means.max(axis=0).tolist()},
        "unit": unit,
        "frame": "world of the scene",
        "run": {
            "method": trained.method,
            "scene": trained.scene.name,
            "fingerprint": trained.scene.provenance.get("fingerprint"),
            "seed": trained.seed,
            "step": trained.step,
        },
        "baking": baking,
        "left_out": {name: module.untrained_views for name, module in trained.model.view_modules.items()},
        "cost": export_cost(trained, kept, held) if measure else None,
        "software": software(),
    }
    write_json(record_file, record)
    return Exported(output, record_file, record)


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
        log.warning("view modules are no part of a file of Gaussians and are left out: %s", names)
    return field


def _checked(cloud: SplatCloud, trained: TrainedRun) -> SplatCloud:
    """The Gaussians that are finite, at least one."""
    usable = cloud.usable()
    if not usable.any():
        raise InputError(f"{trained.run.path} has no Gaussian to write", "a run whose field holds at least one")
    if not usable.all():
        log.warning("left out %d of %d Gaussians that are not finite", int((~usable).sum()), len(cloud))
    return cloud.part(usable)
