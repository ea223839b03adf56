"""Training step, and the base classes of strategies and samplers."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Generic
from typing import Protocol as TypingProtocol

import torch
from jaxtyping import Bool, Int
from torch import Tensor
from typing_extensions import TypeVar

from coliags_plugin.contracts.fields import Field
from coliags_plugin.contracts.rendering import ViewModule
from coliags_plugin.contracts.schedule import Schedule
from coliags_plugin.core.render_output import RenderOutput
from coliags_plugin.core.scenes import Target
from coliags_plugin.core.settings import Settings, SettingsT

#: Field, or what a strategy uses of one.
FieldT = TypeVar("FieldT", default=Any)
FieldT_co = TypeVar("FieldT_co", covariant=True, default=Field)


@dataclass(frozen=True)
class TrainingStep(Generic[FieldT_co]):
    """One training step, as passed to losses and strategies.

    Attributes:
        output: What was rendered.
        target: What it is compared with.
        model: The field, and the modules by name.
        step: Counted from 1.
        schedule: Of the run.
    """

    output: RenderOutput
    target: Target
    model: TrainedModel[FieldT_co]
    step: int
    schedule: Schedule


class TrainedModel(TypingProtocol[FieldT_co]):
    """Interface of the model that losses and strategies may use."""

    @property
    def field(self) -> FieldT_co:
        """The :class:`Field`."""

    @property
    def view_modules(self) -> Mapping[str, ViewModule]:
        """View modules by their names in the method config."""


class ParameterRows(TypingProtocol):
    """Adds, removes and resets rows of a field's parameters together with their gradients and Adam's moments.

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

    def reset_rows(self, group: str, rows: Bool[Tensor, "M"] | None = None) -> None:
        """Reset Adam's moments of some rows, or of all rows without ``rows``. [M]"""

    def replace_values(self, group: str, values: Tensor) -> None:
        """Replace the values of a group and reset their moments. [M, ...]"""


class Strategy(ABC, Generic[SettingsT, FieldT]):
    """Densification and pruning of a field between optimizer steps, with its own counters.

    Args:
        settings: Its options.
        generator: For its random choices.
        schedule: Of the run.
        extent: Of the scene (:attr:`Scene.extent`), scene units.
    """

    Settings: ClassVar[type[Settings]]
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

    def before_step(self, step: int, field: FieldT, rows: ParameterRows) -> None:
        """Called before step ``step`` renders."""

    def after_backward(self, step: TrainingStep[FieldT], rows: ParameterRows) -> dict[str, int]:
        """Called after ``backward`` and before the optimisers step.

        Returns:
            Counts of changes for the log, for instance ``{"grown": 12, "pruned": 3}``; empty without changes.
        """
        return {}

    def after_step(self, step: TrainingStep[FieldT], rows: ParameterRows) -> dict[str, int]:
        """Called after the optimisers have stepped; returns like :meth:`after_backward`."""
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


class Sampler(ABC, Generic[SettingsT]):
    """Sequence of the frames, or pixel batches, that training steps render.

    Args:
        settings: Its options.
        sizes: Width and height of every training frame.
        generator: For its choices.

    Attributes:
        queue: Frames that it has planned for further steps; saved with a checkpoint and restored by assignment.
    """

    Settings: ClassVar[type[Settings]]
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
