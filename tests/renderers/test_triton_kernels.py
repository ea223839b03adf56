"""The triton kernels of the renderer, compiled for GPUs that are not here."""

from importlib.util import find_spec

import pytest

from tests.triton_compiler import TARGETS, assert_compiles

pytestmark = pytest.mark.skipif(find_spec("triton") is None, reason="triton is not installed")
WHOLE = ("columns", "rows", "width", "height", "channels", "count")
REAL = ("fx", "fy", "cx", "cy", "near_plane", "sharpness", "slack", "ellipse_slack", "eps2d", "surfel_filter")
REAL += ("alpha_min", "alpha_max", "transmittance_min", "x_min", "x_max", "y_min", "y_max")
TYPES = dict.fromkeys(WHOLE, "i32") | dict.fromkeys(REAL, "fp32")
TYPES |= dict.fromkeys(("gaussian", "tiles", "counts", "boxes"), "*i32")
TYPES |= dict.fromkeys(("starts", "order", "ends"), "*i64")


def variants():
    """The kernels for images of few and many channels, with all outputs."""
    from coliags_plugin.renderers.triton_kernels import (
        binning,
        gaussians,
        geometry,
        projection,
        surfel_projection,
        surfels,
        tile,
    )

    everything = dict.fromkeys(("WITH_MEDIANS", "WITH_DEPTHS", "WITH_NORMALS"), True)
    composited = [
        (kernel, warps, {"CHANNELS": wide, "SIZE": tile.TILE_SIZE, "RANKS": tile.RANKS})
        for module in (gaussians, surfels)
        for kernel, warps in ((module.forward, tile.FORWARD_WARPS), (module.backward, tile.BACKWARD_WARPS))
        for wide in (16, 32)
    ]
    placed = [
        (kernel, geometry.WARPS, {"SIZE": tile.TILE_SIZE, "BLOCK": geometry.BLOCK, "EMIT": emit})
        for kernel, emits in (
            (projection.forward, [0]), (projection.backward, [0]), (binning.find_pairs, [False, True]),
            *((kernel, [0]) for kernel in (surfel_projection.centers, surfel_projection.centers_backward)),
            *((kernel, [0]) for kernel in (surfel_projection.forward, surfel_projection.backward)),
        )
        for emit in emits
    ]  # fmt: skip
    for kernel, warps, blocks in composited + placed:
        variant = ".".join(str(blocks[name]) for name in ("CHANNELS", "EMIT") if name in blocks)
        name = f"{kernel.__module__.rsplit('.')[-1]}.{kernel.__name__}.{variant}"
        types = TYPES | ({"of_pose": "*fp64"} if kernel.__module__.endswith("surfel_projection") else {})
        yield name, kernel, types, blocks | everything, {"num_warps": warps, "enable_fp_fusion": True}


@pytest.mark.parametrize("target", TARGETS)
def test_every_kernel_compiles_without_a_device(target, tmp_path, monkeypatch):
    assert_compiles(__file__, target, tmp_path, monkeypatch)
