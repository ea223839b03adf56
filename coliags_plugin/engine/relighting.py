"""Other light for a trained run: another lamp, or the same light everywhere."""

from __future__ import annotations

from dataclasses import replace

from coliags_plugin.config.registry import fields
from coliags_plugin.contracts import LitField
from coliags_plugin.core.errors import InputError
from coliags_plugin.engine.held_light import gaussians_of, held_light, splatting_of
from coliags_plugin.engine.model import Model
from coliags_plugin.engine.trained import TrainedRun
from coliags_plugin.lighting.lamps import Lamp


def relight(trained: TrainedRun, lamp: Lamp) -> TrainedRun:
    """The run under another lamp; it shares the parameters.

    Raises:
        InputError: The run's field does not model the lamp apart from the tissue.
    """
    model = trained.model
    if not isinstance(model.field, LitField):
        lit = ", ".join(name for name in fields if issubclass(fields.get(name), LitField))
        raise InputError(
            f"another lamp for method '{trained.method}', whose field '{trained.config.field.name}' has the light in "
            "its colours",
            f"a method with one of these fields: {lit}",
            "Train such a method, for instance pr-endo",
        )
    lit_model = Model(model.field.with_lamp(lamp), model.renderer, model.view_modules, model.near_plane).eval()
    return replace(trained, model=lit_model, lamp=lamp)


def flatten(trained: TrainedRun) -> TrainedRun:
    """The run in the same light everywhere: at the median distance and angle of what the training cameras see.

    View modules are left out, so that no gain is applied; it shares the parameters.

    Raises:
        InputError: The method does not make Gaussians that are drawn by this package.
    """
    splatting_of(trained.model)
    gaussians_of(trained.model)
    cameras = [frame.camera for frame in trained.scene.train]
    return replace(trained, held=held_light("flattened", trained.model, cameras))
