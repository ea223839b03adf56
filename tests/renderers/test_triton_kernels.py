"""Triton kernels compiled for GPUs that are not here, and what the compiler says of them."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest

pytestmark = [
    pytest.mark.thorough,
    pytest.mark.skipif(find_spec("triton") is None, reason="triton is not installed"),
]
#: A100, H100, B200; MI300.
NVIDIA = (("cuda", 80, 32), ("cuda", 90, 32), ("cuda", 100, 32))
AMD = (("hip", "gfx942", 64),)
#: What was compiled of these sources before, found by their hash; `make clean` removes it.
CACHE = Path(__file__).parents[2] / "build" / "triton"
#: Bytes of shared memory for which every GPU has several programs at work on each multiprocessor.
SHARED = 16 * 1024
#: Bytes of registers that a thread may keep in memory, where the compiler so gets another program on a multiprocessor.
SPILLED = 8
#: Types of arguments that are not tables of float32.
TYPES = {
    **dict.fromkeys(("columns", "rows", "width", "height", "channels", "count", "anchors", "tiles"), "i32"),
    **dict.fromkeys(("fx", "fy", "cx", "cy", "near_plane", "sharpness"), "fp32"),
    **dict.fromkeys(("alpha_min", "alpha_max", "transmittance_min", "sigmas"), "fp32"),
    **dict.fromkeys(("gaussian", "counts", "boxes"), "*i32"),
    **dict.fromkeys(("starts", "order", "ends", "sources", "visible_sources"), "*i64"),
    "visible": "*i1",
}


def of_renderer():
    """Kernels for images of few and many channels, with all outputs: name, kernel, types, constants and options."""
    from coliags_plugin.renderers.triton_kernels import geometry, projection, sweeps

    everything = dict.fromkeys(("WITH_MEDIANS", "WITH_DEPTHS", "WITH_NORMALS"), True)
    composited = [
        (kernel, warps, {"CHANNELS": wide, "SIZE": sweeps.TILE_SIZE, "RANKS": sweeps.RANKS})
        for kernels, warps in (
            ((sweeps.gaussians_forward, sweeps.surfels_forward), sweeps.FORWARD_WARPS),
            ((sweeps.gaussians_backward, sweeps.surfels_backward), sweeps.BACKWARD_WARPS),
        )
        for kernel in kernels
        for wide in (16, 32)
    ]
    placed = [
        (kernel, geometry.WARPS, {"SIZE": sweeps.TILE_SIZE, "BLOCK": geometry.BLOCK, "EMIT": emit})
        for kernel, emits in (
            (projection.forward, [0]), (projection.backward, [0]), (geometry.find_pairs, [False, True]),
            *((kernel, [0]) for kernel in (projection.centers, projection.centers_backward)),
            *((kernel, [0]) for kernel in (projection.surfels_forward, projection.surfels_backward)),
        )
        for emit in emits
    ]  # fmt: skip
    for kernel, warps, blocks in composited + placed:
        variant = ".".join(str(blocks[name]) for name in ("CHANNELS", "EMIT") if name in blocks)
        name = f"{kernel.__module__.rsplit('.')[-1]}.{kernel.__name__}.{variant}"
        sums = "*fp64" if kernel.__name__ in ("centers_backward", "surfels_backward") else "*fp32"
        types = TYPES | {"tiles": "*i32", "of_pose": sums} | structures(geometry, sums)
        yield name, kernel, types, blocks | everything, {"num_warps": warps, "enable_fp_fusion": True}


def structures(geometry, sums):
    """Types of the arguments that are named tuples; ``sums`` is that of the sums of the pose's gradient."""
    tables = ["*fp32"] * 4
    return {
        **dict.fromkeys(("gaussians", "surfels"), geometry.Tables(*tables, "*fp32")),
        **dict.fromkeys(("of_gaussians", "of_surfels"), geometry.Tables(*tables, sums)),
        **dict.fromkeys(("projected", "of_projected"), geometry.Projected(*tables, "*fp32")),
        "extents": geometry.Extents("*fp32", "*fp32", "*i32"),
        "view": geometry.View("i32", *["fp32"] * 5),
        "slope_limits": ("fp32",) * 4,
        "cuts": geometry.Cuts(*["fp32"] * 4),
        "grid": geometry.Grid(*["i32"] * 4),
    }


def of_decoding():
    """The kernels for the networks of `coliags`, with the gradients of the pose, likewise."""
    import torch

    from coliags_plugin.config.method_config import load_method
    from coliags_plugin.contracts import SeenAnchors
    from coliags_plugin.fields.triton_kernels import children, decoding

    node = load_method("coliags").config.field
    field = node.target(node.settings, 1, torch.Generator())
    seen = SeenAnchors(field.features, *(torch.zeros(1, width) for width in (3, 1, 1)))
    heads = field.geometry_head.networks(seen), field.appearance_head.networks(seen)
    opacity, covariance, color = children.networks_of(field.slots_per_element, field.features.shape[1], *heads)
    constants = {
        **{"NETWORK": opacity, "OPACITY": opacity, "COVARIANCE": covariance, "COLOR": color, "LENGTH": color.end},
        **{"CHILDREN": color.children, "WITH_GEOMETRY": True, "WITH_APPEARANCE": True},
        **{"SLOTS": children.block_of(color.children), "INPUTS": children.block_of(color.plain_inputs)},
    }
    for kernel in (decoding.decode_opacities, decoding.draw, decoding.draw_backward):
        yield kernel.__name__, kernel, TYPES, constants, children.OPTIONS
    yield "networks_backward", decoding.networks_backward, TYPES, constants, children.BACKWARD_OPTIONS


@pytest.mark.parametrize("target", [*NVIDIA, *AMD])
def test_every_kernel_compiles_without_a_device(target, tmp_path, monkeypatch):
    """Several programs fit a multiprocessor, and hardly spill registers, which NVIDIA's compiler tells of alone.

    They are compiled in an interpreter of their own, in which kernels are not those of triton's interpreter.
    """
    monkeypatch.delenv("TRITON_INTERPRET", raising=False)
    monkeypatch.setenv("TRITON_CACHE_DIR", str(CACHE))
    command = [sys.executable, "-m", "tests.renderers.test_triton_kernels", json.dumps(target), str(tmp_path)]
    process = subprocess.run(command, capture_output=True, text=True, timeout=600, check=False)
    assert process.returncode == 0, process.stderr[-2000:]
    usages_by_kernel = json.loads(process.stdout)
    assert usages_by_kernel
    for name, usage in usages_by_kernel.items():
        assert usage["shared"] <= SHARED, (name, usage)
        if target in NVIDIA:
            assert usage["reg"] > 0 and usage["stack"] <= SPILLED and not usage["local"], f"{name} spills: {usage}"


def _usages(target, folder):
    """Bytes of shared memory of each kernel; of NVIDIA's, also registers, and bytes of stack and local memory."""
    import triton
    from triton.backends.compiler import GPUTarget
    from triton.compiler import ASTSource

    cuobjdump = Path(triton.__file__).parent / "backends/nvidia/bin/cuobjdump"
    usages = {}
    for name, kernel, types, constants, options in (*of_renderer(), *of_decoding()):
        fixed = {key: value for key, value in constants.items() if key in kernel.arg_names}
        signature = {key: "constexpr" if key in fixed else types.get(key, "*fp32") for key in kernel.arg_names}
        source = ASTSource(fn=kernel, signature=signature, constexprs=fixed)
        compiled = triton.compile(source, target=GPUTarget(*target), options=options)
        usages[name] = {"shared": compiled.metadata.shared}
        if target[0] == "cuda":
            cubin = Path(folder, f"{name}.cubin")
            cubin.write_bytes(compiled.asm["cubin"])
            text = subprocess.run([cuobjdump, "-res-usage", cubin], capture_output=True, text=True, check=True).stdout
            usages[name] |= {key.lower(): int(value) for key, value in re.findall(r"(REG|STACK|LOCAL):(\d+)", text)}
    return usages


if __name__ == "__main__":
    print(json.dumps(_usages(json.loads(sys.argv[1]), sys.argv[2])))
