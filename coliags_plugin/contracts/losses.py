"""Base class of losses, and the settings of their weights."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import ClassVar, Generic

from jaxtyping import Float
from pydantic import Field as Option
from pydantic import model_validator
from torch import Tensor
from typing_extensions import Self, TypeVar

from coliags_plugin.contracts.schedule import Schedule, log_linear
from coliags_plugin.contracts.training import TrainedModel, TrainingStep
from coliags_plugin.core.settings import Settings, refuse_zero_ends


class LossSettings(Settings):
    """Weight of a loss term over the run, and the steps at which it is active.

    ``weight`` and ``final_weight`` are above 0; step numbers keep their share of a run of another length.
    """

    weight: float  # factor of the term, at the start where final_weight is set
    final_weight: float | None = None  # factor at the last step, approached log-linearly; null: constant weight
    min_weight: float = Option(default=0.0, ge=0.0)  # lower bound of the decaying weight
    from_step: int = Option(default=0, ge=0)  # the term is active after this step
    until_step: int | None = Option(default=None, ge=1)  # and up to this one; null: to the end

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
        """Whether the term counts at a step, counted from 1."""
        return step > schedule.at(self.from_step) and (self.until_step is None or step <= schedule.at(self.until_step))

    def weight_at(self, step: int, steps: int) -> float:
        """The weight at step ``step`` (from 1) of ``steps``."""
        if self.final_weight is None:
            return self.weight
        return max(self.min_weight, log_linear(self.weight, self.final_weight, step / steps))


#: Settings of a loss.
LossSettingsT = TypeVar("LossSettingsT", bound=LossSettings, default=LossSettings)


class Loss(ABC, Generic[LossSettingsT]):
    """One scalar term of the loss; its weight and schedule are settings, applied by the engine."""

    Settings: ClassVar[type[LossSettings]] = LossSettings
    #: Attributes of :class:`Target` that at least one training frame must have (``depth``, ``sparse_depth``).
    needs: ClassVar[frozenset[str]] = frozenset()
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
