"""NPZ and NPY files that are damaged or lie about their size."""

from __future__ import annotations

import gc
import io
import sys
import zipfile
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from coliags_plugin.core.arrays import read_array, read_arrays
from coliags_plugin.core.errors import InputError

EXPECTED = "an NPZ file with an array 'positions'"


def npz_bytes(compressed=False, **arrays):
    data = io.BytesIO()
    (np.savez_compressed if compressed else np.savez)(data, **arrays)
    return data.getvalue()


def test_wanted_arrays_come_back(tmp_path):
    path = tmp_path / "a.npz"
    path.write_bytes(npz_bytes(one=np.arange(6).reshape(2, 3), two=np.array(1.5), three=np.array("text")))
    assert read_arrays(path, EXPECTED, ["one"])["one"].tolist() == [[0, 1, 2], [3, 4, 5]]
    assert list(read_arrays(path, EXPECTED, ["one"], ["two", "nine"])) == ["one", "two"]
    assert list(read_arrays(path, EXPECTED, optional=None)) == ["one", "two", "three"]
    with pytest.raises(InputError, match=r"a\.npz lacks nine"):
        read_arrays(path, EXPECTED, ["one", "nine"])


def test_an_archive_that_expands_enormously_is_refused_before_it_does(tmp_path):
    path = tmp_path / "bomb.npz"
    path.write_bytes(npz_bytes(compressed=True, positions=np.zeros((3_000_000, 3), np.float64)))
    assert path.stat().st_size < 1_000_000
    with pytest.raises(InputError, match=r"expands to 72,000,\d\d\d"):
        read_arrays(path, EXPECTED, ["positions"])


def test_what_is_no_array_is_refused(tmp_path):
    np.savez(tmp_path / "objects.npz", positions=np.array([{}], object))
    np.save(tmp_path / "objects.npy", np.array([{}], object))
    with zipfile.ZipFile(tmp_path / "text.npz", "w") as archive:
        archive.writestr("positions", b"text")
    # A header that promises more than follows reserves nothing.
    header = b"{'descr': '<f8', 'fortran_order': False, 'shape': (100000, 1000000), }"
    (tmp_path / "short.npy").write_bytes(
        b"\x93NUMPY\x01\x00" + (len(header)).to_bytes(2, "little") + header + bytes(100)
    )
    for name in ("objects.npz", "objects.npy", "text.npz", "short.npy"):
        message = "'positions', which is no array" if name == "text.npz" else "cannot read"
        with pytest.raises(InputError, match=message):
            read_array(tmp_path / name, EXPECTED) if name.endswith("npy") else read_arrays(
                tmp_path / name, EXPECTED, ["positions"]
            )


@settings(max_examples=150, deadline=None)
@given(data=st.data())
def test_any_damage_is_an_input_error(data, tmp_path_factory):
    path = tmp_path_factory.getbasetemp() / "damaged.npz"
    whole = npz_bytes(compressed=data.draw(st.booleans()), positions=np.arange(300.0).reshape(100, 3))
    spoiled = bytearray(whole)
    for _ in range(data.draw(st.integers(1, 4))):
        spoiled[data.draw(st.integers(0, len(whole) - 1))] = data.draw(st.integers(0, 255))
    path.write_bytes(spoiled[: data.draw(st.integers(0, len(whole)))] if data.draw(st.booleans()) else spoiled)
    try:
        arrays = read_arrays(path, EXPECTED, ["positions"])
    except InputError:
        return
    assert arrays["positions"].nbytes <= 64 << 20


class _Collected:
    """Garbage whose collection lets other threads run."""

    def __init__(self):
        self.me = self

    def __del__(self):
        for _ in range(20):
            pass


@pytest.fixture
def restless_threads():
    """Threads that take turns as often as they can, while garbage is collected all the time."""
    interval, threshold = sys.getswitchinterval(), gc.get_threshold()
    sys.setswitchinterval(1e-6)
    gc.set_threshold(50)
    yield
    sys.setswitchinterval(interval)
    gc.set_threshold(*threshold)


@pytest.mark.usefixtures("restless_threads")
def test_threads_read_at_once(tmp_path):
    np.save(tmp_path / "a.npy", np.arange(12.0))
    np.savez(tmp_path / "a.npz", one=np.arange(12.0))

    def read(_):
        _Collected()
        array = read_array(tmp_path / "a.npy", EXPECTED)
        return float(array.sum() + read_arrays(tmp_path / "a.npz", EXPECTED, ["one"])["one"].sum())

    with ThreadPoolExecutor(8) as pool:
        assert set(pool.map(read, range(500))) == {132.0}
