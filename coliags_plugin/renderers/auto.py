"""``renderer: auto``: the quickest renderer that this machine has."""

from __future__ import annotations

from typing import ClassVar

from pydantic import Field

from coliags_plugin.core.settings import Settings


class AutoSettings(Settings):
    """Preferences, and the options every splatting renderer shares."""

    prefer: tuple[str, ...] = ("gsplat", "cpu", "torch")
    near_plane: float = Field(default=0.2, ge=0)  # scene units
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)


class AutoRenderer:
    """Stands for the first of its preferences that can serve; the engine chooses and records why."""

    Settings: ClassVar[type[Settings]] = AutoSettings
