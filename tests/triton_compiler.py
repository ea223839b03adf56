"""Triton kernels compiled for GPUs that are not here, and what the compiler says of them."""

from __future__ import annotations

import json
import re
import runpy
import subprocess
import sys
from pathlib import Path

import pytest

#: A100, H100, B200; MI300.
NVIDIA = (("cuda", 80, 32), ("cuda", 90, 32), ("cuda", 100, 32))
AMD = (("hip", "gfx942", 64),)
TARGETS = [pytest.param(target, marks=pytest.mark.thorough) for target in (*NVIDIA, *AMD)]
#: What was compiled of these sources before, found by their hash; `make clean` removes it.
CACHE = Path(__file__).parents[1] / "build" / "triton"
#: Bytes of shared memory for which every GPU has several programs at work on each multiprocessor.
SHARED = 16 * 1024
#: Bytes of registers that a thread may keep in memory, where the compiler so gets another program on a multiprocessor.
SPILLED = 8


def assert_compiles(path, target, folder, monkeypatch):
    """All variants of a test module compile, for several programs on a multiprocessor and hardly spilling registers.

    Its ``variants()`` are names, kernels, types of arguments where these are not tables of float32, constants and
    options. They are compiled in an interpreter of their own, in which kernels are not those of triton's interpreter.
    What is spilled is told of NVIDIA's targets alone.
    """
    monkeypatch.delenv("TRITON_INTERPRET", raising=False)
    monkeypatch.setenv("TRITON_CACHE_DIR", str(CACHE))
    command = [sys.executable, "-m", __name__, path, json.dumps(target), str(folder)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=600, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    found = json.loads(done.stdout)
    assert found
    for name, usage in found.items():
        assert usage["shared"] <= SHARED, (name, usage)
        if target in NVIDIA:
            assert usage["reg"] > 0 and usage["stack"] <= SPILLED and not usage["local"], f"{name} spills: {usage}"


def _usages(path, target, folder):
    """Bytes of shared memory of each variant; of NVIDIA's, also registers, and bytes of stack and local memory."""
    import triton
    from triton.backends.compiler import GPUTarget
    from triton.compiler import ASTSource

    cuobjdump = Path(triton.__file__).parent / "backends/nvidia/bin/cuobjdump"
    usages = {}
    for name, kernel, types, constants, options in runpy.run_path(path)["variants"]():
        known = {key: value for key, value in constants.items() if key in kernel.arg_names}
        signature = {key: "constexpr" if key in known else types.get(key, "*fp32") for key in kernel.arg_names}
        source = ASTSource(fn=kernel, signature=signature, constexprs=known)
        made = triton.compile(source, target=GPUTarget(*target), options=options)
        usages[name] = {"shared": made.metadata.shared}
        if target[0] == "cuda":
            cubin = Path(folder, f"{name}.cubin")
            cubin.write_bytes(made.asm["cubin"])
            told = subprocess.run([cuobjdump, "-res-usage", cubin], capture_output=True, text=True, check=True).stdout
            usages[name] |= {key.lower(): int(value) for key, value in re.findall(r"(REG|STACK|LOCAL):(\d+)", told)}
    return usages


if __name__ == "__main__":
    print(json.dumps(_usages(sys.argv[1], json.loads(sys.argv[2]), sys.argv[3])))
