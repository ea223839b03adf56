"""Base classes of all kinds of components, which component packages implement without importing one another."""

from coliags_plugin.contracts.fields import (
    AppearanceHead,
    Field,
    GaussianField,
    GeometryHead,
    Head,
    HeadNetworks,
    RadianceField,
    RadianceLevel,
    RadianceSamples,
    SeenAnchors,
)
from coliags_plugin.contracts.rendering import Availability, Renderer, ViewModule
from coliags_plugin.contracts.scenes import Comparison, DataManager, Metric, Protocol
from coliags_plugin.contracts.schedule import Schedule, log_linear, steps_text
from coliags_plugin.contracts.training import (
    Draw,
    Follower,
    Logger,
    Loss,
    LossSettings,
    ParameterRows,
    Sampler,
    StopTraining,
    Strategy,
    TrainedModel,
    TrainingStep,
)

__all__ = [
    "AppearanceHead",
    "Availability",
    "Comparison",
    "DataManager",
    "Draw",
    "Field",
    "Follower",
    "GaussianField",
    "GeometryHead",
    "Head",
    "HeadNetworks",
    "Logger",
    "Loss",
    "LossSettings",
    "Metric",
    "ParameterRows",
    "Protocol",
    "RadianceField",
    "RadianceLevel",
    "RadianceSamples",
    "Renderer",
    "Sampler",
    "Schedule",
    "SeenAnchors",
    "StopTraining",
    "Strategy",
    "TrainedModel",
    "TrainingStep",
    "ViewModule",
    "log_linear",
    "steps_text",
]
