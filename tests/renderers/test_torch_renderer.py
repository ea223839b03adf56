"""3D Gaussians drawn by the torch renderer, against closed forms; scenes for all renderers, and the choice of these."""

from __future__ import annotations

import dataclasses
import math

import pytest
import torch
from scipy.spatial.transform import Rotation

from coliags_plugin.contracts import Availability, GaussianField
from coliags_plugin.core import registry
from coliags_plugin.core.cameras import Camera
from coliags_plugin.core.components import make_component
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.gaussians import Gaussians
from coliags_plugin.core.render_output import OUTPUTS as ALL_OUTPUTS
from coliags_plugin.core.render_output import SURFEL_OUTPUTS
from coliags_plugin.renderers.splatting import choose_renderer
from coliags_plugin.renderers.torch_renderer import TorchRenderer, TorchRendererSettings
from tests.renderers.naive import extent

INPUTS = ("means", "quats_wxyz", "scales", "opacities", "colors")
#: Of 3D Gaussians.
OUTPUTS = tuple(name for name in ALL_OUTPUTS if name not in SURFEL_OUTPUTS)
SUMS = tuple(name for name in OUTPUTS if name != "depth_median")


def make(means, scales, opacities, colors=None, quats=None, dtype=torch.float64):
    means = torch.as_tensor(means, dtype=dtype).reshape(-1, 3)
    n = len(means)
    scales = torch.as_tensor(scales, dtype=dtype).expand(n, 3) if torch.as_tensor(scales).ndim < 2 else scales
    colors = torch.ones(n, 3) if colors is None else torch.as_tensor(colors)
    quats = torch.tensor([1.0, 0.0, 0.0, 0.0]).expand(n, 4) if quats is None else quats
    index = torch.arange(n)
    opacities = torch.as_tensor(opacities, dtype=dtype).expand(n)
    return Gaussians(means, quats.to(dtype), scales.to(dtype), opacities, colors.to(dtype), index, index)


def pinhole(width=9, height=7, fx=20.0, fy=20.0, cx=None, cy=None, pose=None, dtype=torch.float64):
    pose = torch.eye(4, dtype=dtype) if pose is None else pose.to(dtype)
    cx, cy = (width / 2 if cx is None else cx), (height / 2 if cy is None else cy)
    return Camera(fx, fy, cx, cy, width, height, pose)


def render_gaussians(gaussians, camera, wants=("rgb", "alpha"), settings=None, renderer=TorchRenderer):
    """View of Gaussians by a renderer."""
    return renderer(settings or renderer.Settings()).draw(gaussians, camera, wants)


def rigid(seed):
    generator = torch.Generator().manual_seed(seed)
    q = torch.randn(4, generator=generator, dtype=torch.float64)
    q = q / q.norm()
    matrix = torch.eye(4, dtype=torch.float64)
    matrix[:3, :3] = torch.from_numpy(Rotation.from_quat(q[[1, 2, 3, 0]].numpy()).as_matrix())
    matrix[:3, 3] = 3 * torch.randn(3, generator=generator, dtype=torch.float64)
    return matrix, q


def cast(gaussians, dtype=None, device=None, grad=False):
    moved = {k: getattr(gaussians, k).detach().to(device=device, dtype=dtype) for k in INPUTS}
    if grad:
        moved = {k: v.clone().requires_grad_() for k, v in moved.items()}
    return dataclasses.replace(gaussians, **moved)


# --- scenes -----------------------------------------------------------------------------------------------------------


def random_gaussians(n, seed=0, depth=(1.0, 9.0), scale=(0.02, 0.3), opacity=(0.05, 1.0), spread=0.6):
    generator = torch.Generator().manual_seed(seed)

    def uniform(low, high, *shape):
        return low + (high - low) * torch.rand(*shape, generator=generator, dtype=torch.float64)

    z = uniform(*depth, n)
    means = torch.stack([z * uniform(-spread, spread, n), z * uniform(-spread, spread, n), z], dim=-1)
    scales = torch.exp(uniform(math.log(scale[0]), math.log(scale[1]), n, 3))
    quats = torch.randn(n, 4, generator=generator, dtype=torch.float64)
    return make(means, scales, uniform(*opacity, n), uniform(0.0, 1.0, n, 3), quats)


def moved(gaussians, transform, quat):
    """Gaussians in a world moved by a rigid transform."""
    w, v = quat[0], quat[1:]
    q = gaussians.quats_wxyz
    product = torch.cat(
        [
            (w * q[:, 0] - q[:, 1:] @ v)[:, None],
            w * q[:, 1:] + q[:, :1] * v + torch.linalg.cross(v.expand(len(q), 3), q[:, 1:]),
        ],
        dim=-1,
    )
    return dataclasses.replace(
        gaussians, means=gaussians.means @ transform[:3, :3].T + transform[:3, 3], quats_wxyz=product
    )


#: Options of :func:`random_gaussians` and of :func:`pinhole` by the name of a scene.
_SCENES = {
    "random": ({"n": 120}, {}),
    "needles": ({"n": 80, "seed": 1}, {}),
    "pancakes": ({"n": 80, "seed": 2}, {}),
    "around the camera": ({"n": 150, "seed": 3, "depth": (-2.0, 1.5), "scale": (0.005, 0.2), "spread": 1.5}, {}),
    "crowd in one tile": (
        {"n": 400, "seed": 4, "depth": (2.0, 3.0), "scale": (0.01, 0.05), "opacity": (0.004, 0.08), "spread": 0.05},
        {"width": 12, "height": 11, "cx": None, "cy": None},
    ),
    "opaque": ({"n": 150, "seed": 5, "scale": (0.1, 0.6), "opacity": (0.9, 1.0)}, {}),
    "one pixel wide": ({"n": 60, "seed": 6}, {"width": 1, "height": 23, "cx": None, "cy": None}),
    "one pixel": ({"n": 60, "seed": 6}, {"width": 1, "height": 1, "cx": None, "cy": None}),
    # The axis misses the image.
    "off centre": (
        {"n": 120, "seed": 7, "spread": 1.5},
        {"width": 33, "height": 21, "fx": 12.0, "fy": 30.0, "cx": -6.5, "cy": 30.25},
    ),
}
SCENES = tuple(_SCENES)
#: Scales of Gaussians of extreme shapes, but for a factor of 0.5 to 0.8.
_SHAPES = {"needles": [2.0, 0.002, 0.002], "pancakes": [0.4, 0.3, 1e-5]}


def scene(name):
    """A camera and Gaussians, both in a moved world frame, float64."""
    options, view = _SCENES[name]
    gaussians, (transform, quat) = random_gaussians(**options), rigid(11)
    if name in _SHAPES:
        scales = torch.tensor(_SHAPES[name], dtype=torch.float64) * (0.5 + gaussians.scales)
        gaussians = dataclasses.replace(gaussians, scales=scales)
    camera = pinhole(**{"width": 37, "height": 26, "fx": 31.0, "fy": 27.0, "cx": 16.3, "cy": 14.9, **view})
    return moved(gaussians, transform, quat), dataclasses.replace(camera, camera_to_world=transform)


# --- closed forms -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("opacities", "name", "value"),
    [
        ([0.4, 0.8], "alpha", 0.4 + 0.6 * 0.8),
        ([0.4, 0.8], "inverse_depth_accumulated", 0.4 / 2 + 0.6 * 0.8 / 3),
        # 0.2^5 = 3.2e-4 is left after five; the sixth would leave 6.4e-5, so neither it nor the seventh is drawn.
        ([0.8] * 7, "alpha", 1 - 0.2**5),
        ([0.8] * 7, "depth_accumulated", sum(0.8 * 0.2**i * (2 + i) for i in range(5))),
        # After the third, T = 4e-4; the fourth is too much, and the faint fifth would fit but stays undrawn.
        ([0.8, 0.8, 0.99, 0.9, 0.01], "alpha", 1 - 0.2 * 0.2 * 0.01),
        *(
            ([opacity] * 3, "depth_median", depth)
            for opacity, depth in ((0.6, 2), (0.5, 2), (0.4, 3), (0.25, 4), (0.2, 0))
        ),
    ],
)
def test_compositing_of_gaussians_one_behind_the_other(opacities, name, value):
    """Gaussians so wide that their alpha is their opacity at any pixel, to 1e-8."""
    means = torch.tensor([[0, 0, 2.0 + i] for i in range(len(opacities))])
    output = render_gaussians(make(means, 1e3, opacities), pinhole(), OUTPUTS)
    torch.testing.assert_close(output[name][3, 4].item(), float(value), rtol=1e-7, atol=0)


def test_what_is_fainter_than_the_cut_is_not_drawn_and_radii_end_there():
    camera, variance = pinhole(41, 1), (20 * 0.3 / 4) ** 2 + 0.3
    output = render_gaussians(make([[0, 0, 4.0]], (0.3, 0.2, 0.2), 0.7), camera)
    distance = (torch.arange(41) - 20).abs()
    assert torch.equal(output.alpha[0] > 0, distance <= extent(0.7, variance))
    assert output.splats.radii.tolist() == [math.ceil(extent(0.7, variance))]


# --- against the naive renderer ---------------------------------------------------------------------------------------


def relative(ours, true):
    difference, size = (ours.detach().double() - true.detach()).norm(), true.detach().norm()
    return float(difference / size.clamp_min(1e-300))


def random_cotangents(camera, names=SUMS, seed=1, dtype=None):
    generator, shape = torch.Generator().manual_seed(seed), (camera.height, camera.width)
    channels = {name: (3,) if name in ("rgb", "normals") else () for name in names}
    return {name: torch.randn(*shape, *channels[name], generator=generator, dtype=dtype) for name in names}


def with_gradients(draw, gaussians, camera, cotangents):
    """Outputs, what else ``draw`` gives, and the gradients of everything."""
    gaussians = cast(gaussians, grad=True)
    pose = camera.camera_to_world.clone().requires_grad_()
    outputs, centers = draw(gaussians, dataclasses.replace(camera, camera_to_world=pose))
    sum((outputs[name] * given.to(outputs[name].dtype)).sum() for name, given in cotangents.items()).backward()
    return outputs, centers, {**{k: getattr(gaussians, k).grad for k in INPUTS}, "pose": pose.grad}


def test_what_carries_no_gradient():
    gaussians, camera = scene("random")
    assert not render_gaussians(gaussians, camera).splats.means2d.requires_grad
    with torch.no_grad():
        output = render_gaussians(cast(gaussians, grad=True), camera, OUTPUTS)
    assert not output.rgb.requires_grad and not output.splats.means2d.requires_grad
    output = render_gaussians(cast(gaussians, grad=True), camera, OUTPUTS)
    assert output["depth_median"].any()
    assert not output["depth_median"].requires_grad and not output.splats.radii.requires_grad


# --- the component ----------------------------------------------------------------------------------------------------


class FieldOf(GaussianField):
    """A field of given Gaussians or surfels."""

    feature_channels = frozenset()

    def __init__(self, gaussians):
        torch.nn.Module.__init__(self)
        self._gaussians = gaussians
        self.primitive = "surfels" if gaussians.scales.shape[1] == 2 else "gaussians3d"

    def gaussians(self, camera, light=None, generator=None):
        return self._gaussians

    def parameter_groups(self):
        return {}


FieldOf.__abstractmethods__ = frozenset()


def test_what_cannot_be_rendered_says_so():
    gaussians, camera = scene("random")
    renderer, field = TorchRenderer(TorchRendererSettings()), FieldOf(gaussians)
    with pytest.raises(InputError, match="whole images"):
        renderer.render(field, camera, pixels=torch.zeros(3, 2))
    with pytest.raises(InputError, match="Did you mean 'depth_median'"):
        renderer.render(field, camera, ("depth_medain",))
    field.primitive = "radiance"
    with pytest.raises(InputError, match="radiance"):
        renderer.render(field, camera)
    with pytest.raises(InputError, match="three scales"):
        render_gaussians(dataclasses.replace(gaussians, scales=gaussians.scales[:, :1]), camera)


# Choice of renderers: impossible pairs are refused, and the reason for a choice is given


CPU = torch.device("cpu")


def test_auto_chooses_cpu_on_the_cpu_falls_back_to_torch_and_says_why(monkeypatch):
    renderer = make_component("renderers", {"name": "auto", "background": (0.5, 0.0, 0.0)})
    chosen = choose_renderer(renderer, "gaussians3d", CPU)
    assert chosen.name == "cpu" and "auto chose cpu" in chosen.reason
    assert chosen.renderer.settings.background == (0.5, 0.0, 0.0)
    unavailable = classmethod(lambda cls: Availability(False, "numba is at lunch"))
    monkeypatch.setattr(registry.renderers.get("cpu"), "availability", unavailable)
    chosen = choose_renderer(renderer, "gaussians3d", CPU)
    assert chosen.name == "torch" and "cpu cannot run here: numba is at lunch" in chosen.reason
    with pytest.raises(InputError, match="numba is at lunch"):
        choose_renderer(make_component("renderers", "cpu"), "gaussians3d", CPU)


@pytest.mark.parametrize(
    ("renderer", "message"),
    [
        ("torch", r"draws gaussians3d, surfels, the field is made of radiance"),
        ("auto", r"no renderer can serve.*`renderer=NAME`, NAME being volume"),
        ({"name": "auto", "prefer": ("volum",)}, r"renderer auto, prefer: .*Did you mean 'volume'"),
    ],
)
def test_an_impossible_pair_names_both_sides(renderer, message):
    with pytest.raises(InputError, match=message):
        choose_renderer(make_component("renderers", renderer), "radiance", CPU)
