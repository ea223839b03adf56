"""``datamanager: auto``: whichever format the scene's folder has."""

from __future__ import annotations

from typing import ClassVar

from coliags_plugin.core.settings import Settings
from coliags_plugin.datamanagers.scene_settings import SceneSettings


class AutoDataManager:
    """Stands for the one data manager that recognises the folder; the engine finds it (docs/data.md 1)."""

    Settings: ClassVar[type[Settings]] = SceneSettings
