"""Controls that set a camera path, in viser's panel."""

from __future__ import annotations

import shlex
from collections.abc import Callable
from pathlib import Path
from typing import Any

from coliags_plugin.core.cameras import Camera
from coliags_plugin.core.errors import InputError
from coliags_plugin.engine.camera_path import CameraPath, Keyframe

#: In the run folder.
PATH_FILE = "camera-path.json"


class KeyframeControls:
    """Buttons that add the browser's camera as a keyframe, remove the last one, and save the path in the run folder."""

    def __init__(self, gui: Any, run: Path, camera: Callable[[], Camera]) -> None:
        self._run, self._camera = run, camera
        self._keyframes: list[Keyframe] = []
        gui.add_button("Add keyframe").on_click(lambda _: self.add())
        gui.add_button("Remove the last").on_click(lambda _: self.remove())
        self._seconds = gui.add_slider("Seconds between", 0.5, 10.0, 0.5, 2.0)
        gui.add_button("Save").on_click(lambda _: self.save())
        self._said = gui.add_markdown("No keyframes yet.")

    def add(self) -> None:
        """Add the browser's camera."""
        self._keyframes.append(Keyframe.of(self._camera()))
        self._tell()

    def remove(self) -> None:
        """Remove the keyframe that was added last."""
        del self._keyframes[-1:]
        self._tell()

    def save(self) -> None:
        """Write the path beside what else the run has; an earlier one is replaced."""
        file = self._run / PATH_FILE
        if len(self._keyframes) < 2:
            self._said.content = "A path needs two keyframes or more."
            return
        try:
            CameraPath(keyframes=tuple(self._keyframes), seconds=float(self._seconds.value)).write(file)
        except InputError as error:
            self._said.content = str(error)
            return
        self._said.content = (
            f"Saved. Its video: `{shlex.join(['coliags', 'render', str(self._run), '--path', str(file)])}`"
        )

    @property
    def said(self) -> str:
        """The line below the buttons."""
        return str(self._said.content)

    def _tell(self) -> None:
        self._said.content = f"Keyframes: {len(self._keyframes)}, not saved."
