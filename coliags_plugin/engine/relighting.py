"""Exchange of the lamp of a trained run."""

from __future__ import annotations

from dataclasses import replace

from coliags_plugin.config.registry import fields
from coliags_plugin.contracts import LitField
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.lamps import Lamp
from coliags_plugin.engine.model import Model
from coliags_plugin.engine.trained import TrainedRun


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
    lit_model = Model(model.field.with_lamp(lamp), model.renderer, model.view_modules).eval()
    return replace(trained, model=lit_model, lamp=lamp)
