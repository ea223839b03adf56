"""Downloads from a server on this machine: whole, in parts, and with everything that may go wrong on the way."""

from __future__ import annotations

import ast
import hashlib
import os
import random
import socket
import threading
from pathlib import Path

import pytest

from coliags_plugin.core import download as module
from coliags_plugin.core.checksums import file_sha256
from coliags_plugin.core.download import download
from coliags_plugin.core.errors import InputError
from coliags_plugin.engine.progress import progress_callback
from tests.faults import largest_file
from tests.file_server import file_server

DATA = random.Random(0).randbytes(300_000)
DIGEST = hashlib.sha256(DATA).hexdigest()
PATH = "/models/net.pth"


@pytest.fixture
def server(monkeypatch):
    for name in ("http_proxy", "https_proxy", "all_proxy", "HTTP_PROXY", "HTTPS_PROXY", "ALL_PROXY"):
        monkeypatch.delenv(name, raising=False)
    with file_server() as server:
        server.files[PATH] = DATA
        yield server


@pytest.fixture
def target(tmp_path):
    return tmp_path / "cache" / "net.pth"


@pytest.fixture
def part(target):
    return target.with_name("net.pth.part")


def fetch(server, target, sha256=DIGEST, progress=lambda *_: None, path=PATH):
    download(server.url + path, target, sha256, progress, "Ask a friend")


def refusal(server, target, **options) -> str:
    with pytest.raises(InputError) as caught:
        fetch(server, target, **options)
    return str(caught.value)


def put(part, data):
    part.parent.mkdir(parents=True, exist_ok=True)
    part.write_bytes(data)


def names(target):
    return sorted(path.name for path in target.parent.iterdir())


# Whole files


@pytest.mark.parametrize(("digits", "lengths"), [(8, True), (64, True), (64, False)])
def test_a_file_arrives_under_its_name_alone(server, target, digits, lengths):
    """The first digits of the checksum are enough; answers need not tell their length."""
    server.lengths = lengths
    fetch(server, target, sha256=DIGEST[:digits])
    assert target.read_bytes() == DATA
    assert names(target) == ["net.pth"]
    assert server.requests == [("GET", PATH, None)]
    assert server.agents == {f"coliags_plugin/{module.__version__}"}


def test_a_file_that_is_there_is_left_alone(server, target):
    put(target, b"mine")
    fetch(server, target)
    assert target.read_bytes() == b"mine"
    assert names(target) == ["net.pth"]
    assert not server.requests


@pytest.mark.parametrize(
    ("size", "kept", "total"), [(10, 0, 1), (1 << 20, 0, 1), ((5 << 20) + 1, 0, 6), (3 << 20, 2, 3)]
)
def test_progress_is_told_in_mib(server, target, part, size, kept, total):
    server.files[PATH] = bytes(size)
    put(part, bytes(kept << 20))
    told = []
    fetch(server, target, hashlib.sha256(bytes(size)).hexdigest(), lambda *what: told.append(what))
    assert {(title, end) for title, _, end in told} == {("net.pth, MiB", total)}
    counts = [done for _, done, _ in told]
    assert counts == sorted(counts)
    assert set(counts) >= set(range(kept + 1, total + 1))
    assert counts.count(total) == 1


def test_progress_is_shown_by_the_project_s_reports(server, target, capsys):
    with progress_callback() as progress:
        fetch(server, target, progress=progress)
    assert capsys.readouterr().err.startswith("net.pth, MiB 1/1")


# Parts of files


@pytest.mark.parametrize("reset", [False, True])
def test_a_broken_transfer_is_kept_and_only_the_rest_is_fetched(server, target, part, reset):
    server.cuts, server.reset = [100_000], reset
    message = refusal(server, target)
    assert "Run the command again: it goes on from there" in message
    if reset and not part.exists():  # nothing had been read
        return
    kept = part.read_bytes()
    assert f"the connection broke after {len(kept)} bytes of 300000" in message
    assert names(target) == ["net.pth.part"]
    assert DATA.startswith(kept)
    server.sent = 0
    fetch(server, target)
    assert target.read_bytes() == DATA
    assert names(target) == ["net.pth"]
    assert server.requests[1:] == [("GET", PATH, f"bytes={len(kept)}-")]
    assert server.sent == len(DATA) - len(kept)


def test_any_number_of_cuts_ends_with_the_file(server, target):
    server.cuts = [0, 1, 0, 70_000, 65_536, 99_999]
    for _ in range(6):
        refusal(server, target)
        assert not target.exists()
    fetch(server, target)
    assert target.read_bytes() == DATA


def test_nothing_is_left_where_nothing_arrived(server, target):
    server.cuts = [0]
    refusal(server, target)
    assert names(target) == []


@pytest.mark.parametrize(
    ("kept", "answers", "requests"),
    [
        pytest.param(DATA, {}, [], id="all of it"),
        pytest.param(DATA[:5], {}, ["bytes=5-"], id="a part"),
        pytest.param(DATA[:9], {"ranges": False}, ["bytes=9-"], id="a server without ranges"),
        pytest.param(DATA[:100], {"shift": 10}, ["bytes=100-", None], id="a server that sends another part"),
        pytest.param(bytes(300_000), {}, ["bytes=300000-", None], id="another file of the same size"),
        pytest.param(DATA + b"more", {}, ["bytes=300004-", None], id="more than the file"),
    ],
)
def test_what_is_there_is_continued_or_fetched_again(server, target, part, kept, answers, requests):
    vars(server).update(answers)
    put(part, kept)
    fetch(server, target)
    assert target.read_bytes() == DATA
    assert names(target) == ["net.pth"]
    assert server.requests == [("GET", PATH, ranges) for ranges in requests]


def test_a_file_that_has_moved(server, target, part):
    server.moved["/old"] = PATH
    put(part, DATA[:5])
    fetch(server, target, path="/old")
    assert target.read_bytes() == DATA
    assert server.requests == [("GET", "/old", "bytes=5-"), ("GET", PATH, "bytes=5-")]


def test_a_wrong_part_does_not_get_the_name(server, target, part):
    put(part, b"of another file")
    message = refusal(server, target)
    assert f"SHA-256 {hashlib.sha256(b'of another file' + DATA[15:]).hexdigest()}" in message
    assert names(target) == []
    fetch(server, target)
    assert target.read_bytes() == DATA


def test_an_interruption_keeps_what_arrived(server, target, part):
    server.files[PATH] = data = DATA * 8

    def interrupt(title, done, total):
        if done >= 1:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fetch(server, target, progress=interrupt)
    kept = part.stat().st_size
    assert 1 << 20 <= kept < len(data)
    fetch(server, target, hashlib.sha256(data).hexdigest())
    assert target.read_bytes() == data
    assert server.requests[1] == ("GET", PATH, f"bytes={kept}-")


# Faults


@pytest.mark.parametrize(
    ("expected", "said"), [("ab" * 32, "Expected " + "ab" * 32), ("abcd1234", "begins with abcd1234")]
)
def test_a_wrong_checksum_is_told_and_nothing_is_kept(server, target, expected, said):
    message = refusal(server, target, sha256=expected)
    assert DIGEST in message and said in message and "was removed" in message
    assert names(target) == []


@pytest.mark.parametrize(("status", "words"), [(404, "404 Not Found"), (503, "503 Service")])
def test_a_server_s_refusal_keeps_the_part(server, target, part, status, words):
    put(part, DATA[:7])
    server.statuses[PATH] = status
    message = refusal(server, target)
    assert words in message and PATH in message and "Ask a friend" in message
    assert part.read_bytes() == DATA[:7]
    assert names(target) == ["net.pth.part"]


def test_no_connection(server, target, monkeypatch):
    with socket.socket() as closed:
        closed.bind(("127.0.0.1", 0))
        server.url = f"http://127.0.0.1:{closed.getsockname()[1]}"
        message = refusal(server, target)
    assert message.startswith(f"no connection to {server.url[7:]}: ") and "refused" in message
    assert message.endswith("Ask a friend.")
    assert names(target) == []

    def unknown(*args, **options):
        raise socket.gaierror(socket.EAI_NONAME, "Name or service not known")

    monkeypatch.setattr(socket, "getaddrinfo", unknown)
    server.url = "https://weights.invalid"
    message = refusal(server, target)
    assert message.startswith("no connection to weights.invalid: ") and "Name or service not known" in message


def test_a_server_that_falls_silent(server, target, part, monkeypatch):
    monkeypatch.setattr(module, "TIMEOUT", 0.2)
    server.cuts, server.go_on = [65_536], threading.Event()
    assert "the connection broke after 65536 bytes of 300000" in refusal(server, target)
    assert part.read_bytes() == DATA[:65_536]


def test_something_that_is_no_web_server(server, target):
    with socket.create_server(("127.0.0.1", 0)) as other:

        def answer():
            connection, _ = other.accept()
            with connection:
                connection.recv(1000)
                connection.sendall(b"220 mail.example ESMTP\r\n")

        thread = threading.Thread(target=answer)
        thread.start()
        server.url = f"http://127.0.0.1:{other.getsockname()[1]}"
        assert "no connection to 127.0.0.1" in refusal(server, target)
        thread.join()


def test_the_proxy_of_the_environment_is_asked(server, target, monkeypatch):
    monkeypatch.setenv("https_proxy", server.url)
    for name in ("no_proxy", "NO_PROXY"):
        monkeypatch.delenv(name, raising=False)
    server.url = "https://weights.invalid"
    assert "502" in refusal(server, target)
    assert server.requests == [("CONNECT", "weights.invalid:443", None)]


@pytest.mark.parametrize("room", [100_000, len(DATA) - 1])
def test_a_full_disk_keeps_what_fitted(server, target, part, room):
    with largest_file(room):
        message = refusal(server, target)
    assert f"cannot write to {target.parent}: File too large" in message
    assert part.read_bytes() == DATA[:room]
    fetch(server, target)
    assert target.read_bytes() == DATA
    assert server.requests[1] == ("GET", PATH, f"bytes={room}-")


@pytest.mark.parametrize("fault", ["file for a folder", "folder for the part", "folder that is locked"])
def test_a_folder_that_cannot_be_written(server, target, part, tmp_path, fault):
    if fault == "file for a folder":
        (tmp_path / "cache").write_text("x")
    elif fault == "folder for the part":
        part.mkdir(parents=True)
    elif os.geteuid() == 0:
        pytest.skip("root may write anywhere")
    else:
        (tmp_path / "cache").mkdir(mode=0o555)
    assert f"cannot write to {tmp_path / 'cache'}" in refusal(server, target)
    assert not server.requests


# Two at once


def test_a_second_process_is_refused(server, target):
    server.cuts, server.go_on = [100_000], threading.Event()
    arrived = threading.Event()
    first = threading.Thread(target=fetch, args=(server, target, DIGEST, lambda *_: arrived.set()))
    first.start()
    assert arrived.wait(10)
    assert f"net.pth.part is in use by process {os.getpid()}" in refusal(server, target)
    server.go_on.set()
    first.join()
    assert target.read_bytes() == DATA
    assert len(server.requests) == 1


# The package


def test_checksum_of_a_file_that_cannot_be_read(tmp_path):
    with pytest.raises(InputError, match="cannot read"):
        file_sha256(tmp_path)


@pytest.mark.thorough
def test_nothing_else_in_the_package_reaches_for_the_network():
    package = Path(module.__file__).parents[1]
    users = set()
    for path in package.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            imported = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            imported += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            roots = {name.partition(".")[0] for name in imported if name != "urllib.parse"}
            if roots & {"urllib", "http", "socket", "requests", "pooch", "ftplib"}:
                users.add(path.relative_to(package).as_posix())
            if isinstance(node, ast.ImportFrom) and node.module == "coliags_plugin.core.download":
                assert path.name == "lpips_install.py"
    # The executor only asks whether the cluster that the user named answers, the viewer whether its own port is free.
    assert users == {"core/download.py", "execution/ray_executor.py", "export/viewer/serving.py"}
