"""``coliags weights`` as a user meets it, with a server on this machine in the place of the real ones."""

from __future__ import annotations

import hashlib
import signal
import socket
import subprocess
import sys
import threading
import time

import pytest

from coliags_plugin.metrics import lpips_weights
from coliags_plugin.metrics.lpips_install import SOURCES, Published
from tests.commands import refused, run
from tests.file_server import file_server
from tests.metrics.weight_files import lay_out

NAMES = ("squeezenet1_1-b8a52dc0.pth", "v0.1/squeeze.pth")


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    folder = tmp_path_factory.mktemp("published")
    lay_out(folder, "squeeze")
    return folder


@pytest.fixture
def cache(monkeypatch, tmp_path):
    """torch's download cache, on a machine without weights."""
    monkeypatch.setenv("TORCH_HOME", str(tmp_path / "torch"))
    monkeypatch.delenv(lpips_weights.WEIGHTS_VARIABLE, raising=False)
    monkeypatch.setattr(lpips_weights, "find_spec", lambda name: None)
    for name in ("http_proxy", "https_proxy", "all_proxy", "HTTP_PROXY", "HTTPS_PROXY", "ALL_PROXY"):
        monkeypatch.delenv(name, raising=False)
    return tmp_path / "torch" / "hub" / "checkpoints"


@pytest.fixture
def server(made, cache, monkeypatch):
    with file_server() as server:
        files = [(name, (made / name).read_bytes()) for name in NAMES]
        server.files = {f"/{name}": data for name, data in files}
        pair = [Published(f"{server.url}/{name}", {hashlib.sha256(data).hexdigest(): name}) for name, data in files]
        monkeypatch.setitem(SOURCES, "squeeze", tuple(pair))
        yield server


def test_a_newcomer_s_way(server, cache, capsys):
    """doctor names the command, which installs; then both say that all is there, and where."""
    assert run("doctor") == 0
    (line,) = [line for line in capsys.readouterr().out.splitlines() if "weights of LPIPS squeeze" in line]
    assert line.startswith("-  ") and "run `coliags weights lpips`" in line
    where = f"LPIPS squeeze: backbone {cache / NAMES[0]}, linear heads {cache / NAMES[1]}\n"
    assert run("weights", "lpips", "--net", "squeeze") == 0
    assert capsys.readouterr().out == where
    assert run("weights", "lpips", "--net", "squeeze") == 0
    assert capsys.readouterr().out == f"{where}Everything was there already.\n"
    assert len(server.requests) == 2
    assert run("doctor") == 0
    (line,) = [line for line in capsys.readouterr().out.splitlines() if "weights of LPIPS squeeze" in line]
    assert line.startswith("ok ") and line.endswith(f"{cache / NAMES[0]} and {cache / NAMES[1]}")


def test_a_folder_that_lpips_does_not_search_says_what_to_set(server, cache, made, tmp_path, monkeypatch, capsys):
    argv = ("weights", "lpips", "--net", "squeeze", "--from", made, "--folder", tmp_path / "mine")
    assert run(*argv) == 0
    assert f"Set COLIAGS_LPIPS_WEIGHTS={tmp_path / 'mine'} " in capsys.readouterr().out
    monkeypatch.setenv("COLIAGS_LPIPS_WEIGHTS", str(tmp_path / "mine"))
    assert run(*argv) == 0
    assert "Set COLIAGS" not in capsys.readouterr().out
    assert lpips_weights.find_weights("squeeze") == (tmp_path / "mine" / NAMES[0], tmp_path / "mine" / NAMES[1])
    assert not server.requests


@pytest.fixture
def offline(cache, monkeypatch):
    def unknown(*args, **options):
        raise socket.gaierror(socket.EAI_NONAME, "Name or service not known")

    monkeypatch.setattr(socket, "getaddrinfo", unknown)


@pytest.mark.parametrize(
    ("choice", "nets"),
    [([], ["vgg", "squeeze"]), (["--net", "alex"], ["alex"]), (["--net", "all"], ["vgg", "alex", "squeeze"])],
)
def test_offline_all_files_of_the_nets_are_named(offline, cache, capsys, choice, nets):
    message = refused(capsys, "weights", "lpips", *choice)
    assert "no connection to raw.githubusercontent.com" in message and "--from FOLDER" in message
    for net, pair in SOURCES.items():
        assert all((published.url in message) == (net in nets) for published in pair)
    assert not [path for path in cache.rglob("*") if path.is_file()]


def test_bad_input(capsys, cache, tmp_path):
    assert "is not a folder" in refused(capsys, "weights", "lpips", "--from", tmp_path / "nothing")
    (tmp_path / "file").write_text("x")
    assert "cannot write" in refused(capsys, "weights", "lpips", "--folder", tmp_path / "file")
    assert run("weights") == 2
    assert run("weights", "lpips", "--net", "resnet") == 2


@pytest.mark.thorough
def test_ctrl_c_keeps_what_arrived(server, cache):
    server.cuts, server.go_on = [20_000_000, 1_000_000], threading.Event()
    code = f"""
import signal
signal.signal(signal.SIGINT, signal.default_int_handler)  # ignored by processes that a shell starts in the background
from coliags_plugin.cli import main
from coliags_plugin.metrics.lpips_install import SOURCES, Published
SOURCES["squeeze"] = {SOURCES["squeeze"]!r}
main(["weights", "lpips", "--net", "squeeze"])
"""
    process = subprocess.Popen([sys.executable, "-c", code], stderr=subprocess.PIPE, text=True)
    part = cache / f"{NAMES[0]}.part"
    deadline = time.monotonic() + 60
    while time.monotonic() < deadline and not (part.is_file() and part.stat().st_size >= 900_000):
        time.sleep(0.02)
    process.send_signal(signal.SIGINT)
    _, message = process.communicate(timeout=60)
    assert process.returncode == 130
    assert "coliags: interrupted" in message and "Traceback" not in message
    assert not (cache / NAMES[0]).exists()
    kept = part.stat().st_size
    assert 900_000 <= kept <= 1_000_000
    assert run("weights", "lpips", "--net", "squeeze") == 0
    assert server.requests[-1] == ("GET", f"/{NAMES[0]}", f"bytes={kept}-")
    assert (cache / NAMES[0]).read_bytes() == server.files[f"/{NAMES[0]}"]
    assert not part.exists()
