"""Costs of training and rendering: sums over resumptions, and marks of quality; names of devices."""

from __future__ import annotations

import ctypes
import subprocess
import sys
from pathlib import Path
from statistics import fmean
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st

from coliags_plugin.comparison.compare import make_executor
from coliags_plugin.core.errors import InputError
from coliags_plugin.engine import costs
from coliags_plugin.engine.costs import PSNR_MARKS, CostMeter, RenderMeter, TrainingCost, seconds_to_psnr
from coliags_plugin.engine.devices import choose_device, device_name, find_device
from coliags_plugin.engine.tasks import ExecutionOptions
from tests.engine.test_trainer import final_state, interfere, kill, log_rows, make_trainer

CPU = torch.device("cpu")


class Clocks:
    """Clocks that are set by hand."""

    wall = processor = 0.0

    def __call__(self):
        return self.wall, self.processor

    def go_on(self, wall, processor):
        self.wall += wall
        self.processor += processor


@pytest.fixture
def clocks(monkeypatch):
    set_by_hand = Clocks()
    monkeypatch.setattr(costs, "_clocks", set_by_hand)
    return set_by_hand


# The meter


def test_only_what_runs_is_counted(clocks):
    meter = CostMeter(CPU)
    assert meter.cost() is None and meter.seconds == 0.0
    clocks.go_on(100, 100)
    with meter.running():
        clocks.go_on(3, 5)
        assert meter.seconds == 3.0 and meter.cost().processor_seconds == 5.0
        clocks.go_on(1, 1)
    clocks.go_on(100, 100)
    with meter.running():
        clocks.go_on(2, 2)
    assert (meter.cost().seconds, meter.cost().processor_seconds) == (6.0, 8.0)
    assert meter.cost().device == device_name(CPU) and meter.cost().threads == torch.get_num_threads()
    resumed = CostMeter(CPU, TrainingCost(device="old", seconds=10.0, processor_seconds=20.0, peak_memory_mib=1e9))
    with resumed.running():
        clocks.go_on(3, 5)
    total = resumed.cost()
    assert (total.seconds, total.processor_seconds, total.peak_memory_mib) == (13.0, 25.0, 1e9)


def test_the_peak_holds_what_is_allocated():
    before = costs.peak_memory_mib(CPU)
    block = np.ones(64 * 2**20 + int(before * 2**20) - costs.resident_memory(), dtype=np.uint8)
    after = costs.peak_memory_mib(CPU)
    assert 55 < after - before < 120
    del block
    assert costs.peak_memory_mib(CPU) == pytest.approx(after, abs=1.0), "a peak does not fall"


def test_without_proc_the_peak_is_that_of_getrusage(monkeypatch):
    peak = costs.peak_memory_mib(CPU)
    monkeypatch.setattr(costs, "Path", lambda path: Path("no such file"))
    assert costs.peak_memory_mib(CPU) >= peak * 0.99
    monkeypatch.setitem(sys.modules, "resource", None)
    assert costs.peak_memory_mib(CPU) is None


# In a run


def test_the_cost_of_a_resumed_run_goes_on_from_its_checkpoint(tmp_path, clocks):
    """Stopped at 4 of 8 steps; two more steps were taken and lost."""
    first = make_trainer(tmp_path / "run", steps=8, overrides=["schedule.checkpoint_every=4"])
    first.start()
    interfere(first, lambda step: clocks.go_on(1, 2))
    kill(first, 6)
    with pytest.raises(RuntimeError, match="killed"):
        first.train()
    assert first.seconds == 6.0
    assert final_state(first).cost.seconds == 4.0 and final_state(first).step == 4
    second = make_trainer(tmp_path / "run", steps=8, overrides=["schedule.checkpoint_every=4"])
    second.resume()
    assert second.seconds == 4.0, "lost steps are not counted"
    clocks.go_on(1000, 1000)
    interfere(second, lambda step: clocks.go_on(1, 2))
    second.train()
    measured = final_state(second).cost
    assert (measured.seconds, measured.processor_seconds) == (8.0, 16.0)
    assert [row["seconds"] for row in log_rows(second)] == [1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0]


# Rendering


def test_the_first_view_counts_only_where_it_is_alone(monkeypatch):
    now = iter([0.0, 10.0, 20.0, 20.5, 30.0, 30.1, 40.0, 40.4])
    monkeypatch.setattr(costs.time, "perf_counter", lambda: next(now))
    meter, output = RenderMeter(CPU), SimpleNamespace(splats=None)
    assert meter.fps is None and meter.gaussians is None
    assert meter.render(lambda: output) is output
    assert meter.fps == 0.1
    for _ in range(3):
        meter.render(lambda: output)
    assert meter.fps == pytest.approx(1 / 0.4) and meter.gaussians is None


def test_gaussians_that_were_not_drawn_do_not_count():
    meter = RenderMeter(CPU)
    for radii in ([1.0, 0.0, 3.0], [0.0, 0.0, 2.0]):
        meter.render(lambda radii=radii: SimpleNamespace(splats=SimpleNamespace(radii=torch.tensor(radii))))
    assert meter.gaussians == 1.5


# Marks of quality


@settings(max_examples=50, deadline=None)
@example(psnr=[10.0, 12.0, 35.0, 35.42402470117271, 36.0], frames=1, every=1)
@given(psnr=st.lists(st.floats(10, 50), max_size=60), frames=st.integers(1, 25), every=st.integers(1, 12))
def test_marks_agree_with_means_taken_one_by_one(psnr, frames, every):
    steps = [every * index for index in range(1, len(psnr) + 1)]
    rows = [{"step": step, "psnr": value, "seconds": 2.0 * step} for step, value in zip(steps, psnr, strict=True)]
    expected = dict.fromkeys(map(str, PSNR_MARKS)) if rows else {}
    for row in rows:
        window = [other["psnr"] for other in rows if row["step"] - frames < other["step"] <= row["step"]]
        for mark in PSNR_MARKS:
            if row["step"] >= frames and expected[str(mark)] is None and fmean(window) >= mark:
                expected[str(mark)] = row["seconds"]
    assert seconds_to_psnr(rows, frames) == expected


# Blocks of 64 KiB, below the size from which glibc maps each apart; the last one stays, so that the heap cannot shrink.
HOLES = """
import numpy as np
from coliags_plugin.engine.costs import HeapTrimmer, resident_memory

heap, kept = HeapTrimmer(), []
for count in (2_000, 12_000):
    blocks = [np.ones(8_192) for _ in range(count)]
    kept.append(blocks[-1])
    del blocks
    before = resident_memory()
    heap.trim_if_grown()
    print((before - resident_memory()) // 2**20)
"""


@pytest.mark.skipif(
    sys.platform != "linux" or not hasattr(ctypes.CDLL(None), "malloc_trim"), reason="the C library has no malloc_trim"
)
def test_freed_memory_is_given_back_when_the_process_has_grown():
    process = subprocess.run([sys.executable, "-c", HOLES], capture_output=True, text=True, check=True, timeout=120)
    of_little, of_much = map(int, process.stdout.split())
    assert of_little < 25  # of 125 MiB: the process has not grown enough
    assert of_much > 600  # of 750 MiB


# Names of devices, and which device kernels are launched on


@pytest.fixture
def cards(monkeypatch):
    """Says how many CUDA devices there are; the list of those that were made current."""
    current = []
    monkeypatch.setattr(torch.cuda, "set_device", current.append)
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda index: f"card {index}")

    def there_are(count):
        monkeypatch.setattr(torch.cuda, "is_available", lambda: count > 0)
        monkeypatch.setattr(torch.cuda, "device_count", lambda: count)
        return current

    return there_are


def test_names_of_devices(cards):
    current = cards(2)
    named = {name: str(find_device(name)) for name in ("auto", "cpu", "cuda", "cuda:0", "cuda:1")}
    assert named == {"auto": "cuda:0", "cpu": "cpu", "cuda": "cuda:0", "cuda:0": "cuda:0", "cuda:1": "cuda:1"}
    assert current == []
    assert choose_device("cuda:1") == torch.device("cuda", 1) and choose_device("cpu") == CPU
    assert current == [torch.device("cuda", 1)]


def test_a_device_that_is_not_there(cards):
    cards(2)
    for name in ("gpu", "cuda:", "cuda:-1", "cuda:x", "cuda1", "mps", "CUDA", ""):
        with pytest.raises(InputError, match="auto, cpu, cuda or cuda:N"):
            find_device(name)
    with pytest.raises(InputError, match=r"cuda:1` with `executor=ray.*Ray gives each run its GPU"):
        make_executor(ExecutionOptions(device="cuda:1", executor="ray"))
    with pytest.raises(InputError, match=r"cuda:2 .*torch finds cuda:0 \(card 0\), cuda:1 \(card 1\)\. Expected one"):
        find_device("cuda:2")
    cards(0)
    assert find_device("auto") == find_device("cpu") == CPU
    for name in ("cuda", "cuda:0", "cuda:1"):
        with pytest.raises(InputError, match="torch finds none"):
            find_device(name)


@pytest.mark.parametrize(
    ("visible", "device", "gpus"),
    [
        (None, "auto", ("0", "1", "2")),
        (None, "cpu", ()),
        (None, "cuda:0", ("0",)),
        (None, "cuda:2", ("2",)),
        ("4,7,GPU-b", "cuda", ("4", "7", "GPU-b")),
        ("4,7,GPU-b", "cuda:1", ("7",)),
        ("4,7,GPU-b,99", "auto", ("4", "7", "GPU-b")),  # CUDA stops at the first that is not there
    ],
)
def test_a_comparison_uses_every_gpu_or_the_named_one(cards, monkeypatch, visible, device, gpus):
    cards(3)
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES", raising=False)
    if visible is not None:
        monkeypatch.setenv("CUDA_VISIBLE_DEVICES", visible)
    executor = make_executor(ExecutionOptions(device=device))
    assert executor._gpus == gpus
    if gpus:
        assert executor.slots == len(gpus)
