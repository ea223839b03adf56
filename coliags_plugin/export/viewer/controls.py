"""Controls of the browser view, in viser's panel."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from jaxtyping import Float

from coliags_plugin.core.cameras import Camera
from coliags_plugin.export.viewer.content import Picture, ViewerContent, mesh_files
from coliags_plugin.export.viewer.keyframes import KeyframeControls
from coliags_plugin.export.viewer.layers import add_cameras, add_mesh
from coliags_plugin.geometry.meshes.files import read_mesh
from coliags_plugin.outputs.image_files import as_array

#: Where the light comes from.
AT_CAMERA, FLATTENED = "follows the camera", "flattened"
#: Largest value of the opacity threshold.
_LARGEST_THRESHOLD = 0.9
#: Frusta within so many of their sizes of the browser's camera are hidden.
_HIDING_SIZES = 3.0


class Controls:
    """Slider through the video, light, threshold, layers and pictures, in viser's panel of one browser.

    ``changed`` is told of another light, threshold or kind of picture, ``go_to`` of another frame; ``camera`` is the
    browser's.
    """

    def __init__(
        self,
        client: Any,
        content: ViewerContent,
        changed: Callable[[], None],
        go_to: Callable[[int], None],
        camera: Callable[[], Camera],
    ) -> None:
        self._content = content
        self._client = client
        self._go_to = go_to
        self._layers: dict[str, list[Any]] = {}
        gui = client.gui
        self._about = gui.add_markdown("")
        self.step = content.trained.step
        self._frame = gui.add_slider("Frame", 0, max(1, len(content.frames) - 1), 1, 0)
        self._frame.on_update(lambda _: self._frame_chosen())
        self._about_frame = gui.add_markdown(self._frame_text())
        self._light = self._threshold = None
        if content.knows_lamp:
            self._light = gui.add_dropdown("Light", (AT_CAMERA, FLATTENED))
            self._light.on_update(lambda _: changed())
        if content.decoder is not None:
            self._threshold = gui.add_slider("Least opacity", 0.0, _LARGEST_THRESHOLD, 0.01, 0.0)
            self._threshold.on_update(lambda _: changed())
        with gui.add_folder("Layers"):
            self._add_layers(gui)
        with gui.add_folder("Pictures of the frame"):
            self._recorded = gui.add_image(as_array(content.frames[0].image), label="recorded")
            self._picture = gui.add_dropdown("Beside it", content.pictures.kinds)
            self._picture.on_update(lambda _: changed())
            self._rendered = gui.add_image(as_array(content.frames[0].image) // 4, label="is being rendered")
        with gui.add_folder("Camera path"):
            self.keyframes = KeyframeControls(gui, content.trained.run.path, camera)
        self._status = gui.add_markdown("")

    @property
    def step(self) -> int:
        """The training step that is shown."""
        return self._step

    @step.setter
    def step(self, step: int) -> None:
        self._step = step
        scene, count = self._content.trained.scene, len(self._content.frames)
        self._about.content = (
            f"**{self._content.title}**, step {step}; {count} frames, {count - len(scene.train)} held out; "
            f"lengths in {scene.length_unit}"
        )

    @property
    def frame(self) -> int:
        """Index of the chosen frame in the video."""
        return min(int(self._frame.value), len(self._content.frames) - 1)

    @property
    def picture(self) -> str:
        """Kind of picture beside the recorded one."""
        return str(self._picture.value)

    @property
    def light(self) -> str:
        """Where the light comes from."""
        return AT_CAMERA if self._light is None else str(self._light.value)

    @property
    def least_opacity(self) -> float:
        """Opacity below which Gaussians are not drawn."""
        return 0.0 if self._threshold is None else float(self._threshold.value)

    @property
    def status(self) -> str:
        """Line at the bottom."""
        return str(self._status.content)

    @status.setter
    def status(self, text: str) -> None:
        self._status.content = text

    def show_picture(self, picture: Picture) -> None:
        """Show a picture beside the recorded one."""
        self._rendered.image = picture.image
        self._rendered.label = picture.caption

    def choose(self, index: int) -> None:
        """Choose a frame of the video by its index, as the slider does."""
        self._frame.value = index
        self._frame_chosen()

    def _frame_chosen(self) -> None:
        self._about_frame.content = self._frame_text()
        self._recorded.image = as_array(self._content.frames[self.frame].image)
        self._go_to(self.frame)

    def _frame_text(self) -> str:
        frame = self._content.frames[self.frame]
        kind = "training" if frame.name in self._content.trained.training_frames else "held out"
        return f"`{frame.name}`, {kind}"

    def _add_layers(self, gui: Any) -> None:
        if self._content.decoder is not None:
            splats = gui.add_checkbox("Gaussians", True)
            splats.on_update(lambda _: self._show_splats(splats.value))
        self._cameras = gui.add_checkbox("Cameras", False)
        self._cameras.on_update(lambda _: self._show("cameras", self._cameras.value))
        for name in mesh_files(self._content.trained.run.path):
            box = gui.add_checkbox(name.capitalize(), False)
            box.on_update(lambda _, name=name, box=box: self._show(name, box.value))

    def _show_splats(self, visible: bool) -> None:
        node = self._client.scene.get_handle_by_name("/splats")
        if node is not None:
            node.visible = visible

    def _show(self, layer: str, visible: bool) -> None:
        """Show or hide a layer; it is sent when it is first shown."""
        if layer not in self._layers:
            self._layers[layer] = self._made(layer)
        for handle in self._layers[layer]:
            handle.visible = visible
        self.camera_rests(self._client.camera.position)

    def camera_rests(self, position: Float[np.ndarray, "3"]) -> None:
        """Hide the frusta that the browser's camera, at this place, is in or behind: their pictures fill the view."""
        for handle in self._layers.get("cameras", ()):
            near = np.linalg.norm(np.asarray(handle.position) - position) < _HIDING_SIZES * handle.scale
            handle.visible = self._cameras.value and not near

    def _made(self, layer: str) -> list[Any]:
        if layer == "cameras":
            return add_cameras(self._client.scene, self._content, self.choose)
        mesh = read_mesh(mesh_files(self._content.trained.run.path)[layer])
        return [add_mesh(self._client.scene, layer, mesh)]
