"""``coliags weights`` as a user meets it, with a server on this machine in the place of the real ones."""

from __future__ import annotations

import hashlib
import socket

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
    assert "cannot download https://raw.githubusercontent.com" in message and "--from FOLDER" in message
    for net, pair in SOURCES.items():
        assert all((published.url in message) == (net in nets) for published in pair)
    assert not [path for path in cache.rglob("*") if path.is_file()]


def test_bad_input(capsys, cache, tmp_path):
    assert "is not a folder" in refused(capsys, "weights", "lpips", "--from", tmp_path / "nothing")
    (tmp_path / "file").write_text("x")
    assert "cannot write" in refused(capsys, "weights", "lpips", "--folder", tmp_path / "file")
    assert run("weights") == 2
    assert run("weights", "lpips", "--net", "resnet") == 2
