"""``datamanager: auto``: selects the format from the scene's folder."""

from __future__ import annotations

from pathlib import Path
from typing import ClassVar

from coliags_plugin.config.components import make_component
from coliags_plugin.contracts import DataManager
from coliags_plugin.core.progress import Progress
from coliags_plugin.core.scenes import Scene
from coliags_plugin.core.settings import Settings
from coliags_plugin.datamanagers.recognition import find_format
from coliags_plugin.datamanagers.scene_settings import SceneSettings


class AutoDataManager(DataManager):
    """Reader of any scene, by the one data manager that recognises its folder (docs/data.md 1)."""

    Settings: ClassVar[type[Settings]] = SceneSettings
    has_format: ClassVar[bool] = False

    def load(self, path: Path, progress: Progress | None = None) -> Scene:
        """Read the scene with the data manager of its format and the options that were set.

        Raises:
            InputError: No format, or several, recognise the folder; or it cannot be read.
        """
        return self._manager(path).load(path, progress)

    def fingerprint(self, path: Path) -> str:
        """See :meth:`DataManager.fingerprint`."""
        return self._manager(path).fingerprint(path)

    def _manager(self, path: Path) -> DataManager:
        given = self.settings.model_dump(include=self.settings.model_fields_set)
        component = make_component("datamanagers", {**given, "name": find_format(path)})
        manager: DataManager = component.target(component.settings)
        return manager
