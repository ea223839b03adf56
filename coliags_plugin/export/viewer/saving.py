"""A scene or a surface as one HTML page that needs neither a server nor a network."""

from __future__ import annotations

import logging
from collections.abc import Callable
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from coliags_plugin.contracts import GaussianField
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.files import atomic_write
from coliags_plugin.engine.trained import TrainedRun
from coliags_plugin.export.splats.cloud import SplatCloud
from coliags_plugin.export.viewer.content import ViewerContent
from coliags_plugin.export.viewer.layers import add_cameras, add_mesh, add_own_colours_light
from coliags_plugin.export.viewer.serving import import_viser, set_start, start_server, stop_server
from coliags_plugin.export.viewer.splats import merged_to, on_wire
from coliags_plugin.geometry.meshes.mesh import TriangleMesh
from coliags_plugin.reporting.html_page import refuse_folder
from coliags_plugin.reporting.numbers import counted

logger = logging.getLogger(__name__)

#: Largest page, bytes.
LARGEST_PAGE = 5_000_000
#: How much of the room found in one attempt the next one uses.
_CAUTION = 0.98
#: Bytes of a page that a Gaussian takes at least: 32, compressed and in base 64.
_FEWEST_BYTES = 30


def save_page(trained: TrainedRun, output: Path, largest: int = LARGEST_PAGE) -> Path:
    """Write :func:`scene_page` to a file; an existing one is replaced."""
    refuse_folder(output)
    atomic_write(output, scene_page(trained, largest))
    return output


def scene_page(trained: TrainedRun, largest: int = LARGEST_PAGE) -> str:
    """The Gaussians of a run as an HTML page; under the same light everywhere, where their colours know a lamp.

    Where the page would be larger than so many bytes, neighbouring Gaussians are merged.
    """
    if not isinstance(trained.model.field, GaussianField):
        raise InputError(
            f"method '{trained.method}' has no Gaussians to draw in a browser",
            "a method of Gaussians",
            "Write pictures with `coliags render`, or a mesh with `coliags mesh`",
        )
    import_viser()
    content = ViewerContent.of(trained).relit_evenly()
    splats, page = fitting_page(content, largest)
    if len(splats) < len(content.baked):
        logger.warning(
            "%d Gaussians are merged into %d, for a page of at most %.1f MB",
            *(len(content.baked), len(splats), largest / 1e6),
        )
    return page


def fitting_page(content: ViewerContent, largest: int) -> tuple[SplatCloud, str]:
    """The Gaussians of a run, merged into fewer where their page would be too large, and the page."""
    nothing = content.baked.part(np.zeros(len(content.baked), bool))
    empty = len(_page(content, nothing).encode())
    count = min(len(content.baked), max(0, largest - empty) // _FEWEST_BYTES)
    while count > 0:
        splats = merged_to(content.baked, count, content.distances)
        page = _page(content, splats)
        size = len(page.encode())
        if size <= largest:
            return splats, page
        count = min(count - 1, int(_CAUTION * len(splats) * (largest - empty) / (size - empty)))
    raise InputError(f"a page of {largest} bytes", f"more than {empty} bytes, what an empty one takes")


def save_surface(trained: TrainedRun, mesh: TriangleMesh, output: Path) -> None:
    """Write a run's mesh, in the colours of its vertices, as an HTML page; an existing one is replaced."""
    content = ViewerContent.of_mesh(trained, mesh)

    def fill(scene: Any) -> None:
        add_mesh(scene, "surface", mesh)
        add_own_colours_light(scene)

    atomic_write(output, _filled_page(content, fill, counted(len(mesh), "triangle")))


def _page(content: ViewerContent, splats: SplatCloud) -> str:
    def fill(scene: Any) -> None:
        scene.add_gaussian_splats("/splats", **on_wire(splats, content.unit), scale=content.unit)

    return _filled_page(content, fill, _caption(content, splats))


def _filled_page(content: ViewerContent, fill: Callable[[Any], None], caption: str) -> str:
    """A scene as a page, with the frames' cameras, which are shown when they are chosen, and a line at its bottom."""
    server = start_server("127.0.0.1", 0)
    try:
        set_start(server, content)
        fill(server.scene)
        for handle in add_cameras(server.scene, content):
            handle.visible = False
        page: str = server.get_scene_serializer().as_html()
    finally:
        stop_server(server)
    style = "position:fixed;left:0;bottom:0;padding:4px 8px;font:12px sans-serif;background:#fffc;pointer-events:none"
    line = f'<div style="{style}">{escape(caption)}</div>'
    return page.replace("<title>Viser</title>", f"<title>{escape(content.title)}</title>").replace(
        "</body>", f"{line}</body>"
    )


def _caption(content: ViewerContent, splats: SplatCloud) -> str:
    """What is seen."""
    text = f"{content.title}, step {content.trained.step}"
    if content.knows_lamp:
        text += "; flattened light"
    if len(splats) < len(content.baked):
        text += f"; {len(content.baked):,} Gaussians merged into {len(splats):,}"
    return text
