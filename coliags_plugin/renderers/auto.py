"""``renderer: auto``: automatic choice of the fastest renderer available."""

from __future__ import annotations

from typing import ClassVar

from pydantic import Field

from coliags_plugin.core.settings import Settings


class AutoSettings(Settings):
    """Order of preference, and options common to all splatting renderers."""

    prefer: tuple[str, ...] = ("gsplat", "cpu", "torch")
    near_plane: float = Field(default=0.2, ge=0)  # scene units
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)


class AutoRenderer:
    """Placeholder that the engine replaces by the first renderer of ``prefer`` that can run, recording the reason."""

    Settings: ClassVar[type[Settings]] = AutoSettings
