"""Feature channels of the Gaussians drawn, which losses read."""

from __future__ import annotations

from jaxtyping import Float
from torch import Tensor

from coliags_plugin.contracts import TrainedModel, TrainingStep
from coliags_plugin.core.errors import InputError, did_you_mean


def drawn_channel(step: TrainingStep, channel: str) -> Float[Tensor, "N C"]:
    """A feature channel of the Gaussians that were drawn. [N, C]"""
    return step.output.drawn.gaussians.features[channel]


def refuse_without_channel(model: TrainedModel, channel: str, loss: str) -> None:
    """Refuse a field that lacks a feature channel.

    Args:
        model: The model.
        channel: Name of the channel.
        loss: Name of the loss that reads it.

    Raises:
        InputError: See above.
    """
    known = sorted(model.field.feature_channels)
    if channel not in known:
        raise InputError(
            f"loss '{loss}' reads channel '{channel}' of the Gaussians, and the field has {', '.join(known) or 'none'}",
            "a channel of the field",
            did_you_mean(channel, known) or "Remove the term, or choose another field, such as lit-gaussians",
        )
