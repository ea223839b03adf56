"""Fields that decode or light their Gaussians for each view, as one cloud for all views."""

from __future__ import annotations

from typing import Any

import torch

from coliags_plugin.contracts import gaussians_under
from coliags_plugin.core.scenes import Frame
from coliags_plugin.engine.held_light import gaussians_of, splatting_of
from coliags_plugin.engine.progress import ProgressReport
from coliags_plugin.engine.trained import TrainedRun
from coliags_plugin.export.baking.averages import GaussianAverages, blending_weights
from coliags_plugin.export.baking.explicit import cloud_of_field
from coliags_plugin.export.baking.harmonics import SeenColors, fit_harmonics
from coliags_plugin.export.baking.refinement import adjusted_camera, needs_refinement, refine
from coliags_plugin.export.splats.cloud import SplatCloud
from coliags_plugin.fields.explicit_gaussians import ExplicitGaussians
from coliags_plugin.fields.spherical_harmonics import MAX_DEGREE
from coliags_plugin.lighting.lamps import HeldLight

#: Training views, evenly spaced, at most: whose Gaussians are averaged, and whose colours are fitted.
_VIEWS, _COLOR_VIEWS = 120, 30


def bake(trained: TrainedRun, light: HeldLight) -> tuple[SplatCloud, dict[str, Any]]:
    """One cloud of Gaussians for all views, under a held light, and facts for its record.

    Every Gaussian is averaged over training views, and its colours are fitted with spherical harmonics by least
    squares, both weighted by how much each view shows of it. Where these averages lose much, as they do of Gaussians
    that are others in every view, they are refined on the training views
    (:mod:`~coliags_plugin.export.baking.refinement`).
    """
    views = trained.scene.train[:: -(-len(trained.scene.train) // _VIEWS)]
    field = _averaged(trained, views, light)
    steps = refine(field, trained, light) if needs_refinement(field, trained, light) else 0
    return cloud_of_field(field), {"views": len(views), "refinement_steps": steps}


def _averaged(trained: TrainedRun, views: list[Frame], light: HeldLight) -> ExplicitGaussians:
    field, renderer = gaussians_of(trained.model), splatting_of(trained.model)
    averages = GaussianAverages(field.element_count, field.slots_per_element, 3, trained.device)
    seen: list[SeenColors] = []
    every = -(-len(views) // _COLOR_VIEWS)
    with ProgressReport("bake: average over views", len(views)) as progress:
        for index, frame in enumerate(views):
            camera = adjusted_camera(trained, frame)
            with torch.no_grad():
                gaussians = gaussians_under(field, camera, light)
            weights = blending_weights(renderer, gaussians, camera)
            averages.add(gaussians, weights)
            if index % every == 0:
                seen.append(SeenColors.of(gaussians, weights, camera))
            progress.update(index + 1)
    kept = averages.kept()
    return averages.field(kept, fit_harmonics(seen, kept, averages.gaussians(kept).colors, MAX_DEGREE))
