"""Check of the renderers of a device on trial views: values, gradients and speed (``coliags doctor``)."""

from __future__ import annotations

import copy
import time
import traceback
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial

import torch
from torch import Tensor

from coliags_plugin.checks.results import CheckFailedError, CheckResult
from coliags_plugin.config.components import make_component
from coliags_plugin.config.method_config import load_method
from coliags_plugin.contracts import GaussianField
from coliags_plugin.core.cameras import Camera
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.gaussians import Gaussians
from coliags_plugin.core.render_output import OUTPUTS, RenderOutput
from coliags_plugin.core.scenes import Frame, PointCloud, Scene
from coliags_plugin.engine.costs import RenderMeter
from coliags_plugin.renderers.choice import ChosenRenderer, choose_renderer
from coliags_plugin.renderers.splatting import SplattingRenderer
from coliags_plugin.renderers.torch_renderer import TorchRendererSettings, render_gaussians

#: Largest errors of outputs and gradients that pass, each of its own largest value.
OUTPUT_TOLERANCE, GRADIENT_TOLERANCE = 5e-5, 5e-4
PRIMITIVES = ("gaussians3d", "surfels")
INPUTS = ("means", "quats_wxyz", "scales", "opacities", "colors")
#: Outputs that jump from one Gaussian to another, so that rounding decides.
_JUMPS = frozenset({"depth_median"})
#: How far thresholds are moved to find the pixels where rounding decides, relative to themselves.
_THRESHOLD_MARGIN = 2e-5
#: Share of the children of anchors that are drawn by both, at least.
_SAME_CHILDREN = 0.99
#: Turns of the trial of speed at least, however slow.
_FEWEST = 3
#: Outputs of the trial of speed.
_TIMED = ("rgb", "alpha", "depth_accumulated")
_HINT = "Until that is mended, --set renderer=torch or --device cpu do without it"


@dataclass(frozen=True)
class TrialView:
    """Gaussians strewn at random before a camera; some twenty of them are drawn at a pixel, however many there are."""

    gaussians: int
    width: int  # pixels
    height: int  # pixels

    @property
    def camera(self) -> Camera:
        """At the origin of the world, looking along z."""
        size = (self.width, self.height)
        return Camera(0.9 * self.width, 0.9 * self.width, 0.5 * self.width, 0.5 * self.height, *size, torch.eye(4))

    def strewn(self, primitive: str) -> Gaussians:
        """The Gaussians, float32, on the CPU; the same each time."""
        generator = torch.Generator().manual_seed(0)

        def uniform(low: float, high: float, *shape: int) -> Tensor:
            return low + (high - low) * torch.rand(self.gaussians, *shape, generator=generator)

        z, camera = uniform(20.0, 60.0), self.camera
        x = (uniform(0.0, self.width) - camera.cx) / camera.fx
        y = (uniform(0.0, self.height) - camera.cy) / camera.fy
        pixels = (self.width * self.height / self.gaussians) ** 0.5  # between neighbours in the image
        scales = uniform(0.3, 1.3, 3 if primitive == "gaussians3d" else 2) * (pixels * z / camera.fx)[:, None]
        # Not edge-on, where float32 does not tell where a ray meets a disc.
        quats = torch.cat([torch.ones(self.gaussians, 1), uniform(-0.3, 0.3, 3)], dim=1)
        index = torch.arange(self.gaussians)
        means = torch.stack([x * z, y * z, z], dim=1)
        return Gaussians(means, quats, scales, uniform(0.1, 0.9), uniform(0.0, 1.0, 3), index, index)


@dataclass(frozen=True)
class Trial:
    """Views that renderers are tried on."""

    accuracy: TrialView = TrialView(200, 96, 64)
    speed: TrialView = TrialView(100_000, 640, 512)
    turns: int = 20  # timed, of which the median is told
    seconds: float = 2.0  # that they may take, beyond the fewest


def try_renderers(device: torch.device, trial: Trial) -> Iterator[CheckResult]:
    """Try the renderers that training would use on a device, gsplat where it works, and the field of ``coliags``.

    Errors are those of float32 on the device against the definition in PyTorch, in float64 on the CPU, each relative to
    the largest value of the output or gradient; whatever goes wrong is the reason of a failed check.
    """
    for primitive in PRIMITIVES:
        for chosen in _chosen(primitive, device):
            renderer, name = chosen.renderer, f"{chosen.name}, {primitive}"
            if isinstance(renderer, SplattingRenderer):
                yield _result(f"{name}: errors", partial(_errors, renderer, primitive, device, trial.accuracy))
                yield _result(f"{name}: speed", partial(_speed, renderer, primitive, device, trial))
    yield _result("anchors of coliags: errors", partial(_decoding_errors, device, trial.accuracy))


def _chosen(primitive: str, device: torch.device) -> Iterator[ChosenRenderer]:
    """The renderer that ``auto`` takes, and gsplat where it is available and another one."""
    taken = set()
    for name in ("auto", "gsplat"):
        try:
            chosen = choose_renderer(make_component("renderers", name), primitive, device)
        except InputError:  # told by the checks of the renderers
            continue
        if chosen.name not in taken:
            taken.add(chosen.name)
            yield chosen


def _result(name: str, attempt: Callable[[], str]) -> CheckResult:
    try:
        return CheckResult(name, "passed", attempt())
    except CheckFailedError as error:
        return CheckResult(name, "failed", f"{error}. {_HINT}")
    except Exception as error:  # of a driver, a compiler or a kernel: the reason in every case
        first = next((line.strip() for line in str(error).splitlines() if line.strip()), "")
        told = f"{type(error).__name__}: {first[:300]}" if first else type(error).__name__
        detail = f"{told.rstrip('.')}. {_HINT}; the traceback is in doctor --json"
        return CheckResult(name, "failed", detail, traceback=traceback.format_exc())


def _errors(renderer: SplattingRenderer, primitive: str, device: torch.device, view: TrialView) -> str:
    gaussians = view.strewn(primitive)
    unsettled = _unsettled(gaussians, view.camera)
    wants = tuple(name for name in OUTPUTS if name in renderer.outputs_of(primitive) - _JUMPS)
    began = time.perf_counter()
    ours = _values(renderer.draw, gaussians, view.camera, wants, device, torch.float32, unsettled)
    seconds = time.perf_counter() - began
    exact = _values(render_gaussians, gaussians, view.camera, wants, torch.device("cpu"), torch.float64, unsettled)
    return _compared(ours, exact, seconds)


#: Outputs and gradients by name, float64 on the CPU.
Values = tuple[dict[str, Tensor], dict[str, Tensor]]


def _compared(ours: Values, exact: Values, seconds: float) -> str:
    """The largest errors in words; CheckFailedError where one is larger than its tolerance."""
    told, wrong = [], []
    for kind, tolerance, found, true in zip(
        ("outputs", "gradients"), (OUTPUT_TOLERANCE, GRADIENT_TOLERANCE), ours, exact, strict=True
    ):
        errors = {name: float((found[name] - true[name]).abs().max() / true[name].abs().max()) for name in true}
        wrong += [f"{name} of {kind}" for name, error in errors.items() if not error <= tolerance]  # NaN is wrong
        listed = ", ".join(f"{name} {error:.1e}" for name, error in errors.items())
        told.append(f"{kind}, at most {tolerance:g}: {listed}")
    text = f"{'; '.join(told)}; first computed in {seconds:.1f} s, compilation included"
    if wrong:
        raise CheckFailedError(f"wrong: {', '.join(wrong)}. Largest errors of {text}")
    return f"largest errors of {text}"


def _decoding_errors(device: torch.device, view: TrialView) -> str:
    """The same of the Gaussians that a field of anchors decodes, with fresh networks."""
    frame = Frame("trial", 0, torch.zeros(view.height, view.width, 3, dtype=torch.uint8), view.camera)
    points = PointCloud(view.strewn("gaussians3d").means)
    node = load_method("coliags", ["field.voxel_size=0.01"]).config.field  # one anchor for each point
    scene = Scene("trial", [frame], {}, points, {})
    field = node.target.from_scene(scene, node.settings, torch.Generator().manual_seed(0))
    exact, ours = copy.deepcopy(field).double(), field.to(device)
    began = time.perf_counter()
    found = ours.gaussians(view.camera)
    seconds, true = time.perf_counter() - began, exact.gaussians(view.camera)
    slots, wanted = found.source_index.cpu(), true.source_index
    both = slots[torch.isin(slots, wanted)]  # an opacity of about 0 may be drawn by one alone
    if len(both) < _SAME_CHILDREN * max(len(slots), len(wanted)):
        raise CheckFailedError(
            f"wrong: {len(slots)} children drawn, {len(wanted)} expected, {len(both)} of them the same"
        )
    return _compared(_of_children(ours, found, both), _of_children(exact, true, both), seconds)


def _of_children(field: GaussianField, gaussians: Gaussians, slots: Tensor) -> Values:
    """Values of the Gaussians of some slots, and the gradients of a sum of all with random weights."""
    kept = torch.isin(gaussians.source_index, slots.to(gaussians.source_index.device))
    outputs = {name: getattr(gaussians, name)[kept] for name in INPUTS}
    generator = torch.Generator().manual_seed(1)
    weights = [torch.randn(value.shape, generator=generator).to(value) for value in outputs.values()]
    torch.autograd.backward(list(outputs.values()), weights)
    groups = field.parameter_groups().items()
    gradients = {name: torch.cat([torch.as_tensor(value.grad).flatten() for value in group]) for name, group in groups}
    return _exactly(outputs), _exactly(gradients)


def _exactly(values: Mapping[str, Tensor]) -> dict[str, Tensor]:
    return {name: value.detach().to("cpu", torch.float64) for name, value in values.items()}


Drawing = Callable[[Gaussians, Camera, tuple[str, ...]], RenderOutput]


def _values(
    draw: Drawing,
    gaussians: Gaussians,
    camera: Camera,
    wants: tuple[str, ...],
    device: torch.device,
    dtype: torch.dtype,
    unsettled: Tensor,
) -> Values:
    """Outputs, and the gradients of a sum of all with random weights, without some pixels: float64, on the CPU."""
    inputs = {name: getattr(gaussians, name).to(device, dtype, copy=True).requires_grad_() for name in INPUTS}
    pose = camera.camera_to_world.to(device, dtype, copy=True).requires_grad_()
    output = draw(replace(gaussians, **inputs), replace(camera, camera_to_world=pose), wants)
    generator, settled = torch.Generator().manual_seed(1), ~unsettled
    maps = {name: output[name] for name in wants}
    weights = {}
    for name, values in maps.items():
        drawn = torch.randn(values.shape, generator=generator)
        weights[name] = (drawn * settled.view(*settled.shape, *[1] * (drawn.ndim - 2))).to(device, dtype)
    torch.autograd.backward(list(maps.values()), list(weights.values()))
    shown = {name: values[settled] for name, values in _exactly(maps).items()}
    return shown, _exactly({name: torch.as_tensor(value.grad) for name, value in {**inputs, "pose": pose}.items()})


def _unsettled(gaussians: Gaussians, camera: Camera) -> Tensor:
    """Mask of the pixels that change where the alpha and transmittance thresholds are moved a little. [H, W]"""
    moved = {name: getattr(gaussians, name).double() for name in INPUTS}
    plain, alphas = TorchRendererSettings(), []
    for factor in (1.0 - _THRESHOLD_MARGIN, 1.0 + _THRESHOLD_MARGIN):
        cuts = TorchRendererSettings(
            alpha_min=factor * plain.alpha_min, transmittance_min=factor * plain.transmittance_min
        )
        alphas.append(render_gaussians(replace(gaussians, **moved), camera, settings=cuts).alpha)
    return (alphas[1] - alphas[0]).abs() > 1e-9


def _speed(renderer: SplattingRenderer, primitive: str, device: torch.device, trial: Trial) -> str:
    view = trial.speed
    camera, plain = view.camera.to(device), view.strewn(primitive)
    moved = {name: getattr(plain, name).to(device).requires_grad_() for name in INPUTS}
    gaussians = replace(plain, **moved, source_index=plain.source_index.to(device))

    def draw() -> RenderOutput:
        with torch.no_grad():
            return renderer.draw(gaussians, camera, _TIMED)

    def draw_and_back() -> RenderOutput:
        output = renderer.draw(gaussians, camera, _TIMED)
        torch.autograd.backward(torch.stack([output[name].sum() for name in _TIMED]).sum(), inputs=list(moved.values()))
        return output

    told = []
    for work in (draw, draw_and_back):
        meter, began, turns = RenderMeter(device), time.monotonic(), 0
        while turns <= trial.turns and (turns <= _FEWEST or time.monotonic() - began < trial.seconds):
            meter.render(work)
            turns += 1
        told.append(f"{meter.fps:.4g} frames/s{'' if work is draw else ' with gradients'}, median of {turns - 1}")
        for value in moved.values():
            value.grad = None
    size = f"{view.gaussians:,} Gaussians, {view.width}x{view.height}, colour, alpha and depth"
    return f"{size}: {'; '.join(told)}"
