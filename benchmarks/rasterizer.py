"""Milliseconds of drawing one view and of its gradients, by renderer, primitive and number of Gaussians.

    python benchmarks/rasterizer.py --counts 20000,50000,100000,200000 --backends torch,cpu --json FILE

Projection, sorting, compositing of colour, alpha and depth, and, for the second figure, the gradients of means,
quaternions, scales, opacities and colours. Renderers and primitives take turns, so that what else the machine does hits
all of them; figures are medians. A renderer so slow that all its turns would take longer than --patience skips some.

Surfels have the first two scales of the 3D Gaussians, and so do flat 3D Gaussians, whose third is a thousandth of the
smaller: what surfels cost in addition is their ratio to these.

Differences are those of outputs and of gradients to the first renderer's: the root of the sum of squares, as a share of
that of the first one's values, and the largest of an output or input.

On a machine that is busy with other work, --threads 1 --clock processor counts only the time that it gave to this.
"""

from __future__ import annotations

import math
import os
import statistics
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

# As the command line does, and before torch is imported.
os.environ.setdefault("GOMP_SPINCOUNT", "10000")

import torch
import tyro
from machine import CLOCKS, show
from torch import Tensor
from train_stages import Handed
from tube import camera, lining, wall

from coliags_plugin.contracts import Renderer
from coliags_plugin.core.components import make_component
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.gaussians import Gaussians
from coliags_plugin.engine.devices import choose_device
from coliags_plugin.renderers.splatting import choose_renderer

#: What is drawn, and the renderers' name for it.
PRIMITIVES = {"gaussians3d": "gaussians3d", "flat": "gaussians3d", "surfels": "surfels"}
FLATNESS = 1e-3
INPUTS = ("means", "quats_wxyz", "scales", "opacities", "colors")
WANTS = ("rgb", "alpha", "depth_accumulated")
#: Turns at least, however slow.
FEWEST = 3


@dataclass(frozen=True)
class Options:
    """Time renderers on one view."""

    counts: str = "20000,50000,100000,200000"
    """Numbers of Gaussians, comma separated."""
    backends: str = "torch,cpu"
    """Renderers by name, comma separated; triton needs a CUDA device, and gsplat the package
    docs/example_renderer besides. Ratios and differences are to the first."""
    device: str = "cpu"
    """Where to compute."""
    primitives: str = "gaussians3d"
    """Primitives, comma separated: gaussians3d, flat, surfels. The last column is their time relative to the first."""
    scene: Literal["wall", "lining"] = "wall"
    """A tube's wall of Gaussians turned at random before the camera, or lying in it and all around the camera."""
    repeats: int = 25
    """Timed turns; two more come first to warm up."""
    threads: int | None = None
    """CPU threads of torch and of the numba kernels; default: as many as torch chooses."""
    clock: Literal["wall", "processor"] = "wall"
    """Measure elapsed time, or the processor time of this process, summed over its threads."""
    patience: float = 15.0
    """Seconds that one renderer may take for one count before it skips turns."""
    json: Path | None = None
    """Also write the rows here."""


class Case:
    """One renderer with one set of Gaussians of one primitive, on the device it runs on."""

    def __init__(
        self, renderer: Renderer, device: torch.device, primitive: str, gaussians: Gaussians, clock: str
    ) -> None:
        self.renderer = renderer
        self.primitive = primitive
        self.device = device
        self.clock = CLOCKS[clock]
        moved = {name: getattr(gaussians, name).to(device, copy=True).requires_grad_() for name in INPUTS}
        self.gaussians = replace(gaussians, **moved)
        self.camera = camera().to(device)
        generator = torch.Generator().manual_seed(0)
        shape = (self.camera.height, self.camera.width)
        self.cotangents = [
            torch.randn(*shape, *([3] * (name == "rgb")), generator=generator).to(device) for name in WANTS
        ]
        self.forward: list[float] = []
        self.both: list[float] = []

    def draw(self) -> tuple[float, float]:
        """Draw once and go back once; milliseconds until the image, and until the gradients."""
        for name in INPUTS:
            getattr(self.gaussians, name).grad = None
        began = self._now()
        output = self.renderer.render(Handed(self.gaussians, self.primitive), self.camera, WANTS)
        drawn = self._now()
        maps = [output[name] for name in WANTS]
        torch.autograd.backward(maps, self.cotangents)
        done = self._now()
        self.maps = [values.detach() for values in maps]
        return 1e3 * (drawn - began), 1e3 * (done - began)

    def take_turn(self) -> None:
        """Draw once, and remember how long that took."""
        forward, both = self.draw()
        self.forward.append(forward)
        self.both.append(both)

    def differences(self, other: Case) -> tuple[float, float]:
        """Of outputs and of gradients, from those of another renderer."""
        gradients, theirs = (
            [torch.as_tensor(getattr(case.gaussians, name).grad) for name in INPUTS] for case in (self, other)
        )
        return _difference(self.maps, other.maps), _difference(gradients, theirs)

    def medians(self) -> tuple[float, float]:
        """Of all turns: milliseconds until the image, and until the gradients."""
        return statistics.median(self.forward), statistics.median(self.both)

    def _now(self) -> float:
        if self.device.type == "cuda":
            torch.cuda.synchronize(self.device)
        return self.clock()


def _difference(values: list[Tensor], others: list[Tensor]) -> float:
    return max(float((one - two).norm() / two.norm()) for one, two in zip(values, others, strict=True))


def shaped(gaussians: Gaussians, primitive: str) -> Gaussians:
    """The same Gaussians as flat ones or as surfels."""
    scales = gaussians.scales[:, :2].contiguous()
    if primitive == "flat":
        scales = torch.cat([scales, FLATNESS * scales.amin(dim=1, keepdim=True)], dim=1)
    return gaussians if primitive == "gaussians3d" else replace(gaussians, scales=scales)


def find_renderers(names: list[str], primitive: str, device: torch.device) -> dict[str, Renderer]:
    """Each renderer.

    Raises:
        InputError: One cannot run on the device.
    """
    return {name: choose_renderer(make_component("renderers", name), primitive, device).renderer for name in names}


def measure(cases: dict[tuple[str, str], Case], repeats: int, patience: float) -> None:
    """Let the cases take turns."""
    turns: dict[tuple[str, str], int] = {}
    for name, case in cases.items():
        case.draw()
        seconds = case.draw()[1] / 1e3
        turns[name] = min(repeats, max(FEWEST, math.ceil(patience / seconds)))
    for turn in range(repeats):
        for name, case in cases.items():
            if (turn + 1) * turns[name] // repeats > turn * turns[name] // repeats:
                case.take_turn()


def main(options: Options) -> None:
    """Run, print a table, and write JSON where asked."""
    if options.threads is not None:
        torch.set_num_threads(options.threads)
    names, primitives = options.backends.split(","), options.primitives.split(",")
    for primitive in primitives:
        if primitive not in PRIMITIVES:
            raise InputError(f"no primitive '{primitive}'", f"some of {', '.join(PRIMITIVES)}")
    device = choose_device(options.device)
    renderers = {primitive: find_renderers(names, PRIMITIVES[primitive], device) for primitive in primitives}
    rows: list[dict[str, Any]] = []
    shown: list[dict[str, Any]] = []
    for count in map(int, options.counts.split(",")):
        gaussians = {"wall": wall, "lining": lining}[options.scene](count)
        cases = {
            (name, primitive): Case(
                renderers[primitive][name], device, PRIMITIVES[primitive], shaped(gaussians, primitive), options.clock
            )
            for name in names
            for primitive in primitives
        }
        measure(cases, options.repeats, options.patience)
        medians = {case: cases[case].medians() for case in cases}
        for (name, primitive), (forward, both) in medians.items():
            row = {"backend": name, "primitive": primitive, "count": count}
            row |= {"forward_ms": forward, "forward_backward_ms": both}
            differences = cases[name, primitive].differences(cases[names[0], primitive])
            row |= dict(zip(("outputs_differ", "gradients_differ"), differences, strict=True))
            rows.append(row)
            first_forward, first_both = medians[names[0], primitive]
            ratios = {"faster, forward": first_forward / forward, "faster, both": first_both / both}
            ratios[f"both, of {primitives[0]}"] = both / medians[name, primitives[0]][1]
            shown.append({**row, **ratios, "turns": len(cases[name, primitive].both)})
    show(rows, options.json, shown)


if __name__ == "__main__":
    try:
        main(tyro.cli(Options))
    except InputError as error:
        raise SystemExit(str(error)) from None
