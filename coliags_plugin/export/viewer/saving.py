"""A scene or a surface as one HTML page that needs neither a server nor a network."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Any

from coliags_plugin.contracts import GaussianField, knows_lamp
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.files import atomic_write
from coliags_plugin.engine.held_light import held_light
from coliags_plugin.engine.trained import TrainedRun
from coliags_plugin.export.baking.baking import SECONDS, bake
from coliags_plugin.export.baking.distillation import best_frame
from coliags_plugin.export.baking.exporting import cost_lines, export_cost, light_facts
from coliags_plugin.export.splats.cloud import SplatCloud, field_of_cloud
from coliags_plugin.export.viewer.content import NOTHING, ViewerContent
from coliags_plugin.export.viewer.layers import add_cameras, add_mesh, add_own_colours_light
from coliags_plugin.export.viewer.serving import import_viser, set_start, start_server, stop_server
from coliags_plugin.export.viewer.splats import most_visible, off_wire, on_wire, rounded
from coliags_plugin.geometry.meshes.mesh import TriangleMesh
from coliags_plugin.reporting.html_page import refuse_folder
from coliags_plugin.reporting.numbers import counted

#: Largest page, bytes.
LARGEST_PAGE = 5_000_000
#: Bytes of a page that a Gaussian takes, about: 32, rounded, compressed and in base 64.
_BYTES = 28
#: Lets pages opened as files sort their splats: browsers refuse them workers of blob URLs, and take data URLs.
_WORKERS = (
    "window.Worker=class extends Worker{constructor(url,options){"
    "if(String(url).startsWith('blob:')){const got=new XMLHttpRequest();got.open('GET',url,false);got.send();"
    "url='data:text/javascript;charset=utf-8,'+encodeURIComponent(got.responseText)}super(url,options)}}"
)
#: Room for the line at the bottom.
_LINE_BYTES = 2000
#: How much of the room found in one attempt the next one uses.
_CAUTION = 0.98


@dataclass(frozen=True)
class ScenePage:
    """A scene as a page, and what it is and loses."""

    html: str
    text: str  # the same in a line
    facts: Mapping[str, Any]


def save_page(trained: TrainedRun, output: Path, largest: int, light: str, seconds: float) -> ScenePage:
    """Write :func:`scene_page` to a file; an existing one is replaced."""
    refuse_folder(output)
    page = scene_page(trained, largest, light, seconds)
    atomic_write(output, page.html)
    return page


def scene_page(
    trained: TrainedRun, largest: int = LARGEST_PAGE, light: str = "recorded", seconds: float = SECONDS
) -> ScenePage:
    """The Gaussians of a run as an HTML page of at most so many bytes, compared with the run on its held-out frames.

    They are baked in a light, given by its name, as files are, with colours that do not depend on the direction: the
    most visible ones, as many as the page holds, fitted to what the run renders for so many seconds. The view starts at
    the training frame that they show best in comparison with the run.
    """
    field = trained.model.field
    if not isinstance(field, GaussianField):
        raise InputError(
            f"method '{trained.method}' has no Gaussians to draw in a browser",
            "a method of Gaussians",
            "Write pictures with `coliags render`, or a mesh with `coliags mesh`",
        )
    import_viser()
    held = held_light(light, trained.model, [frame.camera for frame in trained.scene.train])
    empty = len(_page(ViewerContent.of_cloud(trained, NOTHING), NOTHING).encode()) + _LINE_BYTES
    if largest < empty + _BYTES:
        raise InputError(f"a page of {largest} bytes", f"more than {empty + _BYTES} bytes, what an empty one takes")
    baked, baking = bake(trained, held, seconds, (largest - empty) // _BYTES, 0)
    first = best_frame(field_of_cloud(baked), trained, held)
    content = ViewerContent.of_cloud(trained, baked, first)
    splats = baked
    while (size := len((page := _page(content, splats)).encode()) + _LINE_BYTES) > largest:
        splats = most_visible(splats, int(_CAUTION * len(splats) * (largest - empty) / (size - empty)))
    drawn = off_wire(rounded(on_wire(splats, content.unit)), content.unit)
    cost = export_cost(trained, drawn, held if knows_lamp(field) else None)
    text = f"{content.title}, step {trained.step}; {len(splats):,} of {baking['visible']:,} Gaussians"
    if knows_lamp(field):
        text += f"; {light} light"
    text = "; ".join([text, *cost_lines(cost)])
    facts = {"gaussians": len(splats), "baking": {"light": light_facts(light, field, held), **baking}, "cost": cost}
    return ScenePage(_with_line(page, text), text, facts)


def save_surface(trained: TrainedRun, mesh: TriangleMesh, output: Path) -> None:
    """Write a run's mesh, in the colours of its vertices, as an HTML page; an existing one is replaced."""
    content = ViewerContent.of_mesh(trained, mesh)

    def fill(scene: Any) -> None:
        add_mesh(scene, "surface", mesh)
        add_own_colours_light(scene)

    atomic_write(output, _with_line(_filled_page(content, fill), counted(len(mesh), "triangle")))


def _page(content: ViewerContent, splats: SplatCloud) -> str:
    def fill(scene: Any) -> None:
        wire = rounded(on_wire(splats, content.unit))
        scene.add_gaussian_splats("/splats", **wire, scale=content.unit)

    return _filled_page(content, fill)


def _filled_page(content: ViewerContent, fill: Callable[[Any], None]) -> str:
    """A scene as a page, with the frames' cameras, which are shown when they are chosen."""
    server = start_server("127.0.0.1", 0)
    try:
        set_start(server, content)
        fill(server.scene)
        for handle in add_cameras(server.scene, content):
            handle.visible = False
        page: str = server.get_scene_serializer().as_html()
    finally:
        stop_server(server)
    head = f"<title>{escape(content.title)}</title><script>{_WORKERS}</script>"
    return page.replace("<title>Viser</title>", head)


def _with_line(page: str, text: str) -> str:
    """A page with a line at its bottom."""
    style = "position:fixed;left:0;bottom:0;padding:4px 8px;font:12px sans-serif;background:#fffc;pointer-events:none"
    return page.replace("</body>", f'<div style="{style}">{escape(text)}</div></body>')
