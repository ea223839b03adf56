"""The triton kernels compiled for GPUs that are not here, and what the compiler says of them."""

import json
import subprocess
import sys
from importlib.util import find_spec

import pytest

pytestmark = pytest.mark.skipif(find_spec("triton") is None, reason="triton is not installed")
#: A100, H100, B200; MI300.
NVIDIA = (("cuda", 80, 32), ("cuda", 90, 32), ("cuda", 100, 32))
AMD = (("hip", "gfx942", 64),)
#: Bytes of shared memory for which every GPU has several programs at work on each multiprocessor.
SHARED = 16 * 1024
#: Compiles every kernel in an interpreter of its own, in which kernels are not those of triton's interpreter.
SCRIPT = """
import json, pathlib, re, subprocess, sys
import triton
from triton.backends.compiler import GPUTarget
from triton.compiler import ASTSource
from coliags_plugin.renderers.triton_kernels import binning, gaussians, geometry, projection, surfel_projection, surfels
from coliags_plugin.renderers.triton_kernels import tile

WHOLE = ("columns", "rows", "width", "height", "channels", "count")
REAL = ("fx", "fy", "cx", "cy", "near_plane", "sharpness", "slack", "ellipse_slack", "eps2d", "surfel_filter")
REAL += ("alpha_min", "alpha_max", "transmittance_min", "x_min", "x_max", "y_min", "y_max")
TYPES = dict.fromkeys(WHOLE, "i32") | dict.fromkeys(REAL, "fp32")
TYPES |= dict.fromkeys(("gaussian", "tiles", "counts", "boxes"), "*i32")
TYPES |= dict.fromkeys(("starts", "order", "ends"), "*i64")
CUOBJDUMP = pathlib.Path(triton.__file__).parent / "backends/nvidia/bin/cuobjdump"
target = GPUTarget(*json.loads(sys.argv[1]))
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
]
found = {}
for kernel, warps, blocks in composited + placed:
    blocks |= dict.fromkeys(("WITH_MEDIANS", "WITH_DEPTHS", "WITH_NORMALS"), True)
    blocks = {name: value for name, value in blocks.items() if name in kernel.arg_names}
    types = TYPES | ({"of_pose": "*fp64"} if kernel.__module__.endswith("surfel_projection") else {})
    types = {name: types.get(name, "*fp32") for name in kernel.arg_names if name not in blocks}
    types |= dict.fromkeys(blocks, "constexpr")
    source = ASTSource(fn=kernel, signature=types, constexprs=blocks)
    made = triton.compile(source, target=target, options={"num_warps": warps, "enable_fp_fusion": True})
    variant = ".".join(str(blocks[name]) for name in ("CHANNELS", "EMIT") if name in blocks)
    name = f"{kernel.__module__.rsplit('.')[-1]}.{kernel.__name__}.{variant}"
    found[name] = {"shared": made.metadata.shared}
    if target.backend != "cuda":
        continue
    cubin = pathlib.Path(sys.argv[2], f"{name}.cubin")
    cubin.write_bytes(made.asm["cubin"])
    told = subprocess.run([CUOBJDUMP, "-res-usage", cubin], capture_output=True, text=True, check=True).stdout
    found[name] |= {key.lower(): int(value) for key, value in re.findall(r"(REG|STACK|LOCAL):(\\d+)", told)}
print(json.dumps(found))
"""


def compiled(target, path, monkeypatch):
    """What the compiler says of each kernel."""
    monkeypatch.delenv("TRITON_INTERPRET", raising=False)
    monkeypatch.setenv("TRITON_CACHE_DIR", str(path / "cache"))
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT, json.dumps(target), str(path)],
        capture_output=True, text=True, timeout=600, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-2000:]
    found = json.loads(done.stdout)
    assert len(found) == 16
    return found


@pytest.mark.parametrize("target", NVIDIA)
def test_every_kernel_compiles_without_a_device(target, tmp_path, monkeypatch):
    for name, usage in compiled(target, tmp_path, monkeypatch).items():
        assert usage["reg"] > 0 and usage["shared"] <= SHARED, (name, usage)
        assert not usage["stack"] and not usage["local"], f"{name} spills registers to memory: {usage}"


@pytest.mark.thorough
@pytest.mark.parametrize("target", AMD)
def test_every_kernel_compiles_for_another_maker(target, tmp_path, monkeypatch):
    assert all(usage["shared"] <= SHARED for usage in compiled(target, tmp_path, monkeypatch).values())
