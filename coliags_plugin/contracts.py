"""What each kind of component promises. Component packages implement these and never import one another."""

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
from torch import Tensor, nn
from typing_extensions import Self

from coliags_plugin.core.cameras import Camera
from coliags_plugin.core.gaussians import Gaussians
from coliags_plugin.core.progress import Progress
from coliags_plugin.core.render_output import RenderOutput
from coliags_plugin.core.scenes import Frame, Scene, Target, View
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

    @classmethod
    def recognise_unposed(cls, path: Path) -> bool:
        """Whether a folder is of this format but for its poses. Reads no pixels."""
        return False

    def without_poses(self) -> DataManager:
        """The data manager, with the same options, that puts every camera of such a folder at the origin.

        Itself where the options say where poses are.
        """
        return self

    @abstractmethod
    def load(self, path: Path, progress: Progress | None = None) -> Scene:
        """Read the scene.

        Args:
            path: Its folder (or file, where a data set is one).
            progress: Told ``(what, done, total)`` while pictures are read.

        Raises:
            InputError: The folder is missing or is not what this data manager reads.
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

    def events(self, after: int, until: int, every: int) -> range:
        """Steps of this run at which something happens that the config places between two of its steps.

        Args:
            after: Step of the config after which it happens.
            until: Step of the config before which it happens.
            every: Interval, in steps of this run: its multiples are the events.
        """
        return range((self.at(after) // every + 1) * every, self.at(until), every)


class Field(nn.Module, ABC):
    """What a scene looks like from anywhere. Either a :class:`GaussianField` or a :class:`RadianceField`."""

    Settings: ClassVar[type[Settings]]
    #: ``gaussians3d``, ``surfels`` or ``radiance``; renderers say which they draw.
    primitive: ClassVar[str]
    #: What strategies add and remove: ``anchors``, ``gaussians`` or, where the field has a fixed size, ``none``.
    elements: ClassVar[str] = "none"

    @property
    def element_count(self) -> int:
        """How many elements there are now; 0 where the field has a fixed size."""
        return 0

    @classmethod
    @abstractmethod
    def from_scene(cls, scene: Scene, settings: Any, generator: torch.Generator) -> Self:
        """A fresh field on the scene's initial points."""

    @classmethod
    @abstractmethod
    def from_state(cls, state: Mapping[str, Tensor], settings: Any) -> Self:
        """The field a checkpoint holds, however many elements it has grown to."""

    @abstractmethod
    def parameter_groups(self) -> dict[str, list[nn.Parameter]]:
        """Trainable parameters by the name that a method config's ``optimizers`` uses."""

    def before_step(self, step: int, schedule: Schedule) -> None:
        """Called before each training step, counted from 1, by fields that change over the run.

        What it changes must be among the buffers, so that a checkpoint renders as training left it.
        """


class GaussianField(Field):
    """:class:`Camera` -> :class:`Gaussians`, for splatting renderers."""

    @property
    def feature_channels(self) -> frozenset[str]:
        """Names of the feature channels its Gaussians carry; each can be asked for as an output."""
        return frozenset()

    @abstractmethod
    def gaussians(self, camera: Camera) -> Gaussians:
        """The Gaussians this camera sees, differentiable with respect to the field's parameters and the pose."""


@dataclass(frozen=True)
class RadianceSamples:
    """What a radiance field is at points along rays.

    Attributes:
        density: Not below 0, per scene unit. [P, S]
        rgb: In [0, 1]. [P, S, 3]
    """

    density: Float[Tensor, "P S"]
    rgb: Float[Tensor, "P S 3"]


class RadianceField(Field):
    """Points and directions -> density and colour, for renderers that sample along rays."""

    primitive: ClassVar[str] = "radiance"

    @abstractmethod
    def query(
        self, positions: Float[Tensor, "P S 3"], directions: Float[Tensor, "P 3"], camera: Camera
    ) -> RadianceSamples:
        """Density and colour at points along the rays of one camera.

        Args:
            positions: World frame, scene units. [P, S, 3]
            directions: Unit vectors from the camera. [P, 3]
            camera: Whose centre is the lamp's and whose axis the lamp's axis.
        """


class Head(nn.Module, ABC):
    """A part of a field that can be exchanged: parameters under group names of its own."""

    Settings: ClassVar[type[Settings]]

    @abstractmethod
    def parameter_groups(self) -> dict[str, list[nn.Parameter]]:
        """Trainable parameters by the name that ``optimizers`` uses."""


class GeometryHead(Head):
    """Anchor feature and viewing direction -> opacity, scale and rotation of every child.

    Made by ``Head(settings, features, children, generator)``.
    """

    @abstractmethod
    def forward(
        self, features: Float[Tensor, "V F"], directions: Float[Tensor, "V 3"]
    ) -> tuple[Float[Tensor, "V K"], Float[Tensor, "V K 7"]]:
        """Decode the children of the visible anchors.

        Args:
            features: Anchor features. [V, F]
            directions: Unit vectors from the camera to the anchors, world frame. [V, 3]

        Returns:
            Signed opacities in (-1, 1), of which only positive ones are drawn [V, K]; and three scale logits and four
            quaternion components (w first) per child [V, K, 7].
        """


class AppearanceHead(Head):
    """Anchor feature and viewing geometry -> colour of every child.

    Made by ``Head(settings, features, children, generator)``.
    """

    def expect(self, distances: Float[Tensor, "D"]) -> None:
        """Take note, before training, of the distances that occur.

        Args:
            distances: From cameras to anchors in their view, scene units. [D]
        """

    @abstractmethod
    def forward(
        self,
        features: Float[Tensor, "V F"],
        directions: Float[Tensor, "V 3"],
        distances: Float[Tensor, "V 1"],
        cosines: Float[Tensor, "V 1"],
    ) -> Float[Tensor, "V K 3"]:
        """Decode the children's colours.

        Args:
            features: Anchor features. [V, F]
            directions: Unit vectors from the camera (and lamp) to the anchors, world frame. [V, 3]
            distances: Camera to anchor, scene units (mm), not normalised. [V, 1]
            cosines: Of the angle between optical axis and direction, in [0, 1]. [V, 1]

        Returns:
            RGB in (0, 1). [V, K, 3]
        """


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
    #: Whether it can render some pixels of a view; splatting renderers draw whole images.
    renders_pixels: ClassVar[bool] = False

    def __init__(self, settings: Any) -> None:
        self.settings = settings

    @classmethod
    @abstractmethod
    def availability(cls) -> Availability:
        """Whether this machine can run it."""

    @abstractmethod
    def render(
        self,
        field: Any,
        camera: Camera,
        wants: Sequence[str] = ("rgb", "alpha"),
        pixels: Int[Tensor, "P 2"] | None = None,
    ) -> RenderOutput:
        """Render one view, or some of its pixels.

        Args:
            field: What to draw; its ``primitive`` must be one that this renderer serves.
            camera: Where from.
            wants: Names from :data:`coliags_plugin.core.render_output.OUTPUTS` or of the field's feature channels; rgb
                and alpha always come.
            pixels: Columns and rows of the only pixels to render, as an image of P rows and one column. [P, 2]

        Raises:
            InputError: The field, an output or ``pixels`` is not for this renderer.
        """


class ViewModule(nn.Module, ABC):
    """Adjusts the camera before, and shades the output after, a view is rendered; may learn something per frame."""

    Settings: ClassVar[type[Settings]]

    @property
    def wants(self) -> frozenset[str]:
        """Outputs beyond rgb and alpha that :meth:`shade` needs."""
        return frozenset()

    @property
    @abstractmethod
    def untrained_views(self) -> str:
        """One sentence for log and results: what it does for views that are not training frames."""

    @classmethod
    @abstractmethod
    def from_scene(cls, scene: Scene, settings: Any, generator: torch.Generator) -> Self:
        """A fresh module for the scene's training frames; a checkpoint's state is loaded into one.

        Raises:
            InputError: The settings name what the scene does not have.
        """

    @abstractmethod
    def parameter_groups(self) -> dict[str, list[nn.Parameter]]:
        """Trainable parameters; a method config's ``optimizers`` puts the module's own name and a dot in front."""

    def adjust_camera(self, camera: Camera, view: View | None) -> Camera:
        """The camera to render from, for instance with a corrected pose.

        Args:
            camera: Where the view is said to be taken from.
            view: Which frame it is; None for a free camera.
        """
        return camera

    def shade(self, output: RenderOutput, view: View | None) -> RenderOutput:
        """The output as the camera would have recorded it, for instance with its gain.

        Args:
            output: As rendered, or as the module before left it.
            view: See :meth:`adjust_camera`.
        """
        return output


@dataclass(frozen=True)
class TrainingStep:
    """What losses and strategies see of one training step.

    Attributes:
        output: What was rendered.
        target: What it is compared with.
        model: The field, and the modules by name.
        step: Counted from 1.
        schedule: Of the run.
    """

    output: RenderOutput
    target: Target
    model: TrainedModel
    step: int
    schedule: Schedule


class TrainedModel(TypingProtocol):
    """The model in training, as losses and strategies see it."""

    @property
    def field(self) -> Any:
        """The :class:`Field`."""

    @property
    def view_modules(self) -> Mapping[str, Any]:
        """View modules by their names in the method config."""


class ParameterRows(TypingProtocol):
    """Changes rows of a field's parameters together with their gradients and Adam's moments.

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
        """Keep only some rows.

        Args:
            groups: Names of the groups.
            keep: True for rows that stay. [M]
        """

    def reset_rows(self, group: str, rows: Bool[Tensor, "M"] | None = None) -> None:
        """Forget the moments of rows, of all of them where none are given. [M]"""

    def replace_values(self, group: str, values: Tensor) -> None:
        """Put other values in the place of a group's, and forget their moments. [M, ...]"""


class Strategy(ABC):
    """Grows, splits and prunes a field between optimiser steps. Owns its counters.

    Args:
        settings: Its options.
        generator: For whatever is left to chance.
        schedule: Of the run.
        extent: Of the scene (:attr:`Scene.extent`), scene units.
    """

    Settings: ClassVar[type[Settings]]
    #: Kinds of :attr:`Field.elements` that it can change; None where it changes nothing.
    serves: ClassVar[frozenset[str] | None]
    #: Attributes that are tensors of counters, saved with a checkpoint.
    counters: ClassVar[tuple[str, ...]] = ()

    def __init__(self, settings: Any, generator: torch.Generator, schedule: Schedule, extent: float) -> None:
        self.settings = settings
        self.generator = generator
        self.schedule = schedule
        self.extent = extent

    @abstractmethod
    def plan(self) -> str:
        """One sentence for the log at the start: the steps at which it grows or prunes, or why it will not."""

    def before_step(self, step: int, field: Any, rows: ParameterRows) -> None:  # noqa: B027 (optional)
        """Called before step ``step`` renders."""

    def after_backward(self, step: TrainingStep, rows: ParameterRows) -> dict[str, int]:
        """Called after ``backward`` and before the optimisers step.

        Returns:
            What was done, for the log (for instance ``{"grown": 12, "pruned": 3}``); empty when nothing was.
        """
        return {}

    def after_step(self, step: TrainingStep, rows: ParameterRows) -> dict[str, int]:
        """Called after the optimisers have stepped; returns like :meth:`after_backward`."""
        return {}

    def state_dict(self) -> dict[str, Tensor]:
        """Counters for the checkpoint."""
        return {name: getattr(self, name) for name in self.counters}

    def load_state_dict(self, state: Mapping[str, Tensor]) -> None:
        """Restore what :meth:`state_dict` gave."""
        for name in self.counters:
            setattr(self, name, state[name])


@dataclass(frozen=True)
class Draw:
    """What to render in a training step: a frame, or some of its pixels.

    Attributes:
        frame: Number of the training frame.
        pixels: Columns and rows; None for the whole frame. [P, 2]
    """

    frame: int
    pixels: Int[Tensor, "P 2"] | None = None


class Sampler(ABC):
    """Chooses what each training step looks at.

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

    def __init__(self, settings: Any, sizes: Sequence[tuple[int, int]], generator: torch.Generator) -> None:
        self.settings = settings
        self.sizes = sizes
        self.generator = generator
        self.queue: list[int] = []

    @abstractmethod
    def next(self) -> list[Draw]:
        """What the next step renders, at least one."""


class Loss(ABC):
    """One scalar term. Its weight and schedule are settings, applied by the engine."""

    Settings: ClassVar[type[LossSettings]]
    #: What at least one training frame must have: names of attributes of :class:`Target` (``depth``, ``sparse_depth``).
    needs: ClassVar[frozenset[str]] = frozenset()
    #: Whether neighbouring pixels enter, so that batches of single pixels will not do.
    whole_image: ClassVar[bool] = False
    #: Whether it reads ``output.splats``, which only splatting renderers deliver.
    needs_splats: ClassVar[bool] = False

    def __init__(self, settings: Any) -> None:
        self.settings = settings

    @property
    def wants(self) -> frozenset[str]:
        """Outputs beyond rgb and alpha that the renderer must deliver."""
        return frozenset()

    @abstractmethod
    def __call__(self, step: TrainingStep) -> Float[Tensor, ""]:
        """The unweighted term. Pixels whose ``step.target.mask`` is False count for nothing."""


class LossSettings(Settings):
    """Weight of a term: constant, or log-linear from ``weight`` to ``final_weight``, both above 0, over the run.

    It falls no further than to ``min_weight``. The term counts from step ``from_step`` to step ``until_step``, both of
    which keep their share of a run of another length.
    """

    weight: float
    final_weight: float | None = None
    min_weight: float = Option(default=0.0, ge=0.0)
    from_step: int = Option(default=0, ge=0)
    until_step: int | None = Option(default=None, ge=1)

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
