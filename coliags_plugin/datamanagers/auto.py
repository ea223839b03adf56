"""``datamanager: auto``: selects the format from the scene's folder."""

from __future__ import annotations

from typing import ClassVar

from coliags_plugin.core.settings import Settings
from coliags_plugin.datamanagers.scene_settings import SceneSettings


class AutoDataManager:
    """Placeholder that the engine replaces by the data manager that recognises the folder (docs/data.md 1)."""

    Settings: ClassVar[type[Settings]] = SceneSettings
