"""The heap is trimmed once the process has grown by half a gibibyte."""

import ctypes
import subprocess
import sys

import pytest

# Blocks of 64 KiB, below the size from which glibc maps each apart; the last one stays, so that the heap cannot shrink.
HOLES = """
import numpy as np
from coliags_plugin.engine.heap import HeapTrimmer, resident_memory

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
    done = subprocess.run([sys.executable, "-c", HOLES], capture_output=True, text=True, check=True, timeout=120)
    of_little, of_much = map(int, done.stdout.split())
    assert of_little < 25  # of 125 MiB: the process has not grown enough
    assert of_much > 600  # of 750 MiB
