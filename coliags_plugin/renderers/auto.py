"""``renderer: auto``: automatic choice of the fastest renderer available."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

from torch import Tensor

from coliags_plugin.contracts import Availability, Renderer
from coliags_plugin.core.cameras import Camera
from coliags_plugin.core.render_output import RenderOutput
from coliags_plugin.core.settings import Settings
from coliags_plugin.renderers.choice import choose_among
from coliags_plugin.renderers.splatting import SplattingRenderer


class AutoSettings(Settings):
    """Order of preference, and options common to all splatting renderers."""

    prefer: tuple[str, ...] = ("gsplat", "cpu", "torch")
    """Names of renderers, the most preferred first."""
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Background RGB."""


class AutoRenderer(Renderer):
    """First renderer of ``prefer`` that can render the field; a run records which it is and why."""

    Settings: ClassVar[type[Settings]] = AutoSettings
    primitives = frozenset({"gaussians3d", "surfels"})
    outputs = SplattingRenderer.outputs
    devices = frozenset({"cpu", "cuda"})

    @classmethod
    def outputs_of(cls, primitive: str) -> frozenset[str]:
        """Those of the splatting renderers."""
        return SplattingRenderer.outputs_of(primitive)

    @classmethod
    def availability(cls) -> Availability:
        """Always: whether one of the preferred renderers can run depends on field and device."""
        return Availability(True, "chooses among the other renderers")

    @classmethod
    def alternatives(cls, settings: Any) -> Sequence[Mapping[str, Any]]:
        """The preferred renderers with the common options."""
        common = settings.model_dump(exclude={"prefer"})
        return [{"name": name, **common} for name in settings.prefer]

    def render(
        self, field: Any, camera: Camera, wants: Sequence[str] = ("rgb", "alpha"), pixels: Tensor | None = None
    ) -> RenderOutput:
        """Render with the first alternative that can."""
        chosen = choose_among("auto", self.alternatives(self.settings), field.primitive, camera.camera_to_world.device)
        return chosen.renderer.render(field, camera, wants, pixels)
