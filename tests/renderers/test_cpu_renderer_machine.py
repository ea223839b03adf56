"""Kernels on their machine: wide registers, also of other processors, a cache that may fail, threads and forks."""

import dataclasses
import functools
import logging
import os
import re
import subprocess
import sys
import threading
from pathlib import Path

import llvmlite.binding as llvm
import numba
import numba.core.caching
import pytest
import torch
from numba import types

from coliags_plugin.core.numba_kernels import compilation
from coliags_plugin.renderers.cpu_renderer import CpuRenderer
from coliags_plugin.renderers.numba_kernels import layout, sweep_backward, sweep_forward
from tests.renderers.test_torch_renderer import cast, render_gaussians, scene

# --- registers --------------------------------------------------------------------------------------------------------

FLOATS, INTS = types.float32[::1], types.int32[::1]
CHANNELS = 4


def outputs(**counts):
    """Numba's type of ``layout.Outputs`` with so many of each."""
    kinds = [types.UniTuple(types.int64, counts.get(name, 0)) for name in layout.Outputs._fields]
    return types.NamedTuple(kinds, layout.Outputs)


#: The types that the inner loops of the sweeps are called with, but for the outputs.
FORWARD = (types.int64, types.int32, INTS, FLOATS, None, FLOATS, FLOATS)
BACKWARD = (types.int64, types.int64, types.int64, FLOATS, None, FLOATS, FLOATS, types.int64, types.int64, FLOATS)
DEPTH, SURFEL_DEPTH = outputs(channels=CHANNELS), outputs(channels=3, depth=1)
#: The inner loop of each sweep, the types it is called with, and how many multiply-adds it takes for a block of sixteen
#: pixels: five for U d and its square, five for 2^x, and those of the channels; backward has these twice, and moments.
#: For surfels six are for the intersection and the two squared distances, and the depth is one more; backward has eight
#: moments, the depth once.
INNER_LOOPS = {
    "forward": (sweep_forward._sweep_gaussians, FORWARD, DEPTH, 5 + 5 + CHANNELS),
    "backward": (sweep_backward._sweep_gaussian, BACKWARD, DEPTH, 5 + 5 + 2 * CHANNELS + 3),
    "forward, surfels": (sweep_forward._sweep_surfels, FORWARD, SURFEL_DEPTH, 6 + 5 + 3 + 1),
    "backward, surfels": (sweep_backward._sweep_surfel, BACKWARD, SURFEL_DEPTH, 6 + 5 + 2 * 3 + 1 + 7),
}


#: Processors by their vectors: LLVM's triple and name, a fused multiply-add of full registers, and floats in one.
PROCESSORS = {
    "AVX-512": ("x86_64-unknown-linux-gnu", "skylake-avx512", r"vfn?m\w+ps\s.*%zmm", 16),
    "AVX2": ("x86_64-unknown-linux-gnu", "haswell", r"vfn?m\w+ps\s.*%ymm", 8),
    "NEON, Linux": ("aarch64-unknown-linux-gnu", "neoverse-n1", r"fml[as]\s+v\d+\.4s", 4),
    "NEON, macOS": ("arm64-apple-macosx13.0.0", "apple-m1", r"fml[as]\.4s\s", 4),
}


@functools.cache
def llvm_code(sweep):
    """The inner loop of a sweep in LLVM's language, without its target."""
    loop, arguments, composited, _ = INNER_LOOPS[sweep]
    signature = tuple(composited if kind is None else kind for kind in arguments)
    alone = numba.njit(loop.py_func, error_model="numpy", no_cpython_wrapper=True, no_cfunc_wrapper=True, _nrt=False)
    alone.compile(signature)
    return re.sub("^target .*$", "", alone.inspect_llvm(signature), flags=re.MULTILINE)


@pytest.mark.parametrize(
    "processor", [pytest.param(name, marks=[] if name == "AVX2" else pytest.mark.thorough) for name in PROCESSORS]
)
@pytest.mark.parametrize("sweep", INNER_LOOPS)
def test_inner_loops_fill_the_widest_registers(sweep, processor):
    triple, name, fused, floats = PROCESSORS[processor]
    llvm.initialize_all_targets()
    llvm.initialize_all_asmprinters()
    try:
        target = llvm.Target.from_triple(triple)
    except RuntimeError:
        pytest.skip(f"this llvmlite does not translate to {triple}")
    machine = target.create_target_machine(cpu=name)
    module = llvm.parse_assembly(llvm_code(sweep))
    module.triple, module.data_layout = triple, str(machine.target_data)
    assembly = machine.emit_assembly(module)
    # Where a block takes several registers, forward's U_xx x is the same in some and computed once.
    assert len(re.findall(rf"^\s*{fused}", assembly, re.MULTILINE)) > (INNER_LOOPS[sweep][-1] - 1) * (16 // floats)
    # One number at a time, or by a function of the C library.
    scalar = r"^\s*(?:v?(?:fn?m(?:add|sub)\w*|mul|add|sub)ss|fn?m(?:add|sub|ul)\s+s\d)"
    assert not re.findall(scalar, assembly, re.MULTILINE)
    assert not re.findall(r"\b_?(?:exp2?|log2?|pow|fma)f?\b", assembly)


# --- cache ------------------------------------------------------------------------------------------------------------


def twice(number):
    return 2 * number


@pytest.fixture
def cache(tmp_path, monkeypatch, caplog):
    """The folder that kernels made in this test are kept in."""
    from coliags_plugin.core.numba_kernels import kernel_cache  # private classes of numba

    caplog.set_level(logging.INFO, kernel_cache.__name__)
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path / "cache"))
    monkeypatch.setattr(kernel_cache, "_announced", set())
    return tmp_path / "cache"


def factory(step):
    """A kernel that encloses a part."""

    @compilation.kernel
    def stepped(number):
        return step(number)

    return stepped


@compilation.part
def one_more(number):
    return number + 1


@compilation.inline
def ten_more(number):
    return number + 10


@pytest.mark.parametrize("told", ["nowhere to keep them.*NUMBA_CACHE_DIR", "cannot be written", "cannot be read"])
def test_a_cache_that_fails_costs_nothing_but_time(cache, caplog, monkeypatch, told):
    if told.startswith("nowhere"):
        monkeypatch.setattr(numba.core.caching.CacheImpl, "_locator_classes", [])
    kernel = compilation.kernel(twice)
    if told.endswith("written"):
        (folder,) = cache.iterdir()
        folder.rmdir()
        folder.write_text("a file: whatever is asked of a folder below it fails, even for root")
    if told.endswith("read"):
        kernel(4)
        for file in [path for path in cache.rglob("*") if path.is_file()]:
            file.write_bytes(file.read_bytes()[:20])
        kernel = compilation.kernel(twice)
    assert kernel(4) == 8 and factory(one_more)(4) == 5
    assert re.search(told, caplog.text, re.DOTALL)
    assert caplog.text.count("nowhere to keep them") == told.startswith("nowhere")  # once for all kernels


def test_compiled_kernels_are_kept_and_those_of_one_factory_apart(cache, caplog):
    for _ in range(2):
        kernels = [factory(step) for step in (one_more, ten_more)]
        assert [kernel(4) for kernel in kernels] == [5, 14]
    assert [sum(kernel.stats.cache_hits.values()) for kernel in kernels] == [1, 1]
    assert {record.levelname for record in caplog.records} == {"INFO"} and str(cache) in caplog.text


def run_python(code, **environment):
    """Run code in a fresh interpreter that finds the tests' scenes."""
    places = os.pathsep.join([str(Path(__file__).parent), *sys.path])
    environment = {**os.environ, "PYTHONPATH": places, **environment}
    return subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=False, timeout=600
    )


def with_another_release(expression):
    """The value of an expression of this module's names, by a process with a release of numba that is not tested."""
    code = f"""
import sys, numba
numba.__version__ = "9.9.0"
sys.modules["coliags_plugin.core.numba_kernels.kernel_cache"] = None  # its imports may fail
from tests.renderers.test_cpu_renderer_machine import *
print({expression})
"""
    process = run_python(code)
    assert process.stderr.count("none of the tested releases") == 1, process.stderr
    return process.stdout.strip()


def test_kernels_compile_with_other_releases_of_numba():
    assert with_another_release("factory(ten_more)(factory(one_more)(4))") == "15"


@pytest.mark.thorough
def test_gradients_are_the_same_with_other_releases_of_numba():
    assert with_another_release("gradient(*view()).sum().item().hex()") == gradient(*view()).sum().item().hex()


# --- threads and forks ------------------------------------------------------------------------------------------------


def view():
    """A small scene, float32."""
    gaussians, camera = scene("random")
    return cast(gaussians, torch.float32), camera.to(dtype=torch.float32)


def gradient(gaussians, camera):
    """Gradient of the means, by a graph of its own."""
    gaussians = cast(gaussians, grad=True)
    output = render_gaussians(gaussians, camera, ("depth_accumulated",), renderer=CpuRenderer)
    (output.rgb.sum() + output["depth_accumulated"].sum()).backward()
    return gaussians.means.grad


def test_two_threads_may_draw_at_once():
    seen = view()
    true = gradient(*seen)
    wrong, finished = [], []

    def draw():
        for _ in range(15):
            if not torch.equal(gradient(*seen), true):
                wrong.append(threading.current_thread().name)
        finished.append(1)

    threads = [threading.Thread(target=draw, daemon=True) for _ in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(timeout=60)
    assert len(finished) == 3
    assert not wrong


def test_views_may_wait_for_their_gradients_in_any_order():
    gaussians, camera = view()
    cameras = [camera, dataclasses.replace(camera, fx=2 * camera.fx)]
    alone = [gradient(gaussians, camera) for camera in cameras]
    gaussians = cast(gaussians, grad=True)
    outputs = [render_gaussians(gaussians, camera, ("depth_accumulated",), renderer=CpuRenderer) for camera in cameras]
    for output, expected in zip(outputs, alone, strict=True):
        gaussians.means.grad = None
        (output.rgb.sum() + output["depth_accumulated"].sum()).backward()
        assert torch.equal(gaussians.means.grad, expected)


@pytest.mark.thorough
@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork on this system")
def test_forked_processes_draw_even_where_another_thread_was_drawing():
    code = """
import os, signal, threading, torch
from tests.renderers.test_cpu_renderer_machine import gradient, view

torch.set_num_threads(2)
seen = view()  # before the fork, for torch's own threads do not survive it
true = gradient(*seen)
stop = threading.Event()

def draw():
    while not stop.is_set():
        gradient(*seen)

other = threading.Thread(target=draw)
other.start()
statuses = []
for _ in range(12):
    child = os.fork()
    if child == 0:
        signal.alarm(20)  # kills what hangs
        os._exit(0 if torch.equal(gradient(*seen), true) else 1)
    statuses.append(os.waitpid(child, 0)[1])
stop.set()
other.join()
print(statuses)
"""
    process = run_python(code)
    assert process.stdout.strip() == str([0] * 12), process.stdout + process.stderr
