"""Base classes of renderers and per-view modules."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Generic

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from typing_extensions import TypeVar

from coliags_plugin.contracts.fields import Field
from coliags_plugin.core.cameras import Camera
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.json_files import JsonObject
from coliags_plugin.core.render_output import RenderOutput
from coliags_plugin.core.scenes import Scene, View
from coliags_plugin.core.settings import Configurable, SettingsT

#: Field that a renderer draws.
RenderedT = TypeVar("RenderedT", bound=Field, default=Any)


@dataclass(frozen=True)
class Availability:
    """Answer to the question if a renderer can run here, with the reason."""

    ok: bool
    reason: str


class Renderer(ABC, Configurable[SettingsT], Generic[SettingsT, RenderedT]):
    """Field + Camera -> RenderOutput, with declared primitives, outputs and devices that the engine checks."""

    primitives: ClassVar[frozenset[str]]
    #: Outputs of any primitive; :meth:`outputs_of` says which of one.
    outputs: ClassVar[frozenset[str]]
    #: torch device types
    devices: ClassVar[frozenset[str]]
    #: Whether it can render some pixels of a view; splatting renderers draw whole images.
    renders_pixels: ClassVar[bool] = False
    #: Name in messages.
    name: ClassVar[str]

    def __init__(self, settings: SettingsT) -> None:
        self.settings = settings

    def check_primitive(self, field: Field) -> None:
        """Refuse a field that this renderer cannot draw (InputError)."""
        if field.primitive not in self.primitives:
            raise InputError(
                f"a field of '{field.primitive}' for the {self.name} renderer",
                f"one of {', '.join(sorted(self.primitives))}",
                "Choose another renderer or another field",
            )

    @classmethod
    @abstractmethod
    def availability(cls) -> Availability:
        """Check if this machine can run it."""

    @classmethod
    def outputs_of(cls, primitive: str) -> frozenset[str]:
        """Outputs of a field of a primitive, its own feature channels not counted."""
        return cls.outputs

    @classmethod
    def obstacle(cls, primitive: str, device: torch.device) -> str:
        """Reason why it cannot render a field on its device, to follow its name in a message; empty without one."""
        if primitive not in cls.primitives:
            return f"draws {', '.join(sorted(cls.primitives))}, the field is made of {primitive}"
        if device.type not in cls.devices:
            return f"runs on {', '.join(sorted(cls.devices))}, the device is {device.type}"
        # Last, because finding out may compile something.
        available = cls.availability()
        return "" if available.ok else f"cannot run here: {available.reason}"

    @abstractmethod
    def render(
        self,
        field: RenderedT,
        camera: Camera,
        wants: Sequence[str] = ("rgb", "alpha"),
        pixels: Int[Tensor, "P 2"] | None = None,
        generator: torch.Generator | None = None,
    ) -> RenderOutput:
        """Render one view, or some of its pixels.

        Args:
            field: Field to render, of one of the renderer's ``primitives``.
            camera: Viewpoint.
            wants: Names from :data:`coliags_plugin.core.render_output.OUTPUTS` or of the field's feature channels; rgb
                and alpha always come.
            pixels: Columns and rows of the only pixels to render, as an image of P rows and one column. [P, 2]
            generator: In a training step, of random samples where there are any; None renders without chance.

        Raises:
            InputError: The field, an output or ``pixels`` is not for this renderer.
        """

    def check_field(self, field: RenderedT, near_plane: float) -> None:
        """Check, before training, that the renderer's options fit a field and the near plane of its cameras.

        Args:
            field: See :meth:`render`.
            near_plane: z-depth, scene units.

        Raises:
            InputError: They do not.
        """


class ViewModule(nn.Module, ABC, Configurable[SettingsT]):
    """Per-view module: adjusts the camera before and the output after rendering; may learn parameters per frame.

    Args:
        settings: Its options.
        scene: Whose training frames it is for; the state of a checkpoint can be loaded into a new module.
    """

    #: Whether :meth:`shade` depends on where in the image a pixel lies: ``output`` may be some pixels of a view, as an
    #: image of P rows and one column, unless this refuses samplers of pixels.
    whole_image: ClassVar[bool] = False

    def __init__(self, settings: SettingsT, scene: Scene) -> None:
        super().__init__()
        self.settings = settings

    @property
    def wants(self) -> frozenset[str]:
        """Outputs beyond rgb and alpha that :meth:`shade` needs."""
        return frozenset()

    @property
    @abstractmethod
    def untrained_views(self) -> str:
        """Sentence for log and results on how views other than training frames are treated."""

    def prepare(self, scene: Scene) -> None:
        """Adapt the initial parameters to the scene, before training; not called when a run is loaded."""

    @abstractmethod
    def parameter_groups(self) -> dict[str, list[nn.Parameter]]:
        """Trainable parameters; a method config's ``optimizers`` puts the module's own name and a dot in front."""

    @property
    def learned(self) -> JsonObject:
        """Learned numbers that have a meaning of their own, for the record of a run; default: none."""
        return {}

    @property
    def gain_curve(self) -> tuple[Sequence[float], Float[Tensor, "F C"]] | None:
        """Exposure gain over the video, for losses; default: None, without one.

        Index in the video of every training frame, ascending, and the learned part of the logarithm of its gain, for
        all colours or for each of three. [F], [F, C]
        """
        return None

    def adjust_camera(self, camera: Camera, view: View | None) -> Camera:
        """The camera to render from, for instance with a corrected pose.

        Args:
            camera: The view's camera, as in the scene.
            view: Which frame it is; None for a free camera.
        """
        return camera

    def shade(self, output: RenderOutput, view: View | None) -> RenderOutput:
        """The output as the camera would have recorded it, for instance with its gain; changes nothing in the module.

        Args:
            output: Rendered, and shaded by the modules before this one: a view or, unless :attr:`whole_image`, some of
                its pixels.
            view: See :meth:`adjust_camera`.
        """
        return output

    def after_step(self, view: View, output: RenderOutput) -> None:
        """Called after a training step, for every view drawn in it, by modules that learn otherwise than by gradients.

        What it changes must be a buffer, so that checkpoints restore it.

        Args:
            view: The training frame.
            output: What :meth:`shade` was given in the step.
        """
