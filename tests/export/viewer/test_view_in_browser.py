"""The view and the saved page in a headless Chromium that draws WebGL in software."""

from __future__ import annotations

import time

import numpy as np
import pytest

from coliags_plugin.core.images import read_rgb

pytest.importorskip("viser")

pytestmark = pytest.mark.thorough

WIDTH, HEIGHT = 900, 420
#: Where neither the panel nor a notice is, px.
FREE = (slice(220, 400), slice(20, 460))


def until(browser, file, condition, seconds=90.0):
    """The free part of the first screenshot that meets a condition."""
    ends = time.monotonic() + seconds
    while True:
        browser.screenshot(file)
        pixels = read_rgb(file)[FREE].astype(float)
        if condition(pixels):
            return pixels
        assert time.monotonic() < ends, f"still mean {pixels.mean((0, 1))}, spread {pixels.std((0, 1))}"
        time.sleep(0.5)


def drawn(pixels):
    """Neither black nor white: Gaussians over the background."""
    return pixels.std() > 3.0 and 20.0 < pixels.mean() < 235.0


def elsewhere(browser, page):
    return [url for url in browser.requests() if not url.startswith((page, "blob:"))]


def test_the_run_is_seen_from_the_first_frame_on_and_the_slider_moves_the_view(browser, anchors, tmp_path):
    with anchors.view(port=0) as viewer:
        browser.open(viewer.url, WIDTH, HEIGHT)
        until(browser, tmp_path / "first.png", drawn)
        expected = viewer.picture(viewer.sessions[0].camera(), "colour")[FREE]
        until(browser, tmp_path / "first.png", lambda pixels: np.abs(pixels - expected).mean() < 4.0)
        (session,) = viewer.sessions
        before = np.array(session._client.camera.position)
        browser.run("document.querySelector('[role=slider][aria-valuemax=\"8\"]').focus()")
        browser.key("End", 35)
        ends = time.monotonic() + 60.0
        last = viewer.trained.scene.video[-1].camera.center.numpy()
        while np.abs(session._client.camera.position - last).max() > 1e-3:
            assert time.monotonic() < ends
            time.sleep(0.2)
        assert session.frame.value == len(viewer.trained.scene.video) - 1
        assert not np.allclose(before, last)
        assert elsewhere(browser, viewer.url) == []
