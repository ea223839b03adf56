"""A run in a browser while it is trained: what the newest step has, and a run that is the same to the bit."""

from __future__ import annotations

import json

import numpy as np
import pytest
import torch

from coliags_plugin.core.errors import InputError
from coliags_plugin.engine.camera_path import CameraPath
from coliags_plugin.export.viewer.splats import shown, widened
from tests.engine.test_trainer import EARLY_GROWTH, assert_same, final_state, make_trainer

pytest.importorskip("viser")

from coliags_plugin.export.viewer import live
from tests.export.viewer.test_serving import newest, session_camera
from tests.export.viewer.viser_client import ViserClient

pytestmark = pytest.mark.filterwarnings("ignore:Queued a .* on a closed connection")


@pytest.fixture
def eager(monkeypatch):
    """Every step is shown."""
    monkeypatch.setattr(live, "EVERY", 0.0)
    monkeypatch.setattr(live, "_SHARE", 1.0)
    monkeypatch.setattr("coliags_plugin.export.viewer.session.EVERY", 0.0)


def session_of(view):
    """The session of the one browser, once it is there."""
    while not view.viewer.sessions:
        pass
    return view.viewer.sessions[0]


def test_a_browser_sees_what_the_newest_step_has(tmp_path, eager):
    trainer = make_trainer(tmp_path / "run", steps=4)
    trainer.start()
    view = live.LiveView(trainer, port=0)
    camera = trainer.scene.train[0].camera
    with ViserClient(view.viewer.port) as client:
        client.look(camera)
        session_of(view)
        for step in (1, 2):
            trainer.take_step()
            view.stepped(step)
            if step == 1:
                client.wait_for("GaussianSplatsMessage")
        seen = newest(client)
        with torch.no_grad():
            expected = shown(trainer.model.field.gaussians(widened(session_camera(camera))))
        np.testing.assert_allclose(seen["centers"] * view.viewer.content.unit, expected.means, atol=1e-4)
        assert "step 2" in session_of(view).controls._about.content
    view.close()


def test_a_run_that_is_looked_at_is_the_same_run(tmp_path, eager):
    options = {"steps": 10, "overrides": EARLY_GROWTH}
    alone, watched = make_trainer(tmp_path / "a", **options), make_trainer(tmp_path / "b", **options)
    alone.start()
    alone.train()
    watched.start()
    view = live.LiveView(watched, port=0)
    with ViserClient(view.viewer.port) as client:
        client.look(watched.scene.train[1].camera)
        session_of(view)
        watched.train(followers=[view])
        assert newest(client)["centers"].size
    assert_same(final_state(alone), final_state(watched))


def test_drawing_takes_a_share_of_the_time(tmp_path, monkeypatch):
    trainer = make_trainer(tmp_path / "run")
    trainer.start()
    view, now, updates = live.LiveView(trainer, port=0), [0.0], []

    class Slow:
        def model_changed(self, step):
            updates.append(step)
            now[0] += 2.0

        def update(self):
            return None

    monkeypatch.setattr(live.time, "monotonic", lambda: now[0])
    monkeypatch.setattr(type(view.viewer), "sessions", [Slow()])
    for step in range(1, 31):
        now[0] += 1.0
        view.stepped(step)
    monkeypatch.undo()
    view.close()
    assert updates == [1, 9, 17, 25]  # 2 s of drawing, then 8 s of training


def test_a_path_that_is_set_in_the_view(anchors, tmp_path):
    with anchors.view(port=0) as viewer, ViserClient(viewer.port) as client:
        camera = viewer.content.trained.scene.train[0].camera
        client.look(camera)
        while not viewer.sessions:
            pass
        controls = viewer.sessions[0].controls.keyframes
        client.wait_for("GaussianSplatsMessage")
        newest(client)
        controls.add()
        controls.save()
        assert controls.said == "A path needs two keyframes or more."
        controls.add()
        controls.add()
        controls.remove()
        controls.save()
        file = anchors.path / "camera-path.json"
        assert controls.said == f"Saved. Its video: `coliags render {anchors.path} --path {file}`"
    path = CameraPath.read(file)
    assert len(path.keyframes) == 2 and json.loads(file.read_text())["seconds"] == 2.0
    np.testing.assert_allclose(path.keyframes[0].camera_to_world, camera.camera_to_world, atol=1e-6)
    file.unlink()


def test_a_port_that_is_taken_is_told_before_anything_is_written(anchors, wall, tmp_path):
    import coliags_plugin as cp

    with anchors.view(port=0) as viewer, pytest.raises(InputError, match=r"--port \d+ is in use"):
        cp.train("coliags", wall, tmp_path / "run", steps=1, view_port=viewer.port)
    assert not (tmp_path / "run").exists()
