"""Base class of data managers."""

from __future__ import annotations

from abc import ABC, abstractmethod
from pathlib import Path

from coliags_plugin.core.jobs import Progress
from coliags_plugin.core.scenes import Scene
from coliags_plugin.core.settings import Configurable, SettingsT


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
