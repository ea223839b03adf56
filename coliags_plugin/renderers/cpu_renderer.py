"""Numba CPU rasterizer with the same outputs as the torch reference."""

from __future__ import annotations

import math
from collections.abc import Sequence
from importlib.util import find_spec
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor

from coliags_plugin.contracts import Availability
from coliags_plugin.core.cameras import Camera
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.gaussians import Gaussians
from coliags_plugin.core.render_output import RenderOutput, Splats
from coliags_plugin.renderers.projection import slope_limits
from coliags_plugin.renderers.splatting import CutSettings, SplattingRenderer, is_surfels

#: Tensors of the Gaussians in the order of ``layout.Parameters``.
_TENSORS = ("means", "quats_wxyz", "scales", "opacities", "colors")
#: Output by name of the kernels' image.
_IMAGES = {
    "rgb": "rgb",
    "alpha": "alpha",
    "depth": "depth_accumulated",
    "inverse_depth": "inverse_depth_accumulated",
    "expected": "depth_expected",
    "normals": "normals",
    "median": "depth_median",
    "distortion": "distortion",
}


class CpuRenderer(SplattingRenderer[CutSettings]):
    """CPU renderer of float32 3D Gaussians and surfels: ``docs/rendering.md``, section "The cpu backend"."""

    devices: ClassVar[frozenset[str]] = frozenset({"cpu"})
    name: ClassVar[str] = "cpu"

    @classmethod
    def availability(cls) -> Availability:
        """Available where numba is installed, which is not imported here."""
        if find_spec("numba") is None:
            return Availability(False, "numba is not installed: pip install numba")
        return Availability(True, f"numba kernels on {torch.get_num_threads()} threads")

    def draw(self, gaussians: Gaussians, camera: Camera, wants: Sequence[str]) -> RenderOutput:
        """Draw Gaussians; the first call on a machine compiles the kernels, which takes about ten seconds.

        Raises:
            InputError: An output is unknown or not of these Gaussians; a tensor is of the wrong shape, dtype or device;
                a Gaussian is not finite, has a quaternion of length 0 or a negative scale; the camera cannot be used.
        """
        from coliags_plugin.renderers.numba_kernels import pipeline

        self.check_gaussian_outputs(wants, gaussians)
        self.check_tensors(gaussians)
        pose = camera.camera_to_world.to(device="cpu", dtype=torch.float32)
        images = {image for image, name in _IMAGES.items() if name in ("rgb", "alpha", *wants)}
        if "expected" in images:
            images.add("depth")
        primitive = pipeline.SURFELS if is_surfels(gaussians) else pipeline.GAUSSIANS
        view = _view_table(camera, pose, self.settings)
        stages = pipeline.Pipeline(primitive, view, camera.width, camera.height, images)
        channels = {name: gaussians.features[name] for name in wants if name in gaussians.features}
        tensors = [getattr(gaussians, name) for name in _TENSORS]
        try:
            means2d, radii, drawn, features = pipeline.render(tensors, list(channels.values()), pose, stages)
        except pipeline.UnusableGaussianError:
            raise _unusable(gaussians) from None
        except pipeline.TooManyPairsError as error:
            raise InputError(
                f"{len(gaussians)} Gaussians that cover {error} tiles of 16 x 16 pixels, counted for each",
                "less than 2^31",
                "Check their scales",
            ) from None
        by_name = {name: drawn[image] for image, name in _IMAGES.items()}
        by_name |= dict(zip(channels, features, strict=True))
        maps = {name: by_name[name] for name in wants if name not in ("rgb", "alpha")}
        return RenderOutput(by_name["rgb"], by_name["alpha"], camera, maps, Splats(gaussians, means2d, radii))


def _view_table(camera: Camera, pose: Tensor, settings: CutSettings) -> np.ndarray:
    """Camera and options as the float32 table of the kernels (``numba_kernels/layout.py``)."""
    matrix = pose.detach().double().numpy()
    if matrix.shape != (4, 4):
        raise InputError(f"camera_to_world of shape {list(matrix.shape)}", "[4, 4]")
    if camera.width < 1 or camera.height < 1:
        raise InputError(f"a camera of {camera.width} x {camera.height} pixels", "at least one pixel each way")
    table = [
        *matrix[:3].T.ravel(),
        *(camera.fx, camera.fy, camera.cx, camera.cy),
        *slope_limits(camera.fx, camera.cx, camera.width),
        *slope_limits(camera.fy, camera.cy, camera.height),
        *(camera.near_plane, settings.eps2d, camera.width, camera.height),
        *(math.log2(settings.alpha_min), settings.alpha_max, settings.transmittance_min),
        *settings.background,
        *(math.sqrt(0.5 / math.log(2.0)) / settings.surfel_filter, settings.distortion_slope(camera.near_plane) ** 2),
    ]
    if not np.isfinite(table).all():
        raise InputError(f"a camera with numbers that are not finite: {camera}", "finite intrinsics and pose")
    return np.array(table, np.float32)


def _unusable(gaussians: Gaussians) -> InputError:
    """The error for the first invalid Gaussian."""
    squared = gaussians.quats_wxyz.detach().square().sum(dim=1)
    checks = [(name, getattr(gaussians, name).isfinite(), "finite numbers") for name in _TENSORS]
    checks += [
        ("scales", gaussians.scales >= 0, "standard deviations, not below 0"),
        (
            "quats_wxyz",
            (squared >= 1e-24) & squared.isfinite(),
            "a quaternion whose length float32 can hold, and not 0",
        ),
    ]
    name, usable, expected = next(check for check in checks if not check[1].all())
    index = int((~usable.reshape(len(usable), -1).all(dim=1)).nonzero()[0])
    return InputError(f"{name}[{index}] is {getattr(gaussians, name)[index].tolist()}", expected)
