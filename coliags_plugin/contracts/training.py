"""Training step, and the base classes of strategies, samplers, losses and observers of a run."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar
from typing import Protocol as TypingProtocol

import torch
from jaxtyping import Bool, Float, Int
from pydantic import Field as Option
from pydantic import model_validator
from torch import Tensor
from typing_extensions import Self, TypeVar

from coliags_plugin.contracts.fields import Field
from coliags_plugin.contracts.rendering import ViewModule
from coliags_plugin.contracts.schedule import Schedule, log_linear
from coliags_plugin.core.json_files import JsonObject
from coliags_plugin.core.render_output import RenderOutput
from coliags_plugin.core.scenes import Target, View
from coliags_plugin.core.settings import Configurable, Settings, SettingsT, refuse_zero_ends


@dataclass(frozen=True)
class TrainingStep:
    """One training step, as passed to losses and strategies.

    Attributes:
        output: What was rendered.
        target: What it is compared with.
        model: The field, and the modules by name.
        step: Counted from 1.
        schedule: Of the run.
        views: Rendered views, each as rendered and as shaded by each view module in turn.
    """

    output: RenderOutput
    target: Target
    model: TrainedModel
    step: int
    schedule: Schedule
    views: Sequence[tuple[View, Sequence[RenderOutput]]] = ()


class TrainedModel(TypingProtocol):
    """Interface of the model that losses and strategies may use."""

    @property
    def field(self) -> Field:
        """The :class:`Field`."""

    @property
    def view_modules(self) -> Mapping[str, ViewModule]:
        """View modules by their names in the method config."""


class ParameterRows(TypingProtocol):
    """Adds and removes rows of a field's parameters, and replaces values, together with gradients and Adam's moments.

    Parameters are named by their group, which must hold one parameter. [M, ...]
    """

    def add_rows(self, rows: Mapping[str, Tensor], parents: Int[Tensor, "B"] | None = None) -> None:
        """Append rows, which have no gradient and no momentum.

        Args:
            rows: What to append, by group. [B, ...]
            parents: For each new row, the row whose mean squared gradient it takes over, so that its first steps are
                no larger than its parent's; without, new rows start with none. [B]
        """

    def keep_rows(self, groups: Sequence[str], keep: Bool[Tensor, "M"]) -> None:
        """Keep only the rows of some groups where ``keep`` is True. [M]"""

    def replace_values(self, group: str, values: Tensor) -> None:
        """Replace the values of a group and reset their moments. [M, ...]"""


class Strategy(ABC, Configurable[SettingsT]):
    """Densification and pruning of a field between optimizer steps, with its own counters.

    Args:
        settings: Its options.
        generator: For its random choices.
        schedule: Of the run.
        extent: Of the scene (:attr:`Scene.extent`), scene units.
    """

    Settings: ClassVar[type[Settings]] = Settings
    #: Kinds of :attr:`Field.elements` that it can change; None where it changes nothing.
    serves: ClassVar[frozenset[str] | None]
    #: Attributes that are tensors of counters, saved with a checkpoint.
    counters: ClassVar[tuple[str, ...]] = ()

    def __init__(self, settings: SettingsT, generator: torch.Generator, schedule: Schedule, extent: float) -> None:
        self.settings = settings
        self.generator = generator
        self.schedule = schedule
        self.extent = extent

    @abstractmethod
    def plan(self) -> str:
        """One sentence for the log: the steps at which it grows or prunes, or why it will not."""

    def after_backward(self, step: TrainingStep, rows: ParameterRows) -> dict[str, int]:
        """Called after ``backward`` and before the optimisers step.

        Returns:
            Counts of changes for the log, for instance ``{"grown": 12, "pruned": 3}``; empty without changes.
        """
        return {}

    def state_dict(self) -> dict[str, Tensor]:
        """Counters for the checkpoint."""
        return {name: getattr(self, name) for name in self.counters}

    def load_state_dict(self, state: Mapping[str, Tensor]) -> None:
        """Load counters from a checkpoint."""
        for name in self.counters:
            setattr(self, name, state[name])


@dataclass(frozen=True)
class Draw:
    """A training frame, or some of its pixels, to render in a training step.

    Attributes:
        frame: Number of the training frame.
        pixels: Columns and rows; None for the whole frame. [P, 2]
    """

    frame: int
    pixels: Int[Tensor, "P 2"] | None = None


class Sampler(ABC, Configurable[SettingsT]):
    """Sequence of the frames, or pixel batches, that training steps render.

    Args:
        settings: Its options.
        sizes: Width and height of every training frame.
        generator: For its choices.

    Attributes:
        queue: Frames that it has planned for further steps; saved with a checkpoint and restored by assignment.
    """

    Settings: ClassVar[type[Settings]] = Settings
    #: Whether its steps see whole images; losses with ``whole_image`` need that.
    whole_images: ClassVar[bool]

    def __init__(self, settings: SettingsT, sizes: Sequence[tuple[int, int]], generator: torch.Generator) -> None:
        self.settings = settings
        self.sizes = sizes
        self.generator = generator
        self.queue: list[int] = []

    @abstractmethod
    def next(self) -> list[Draw]:
        """The draws of the next step, at least one."""


class LossSettings(Settings):
    """Weight of a loss term over the run, and the steps at which it is active.

    ``weight`` and ``final_weight`` are above 0; step numbers keep their share of a run of another length.
    """

    weight: float  # factor of the term, at the start where final_weight is set
    final_weight: float | None = None  # factor at the last step, approached log-linearly; null: constant weight
    min_weight: float = Option(default=0.0, ge=0.0)  # lower bound of the decaying weight
    from_step: int = Option(default=0, ge=0)  # the term is active after this step
    until_step: int | None = Option(default=None, ge=1)  # the term is active up to this step; null: to the end

    @model_validator(mode="after")
    def _ends_above_zero(self) -> Self:
        refuse_zero_ends(self, "weight", "final_weight")
        return self

    @model_validator(mode="after")
    def _from_before_until(self) -> Self:
        if self.until_step is not None and self.until_step <= self.from_step:
            raise ValueError(f"until_step {self.until_step} does not come after from_step {self.from_step}")
        return self

    def active(self, step: int, schedule: Schedule) -> bool:
        """True if the term counts at a step, counted from 1."""
        return step > schedule.at(self.from_step) and (self.until_step is None or step <= schedule.at(self.until_step))

    def weight_at(self, step: int, steps: int) -> float:
        """The weight at step ``step`` (from 1) of ``steps``."""
        if self.final_weight is None:
            return self.weight
        return max(self.min_weight, log_linear(self.weight, self.final_weight, step / steps))


#: Settings of a loss.
LossSettingsT = TypeVar("LossSettingsT", bound=LossSettings, default=LossSettings)


class Loss(ABC, Configurable[LossSettingsT]):
    """One scalar term of the loss; its weight and schedule are settings, applied by the engine."""

    Settings: ClassVar[type[Settings]] = LossSettings
    #: Attributes of :class:`Target` that at least one training frame must have (``depth``, ``sparse_depth``).
    needs: ClassVar[frozenset[str]] = frozenset()
    #: Such attributes of which any will do; it is 0 where a frame has none, and training warns if no frame has any.
    reads_any: ClassVar[frozenset[str]] = frozenset()
    #: Whether it depends on neighbouring pixels, so that batches of single pixels cannot be used.
    whole_image: ClassVar[bool] = False
    #: Whether it draws the rendered depth to ``Target.depth`` as to the truth, by confidence weighted at most.
    trusts_depth: ClassVar[bool] = False
    #: Whether it reads ``output.splats``, which only splatting renderers deliver.
    needs_splats: ClassVar[bool] = False

    def __init__(self, settings: LossSettingsT) -> None:
        self.settings = settings

    @property
    def wants(self) -> frozenset[str]:
        """Outputs beyond rgb and alpha that the renderer must deliver."""
        return frozenset()

    def check(self, model: TrainedModel) -> None:
        """Check, before training, that the model has what the term reads.

        Raises:
            InputError: It lacks something.
        """

    @abstractmethod
    def __call__(self, step: TrainingStep) -> Float[Tensor, ""]:
        """The unweighted term; pixels whose ``step.target.mask`` is False are ignored."""


class StopTraining(Exception):
    """Raised by a follower: training ends after this step, whose state is saved; the message is the reason."""


class Follower:
    """Observer of a training run, which it does not change; one that fails is left out from then on, with a warning."""

    def logged(self, row: JsonObject) -> None:
        """A row has been added to the training log: ``step``, ``loss``, ``terms``, ``psnr`` (dB), ``seconds`` ..."""

    def stepped(self, step: int) -> None:
        """A training step is done; the model stays as it is until this returns."""

    def close(self) -> None:
        """Training has ended, however it did."""


class Logger(Follower, ABC):
    """Base class of loggers, which copy the rows of the training log to another service or format.

    Args:
        run: The run folder.
        title: Method, scene and seed.
        config: The method config as plain values.
        step: Of the checkpoint that training goes on from; 0 at the start. Later rows of an earlier attempt are void.
    """

    #: A library that may not be installed.
    library: ClassVar[str]

    @abstractmethod
    def __init__(self, run: Path, title: str, config: Mapping[str, Any], step: int) -> None: ...
