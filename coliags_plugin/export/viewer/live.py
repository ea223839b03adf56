"""A run in browsers while it is trained."""

from __future__ import annotations

import time

from coliags_plugin.contracts import Follower
from coliags_plugin.engine.data_formats import recorded_scale
from coliags_plugin.engine.trained import TrainedRun
from coliags_plugin.engine.trainer import Trainer
from coliags_plugin.export.viewer.content import ViewerContent
from coliags_plugin.export.viewer.serving import Viewer
from coliags_plugin.export.viewer.session import EVERY

#: Share of the time that drawing may take from training.
_SHARE = 0.2


class LiveView(Follower):
    """Shows a run to browsers while it is trained, as it is after the newest step.

    What browsers see is computed between steps, by the thread that trains: nothing changes meanwhile, and the run is
    the same to the bit.
    """

    def __init__(self, trainer: Trainer, port: int = 8080) -> None:
        method, provenance = trainer.method, trainer.provenance()
        scale = recorded_scale(trainer.scene.provenance)
        scene, model = trainer.scene.scaled(1.0 / scale), trainer.model.with_field(trainer.model.field, scale)
        trained = TrainedRun(
            trainer.run, method.config, method.name, scene, model, trainer.step, trainer.device,
            trainer.seed, provenance,
        )  # fmt: skip
        self._viewer = Viewer(trained, port=port, content=ViewerContent.live(trained))
        self._due = 0.0

    @property
    def viewer(self) -> Viewer:
        """What serves the view."""
        return self._viewer

    def stepped(self, step: int) -> None:
        """Bring browsers up to date, where it is time to."""
        began = time.monotonic()
        if began < self._due:
            return
        for session in self._viewer.sessions:
            session.model_changed(step)
            while session.update() == 0.0:
                pass
        now = time.monotonic()
        self._due = now + max(EVERY, (now - began) * (1.0 / _SHARE - 1.0))

    def close(self) -> None:
        """Stop serving."""
        self._viewer.close()
