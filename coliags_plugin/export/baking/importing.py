"""Files of Gaussians as runs on a scene, which everything that takes a run takes."""

from __future__ import annotations

import logging
from pathlib import Path

import torch

from coliags_plugin.core.files import atomic_folder
from coliags_plugin.core.scenes import Scene
from coliags_plugin.engine.data_formats import load_method_for, load_scene
from coliags_plugin.engine.run_folder import RunFolder
from coliags_plugin.engine.trainer import Trainer
from coliags_plugin.export.splats.cloud import SplatCloud, load_cloud
from coliags_plugin.export.splats.files import read_splats

log = logging.getLogger(__name__)

#: Methods of imported Gaussians, by the number of their scales.
_METHODS = {3: "3dgs", 2: "2dgs"}
#: Training cameras, approximately, that are asked what they see of a file; and the share of it that is too few.
_CAMERAS, _FEW = 16, 0.01


def import_run(
    file: Path,
    data: Path,
    output: RunFolder,
    device: torch.device,
    data_format: str | None = None,
    overwrite: bool = False,
) -> None:
    """Make a run of a file of Gaussians: a run folder at step 0, to evaluate, render and report like any other.

    The file is in the frame and unit of the scene in the folder ``data``, which the named data manager reads, or the
    one that recognises it; ``device`` is recorded.
    """
    output.check_free(overwrite)
    cloud = read_splats(file)
    method = load_method_for(data, _METHODS[cloud.scales.shape[1]], data_format=data_format)
    config = method.config
    scene = load_scene(config, data)
    _warn_of_another_frame(scene, cloud, file)
    field = config.field.target(config.field.settings, len(cloud))
    load_cloud(field, cloud)
    trainer = Trainer(method, scene, str(data.resolve()), output, 0, device, field)
    provenance = trainer.provenance()
    del provenance["plan"]
    provenance["imported"] = {"file": file.name, "gaussians": len(cloud), "sh_degree": cloud.degree}
    with atomic_folder(output.path, overwrite=True) as scratch:
        trainer.run = RunFolder(scratch)
        trainer.run.rewrite(config.to_yaml(), provenance)
        trainer.save()


def _warn_of_another_frame(scene: Scene, cloud: SplatCloud, file: Path) -> None:
    """Say so where the training cameras have hardly any Gaussian in their images."""
    means = torch.from_numpy(cloud.means).double()
    seen = torch.zeros(len(means), dtype=torch.bool)
    for frame in scene.train[:: max(1, len(scene.train) // _CAMERAS)]:
        seen |= frame.camera.to(dtype=torch.float64).sees(means)[1]
    share = float(seen.float().mean())
    if share < _FEW:
        log.warning(
            "%s: %.2g %% of the Gaussians lie in the view of a training camera; is it in the world frame and unit (%s) "
            "of scene '%s'?",
            file,
            100.0 * share,
            scene.length_unit,
            scene.name,
        )
