"""What is said where triton cannot launch kernels."""

import shutil
import sys
import sysconfig
from importlib.util import find_spec
from types import SimpleNamespace

import pytest

from coliags_plugin.core import tables


@pytest.fixture
def lacks(monkeypatch):
    monkeypatch.setattr(tables, "find_spec", lambda name: object())
    monkeypatch.setitem(sys.modules, "triton", SimpleNamespace(__version__="3.10.0"))
    monkeypatch.delenv("CC", raising=False)
    return tables.what_triton_lacks.__wrapped__


def test_what_triton_lacks_is_said(lacks, monkeypatch, tmp_path):
    (tmp_path / "Python.h").touch()
    monkeypatch.setattr(sysconfig, "get_paths", lambda scheme: {"include": str(tmp_path)})
    monkeypatch.setattr(shutil, "which", lambda name: None)
    assert "no C compiler" in lacks() and "gcc" in lacks()
    monkeypatch.setenv("CC", "cc")
    assert lacks() is None
    (tmp_path / "Python.h").unlink()
    assert "headers of Python" in lacks()
    monkeypatch.setitem(sys.modules, "triton", SimpleNamespace(__version__="3.5.1"))
    assert "triton 3.5.1 is older than 3.6" in lacks()
    monkeypatch.setattr(tables, "find_spec", lambda name: None)
    assert "triton is not installed" in lacks()


@pytest.mark.skipif(find_spec("triton") is None, reason="triton is not installed")
def test_a_compiler_is_sought_where_triton_seeks_it(monkeypatch):
    from triton.runtime import build

    monkeypatch.delenv("CC", raising=False)
    monkeypatch.setattr(shutil, "which", {"clang": "clang"}.get)
    build._find_compiler.cache_clear()
    assert build._find_compiler("c") == "clang"
    monkeypatch.setattr(shutil, "which", lambda name: None)
    build._find_compiler.cache_clear()
    with pytest.raises(RuntimeError, match="C compiler"):
        build._find_compiler("c")
    build._find_compiler.cache_clear()
