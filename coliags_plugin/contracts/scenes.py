"""Base classes of data managers, and of metrics and protocols, which compare renderings with the frames of scenes."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

from jaxtyping import Bool, Float
from torch import Tensor

from coliags_plugin.core.jobs import Progress
from coliags_plugin.core.render_output import RenderOutput
from coliags_plugin.core.scenes import Frame, Scene
from coliags_plugin.core.settings import Configurable, Settings, SettingsT


class DataManager(ABC, Configurable[SettingsT]):
    """Reader of one dataset format: a folder on disk -> :class:`Scene`. Never writes into the dataset."""

    def __init__(self, settings: SettingsT) -> None:
        self.settings = settings

    @classmethod
    def recognise(cls, path: Path) -> str | None:
        """Evidence in the folder that it has this format; None without. Reads no pixels."""
        return None

    @classmethod
    def refuse_nearly(cls, path: Path) -> None:
        """Raise InputError, saying what is wrong, if a folder that no format recognises nearly has this one."""

    def at_stored_size(self) -> DataManager:
        """The data manager, with the same options, that reads images at their stored size, each when it is used.

        It makes no initial points. Itself where there is no such choice.
        """
        return self

    @abstractmethod
    def load(self, path: Path, progress: Progress | None = None) -> Scene:
        """Read the scene.

        Args:
            path: Its folder (or file, where a data set is one).
            progress: Called with ``(what, done, total)`` while images are read.

        Raises:
            InputError: The folder is missing or does not have this format.
        """

    def fingerprint(self, path: Path) -> str:
        """Hash of a scene's files, as in the provenance of :meth:`load`; faster where pixels need not be read."""
        return self.load(path).provenance.fingerprint


@dataclass(frozen=True)
class Comparison:
    """A rendered view and its ground truth, prepared by a protocol for metrics.

    Attributes:
        rgb: Rendered, in [0, 1]. [H, W, 3]
        true_rgb: [H, W, 3]
        valid: Pixels that count for image metrics. [H, W]
        depth: Rendered z-depth of the protocol's kind, mm; None where the frame has no true depth. [H, W]
        true_depth: mm. [H, W]
        depth_valid: Pixels that count for depth metrics. [H, W]
        estimated: Whether the frame has depth, which is no truth, having been estimated.
        point_depth: Rendered z-depth at those points of known depth that can be compared, scene units; None where the
            frame has no points. [K]
        true_point_depth: Known z-depth there, scene units. [K]
    """

    rgb: Float[Tensor, "H W 3"]
    true_rgb: Float[Tensor, "H W 3"]
    valid: Bool[Tensor, "H W"]
    depth: Float[Tensor, "H W"] | None = None
    true_depth: Float[Tensor, "H W"] | None = None
    depth_valid: Bool[Tensor, "H W"] | None = None
    estimated: bool = False
    point_depth: Float[Tensor, "K"] | None = None
    true_point_depth: Float[Tensor, "K"] | None = None


class Metric(ABC, Configurable[SettingsT]):
    """One number from a :class:`Comparison`."""

    Settings: ClassVar[type[Settings]] = Settings
    higher_is_better: ClassVar[bool]
    unit: ClassVar[str]

    def __init__(self, settings: SettingsT) -> None:
        self.settings = settings

    @abstractmethod
    def __call__(self, comparison: Comparison) -> float:
        """The metric of one frame.

        Raises:
            UnavailableError: It is not available; the message says why.
        """


class Protocol(ABC):
    """Evaluation protocol: the depth kind, masks, quantization and metric variants that are compared."""

    name: ClassVar[str]
    #: Incremented whenever a metric that it yields could change.
    version: ClassVar[int]
    description: ClassVar[str]
    #: Renderer outputs it needs beyond rgb and alpha.
    wants: ClassVar[frozenset[str]]
    #: Result name -> (metric name, metric options)
    metrics: ClassVar[Mapping[str, tuple[str, Mapping[str, Any]]]]
    #: Likewise, of metrics that a result has only if a frame has them.
    optional_metrics: ClassVar[Mapping[str, tuple[str, Mapping[str, Any]]]] = {}

    @abstractmethod
    def compare(self, output: RenderOutput, frame: Frame) -> Comparison:
        """Prepare a rendered view and its frame for the metrics."""
