"""What each kind of component promises. Rooms implement these and never import one another."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import torch
from jaxtyping import Bool, Float
from pydantic import Field as Option
from pydantic import model_validator
from torch import Tensor, nn
from typing_extensions import Self

from coliags_plugin.core.cameras import Camera
from coliags_plugin.core.gaussians import Gaussians, RenderOutput
from coliags_plugin.core.progress import Progress
from coliags_plugin.core.scenes import Frame, Scene
from coliags_plugin.core.settings import Settings, refuse_zero_ends


class DataManager(ABC):
    """A dataset on disk -> :class:`Scene`. Never writes into the dataset."""

    Settings: ClassVar[type[Settings]]

    def __init__(self, settings: Any) -> None:
        self.settings = settings

    @classmethod
    def recognise(cls, path: Path) -> str | None:
        """What in the folder says that it is this manager's to read; None where nothing does. Reads no pixels."""
        return None

    @abstractmethod
    def load(self, path: Path, progress: Progress | None = None) -> Scene:
        """Read the scene.

        Args:
            path: Its folder (or file, where a data set is one).
            progress: Told ``(what, done, total)`` while pictures are read.

        Raises:
            InputError: The folder is missing or is not what this data manager reads.
        """


class Field(nn.Module, ABC):
    """What a scene looks like from anywhere: :class:`Camera` -> :class:`Gaussians`."""

    Settings: ClassVar[type[Settings]]
    #: ``gaussians3d``, ``surfels`` or ``radiance``
    primitive: ClassVar[str]

    @classmethod
    @abstractmethod
    def from_scene(cls, scene: Scene, settings: Any, generator: torch.Generator) -> Self:
        """A fresh field on the scene's initial points."""

    @classmethod
    @abstractmethod
    def from_state(cls, state: Mapping[str, Tensor], settings: Any) -> Self:
        """The field a checkpoint holds, however many elements it has grown to."""

    @abstractmethod
    def gaussians(self, camera: Camera) -> Gaussians:
        """The Gaussians this camera sees, differentiable with respect to the field's parameters."""

    @abstractmethod
    def parameter_groups(self) -> dict[str, list[nn.Parameter]]:
        """Trainable parameters by the name that a method config's ``optimizers`` uses."""


@dataclass(frozen=True)
class Availability:
    """Whether a renderer can run here, and why or why not."""

    ok: bool
    reason: str


class Renderer(ABC):
    """Field + Camera -> RenderOutput. Declares what it can serve; the engine refuses an impossible pair."""

    Settings: ClassVar[type[Settings]]
    primitives: ClassVar[frozenset[str]]
    outputs: ClassVar[frozenset[str]]
    #: torch device types
    devices: ClassVar[frozenset[str]]

    def __init__(self, settings: Any) -> None:
        self.settings = settings

    @classmethod
    @abstractmethod
    def availability(cls) -> Availability:
        """Whether this machine can run it."""

    @abstractmethod
    def render(
        self,
        field: Field,
        camera: Camera,
        wants: Sequence[str] = ("rgb", "alpha"),
        pixels: Tensor | None = None,
    ) -> RenderOutput:
        """Render one view.

        Args:
            field: What to draw; its ``primitive`` must be one this renderer serves.
            camera: Where from.
            wants: Names from :data:`coliags_plugin.core.gaussians.OUTPUTS`; rgb and alpha always come.
            pixels: For renderers of radiance fields: only these pixels. Splatting renderers draw whole images.
        """


@dataclass(frozen=True)
class Schedule:
    """How long a run is, and the run length for which the step numbers in its config were written.

    The one rule for every method (docs/configs.md): step numbers in a config keep their share of the run, so
    ``--steps`` moves them; intervals between events do not change.

    Attributes:
        steps: Steps of this run.
        written_for: Steps of the run that the config's step numbers mean.
    """

    steps: int
    written_for: int

    def at(self, step: int) -> int:
        """The step of this run at which the config's ``step`` falls."""
        return round(step * self.steps / self.written_for)


class Strategy(ABC):
    """Grows, splits and prunes a field between optimiser steps. Owns its counters.

    Args:
        settings: Its options.
        generator: For whatever is left to chance.
        schedule: Of the run.
    """

    Settings: ClassVar[type[Settings]]

    def __init__(self, settings: Any, generator: torch.Generator, schedule: Schedule) -> None:
        self.settings = settings
        self.generator = generator
        self.schedule = schedule

    @abstractmethod
    def plan(self) -> str:
        """One sentence for the log at the start: the steps at which it grows or prunes, or why it will not."""

    @abstractmethod
    def after_backward(
        self, step: int, field: Any, optimizers: Mapping[str, torch.optim.Optimizer], output: RenderOutput
    ) -> dict[str, int]:
        """Called after ``backward`` of step ``step`` (counted from 1) and before the optimisers step.

        Returns:
            What was done, for the log (for instance ``{"grown": 12, "pruned": 3}``); empty when nothing was.
        """

    def state_dict(self) -> dict[str, Tensor]:
        """Counters for the checkpoint."""
        return {}

    def load_state_dict(self, state: Mapping[str, Tensor]) -> None:  # noqa: B027 (stateless unless overridden)
        """Restore what :meth:`state_dict` gave."""


class Loss(ABC):
    """One scalar term. Its weight and schedule are settings, applied by the engine."""

    Settings: ClassVar[type[LossSettings]]

    def __init__(self, settings: Any) -> None:
        self.settings = settings

    #: Whether frames without depth make this term meaningless.
    needs_depth: ClassVar[bool] = False
    #: Whether frames without depth at single points (:class:`SparseDepth`) make this term meaningless.
    needs_sparse_depth: ClassVar[bool] = False

    @property
    def wants(self) -> frozenset[str]:
        """Outputs beyond rgb and alpha that the renderer must deliver."""
        return frozenset()

    @abstractmethod
    def __call__(self, output: RenderOutput, frame: Frame) -> Float[Tensor, ""]:
        """The unweighted term. Pixels whose ``frame.mask`` is False count for nothing."""


class LossSettings(Settings):
    """Weight of a term: constant, or log-linear from ``weight`` to ``final_weight``, both above 0, over the run.

    It falls no further than to ``min_weight``.
    """

    weight: float
    final_weight: float | None = None
    min_weight: float = Option(default=0.0, ge=0.0)

    @model_validator(mode="after")
    def _ends_above_zero(self) -> Self:
        refuse_zero_ends(self, "weight", "final_weight")
        return self

    def weight_at(self, step: int, steps: int) -> float:
        """The weight at step ``step`` (from 1) of ``steps``."""
        if self.final_weight is None:
            return self.weight
        return max(self.min_weight, log_linear(self.weight, self.final_weight, step / steps))


def log_linear(start: float, end: float, progress: float) -> float:
    """``start`` to ``end`` on a straight line in the logarithm; progress is clipped to [0, 1] (docs/methods.md 2.3).

    Raises:
        ValueError: An end is not above 0: it has no logarithm.
    """
    if not (start > 0.0 and end > 0.0):
        raise ValueError(f"log_linear({start}, {end}): expected both ends above 0")
    u = min(max(progress, 0.0), 1.0)
    return float(start ** (1.0 - u) * end**u)


@dataclass(frozen=True)
class Comparison:
    """A rendered view beside its truth, as one protocol sees them. Metrics read nothing else.

    Attributes:
        rgb: Rendered, in [0, 1]. [H, W, 3]
        true_rgb: [H, W, 3]
        valid: Pixels that count for image metrics. [H, W]
        depth: Rendered z-depth of the protocol's kind, mm; None where the frame has no true depth. [H, W]
        true_depth: mm. [H, W]
        depth_valid: Pixels that count for depth metrics. [H, W]
    """

    rgb: Float[Tensor, "H W 3"]
    true_rgb: Float[Tensor, "H W 3"]
    valid: Bool[Tensor, "H W"]
    depth: Float[Tensor, "H W"] | None = None
    true_depth: Float[Tensor, "H W"] | None = None
    depth_valid: Bool[Tensor, "H W"] | None = None


class Metric(ABC):
    """Comparison -> number."""

    Settings: ClassVar[type[Settings]]
    higher_is_better: ClassVar[bool]
    unit: ClassVar[str]

    def __init__(self, settings: Any) -> None:
        self.settings = settings

    @abstractmethod
    def __call__(self, comparison: Comparison) -> float:
        """The figure of one frame.

        Raises:
            UnavailableError: It cannot be had; the text says why.
        """


class Protocol(ABC):
    """How figures are made: which depth, which mask, through which bit depth, by which flavour of each metric."""

    name: ClassVar[str]
    #: Raised whenever a figure it yields could change.
    version: ClassVar[int]
    description: ClassVar[str]
    #: Renderer outputs it needs beyond rgb and alpha.
    wants: ClassVar[frozenset[str]]
    #: Result name -> (metric name, metric options)
    metrics: ClassVar[Mapping[str, tuple[str, Mapping[str, Any]]]]

    @abstractmethod
    def compare(self, output: RenderOutput, frame: Frame) -> Comparison:
        """What the metrics of this protocol look at."""
