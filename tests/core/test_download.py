"""Downloads from a server on this machine: whole, in parts, and with everything that may go wrong on the way."""

from __future__ import annotations

import ast
import hashlib
import os
import random
import resource
import socket
import threading
from pathlib import Path

import pytest

from coliags_plugin.core import download as module
from coliags_plugin.core.checksums import file_sha256
from coliags_plugin.core.download import download
from coliags_plugin.core.errors import InputError
from coliags_plugin.engine.progress import progress_callback
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
    return [path.name for path in target.parent.iterdir()]


# Whole files


def test_a_file_arrives_under_its_name_alone(server, target):
    fetch(server, target)
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


@pytest.mark.parametrize("digits", [8, 64])
def test_the_first_digits_of_the_checksum_are_enough(server, target, digits):
    fetch(server, target, sha256=DIGEST[:digits])
    assert target.read_bytes() == DATA


def test_an_answer_without_length(server, target):
    server.lengths = False
    fetch(server, target)
    assert target.read_bytes() == DATA


def test_a_file_that_has_moved(server, target, part):
    server.moved["/old"] = PATH
    put(part, DATA[:5])
    fetch(server, target, path="/old")
    assert target.read_bytes() == DATA
    assert server.requests == [("GET", "/old", "bytes=5-"), ("GET", PATH, "bytes=5-")]


@pytest.mark.parametrize(("size", "total"), [(10, 1), (1 << 20, 1), ((5 << 20) + 1, 6)])
def test_progress_is_told_in_mib(server, target, size, total):
    server.files[PATH] = bytes(size)
    told = []
    fetch(server, target, hashlib.sha256(bytes(size)).hexdigest(), lambda *what: told.append(what))
    assert {(title, end) for title, _, end in told} == {("net.pth, MiB", total)}
    counts = [done for _, done, _ in told]
    assert counts == sorted(counts)
    assert sorted(set(counts)) == list(range(0, total + 1))
    assert counts.count(total) == 1


def test_progress_is_shown_by_the_project_s_reports(server, target, capsys):
    with progress_callback() as progress:
        fetch(server, target, progress=progress)
    assert capsys.readouterr().err.startswith("net.pth, MiB 1/1")


# Parts of files


def test_a_cut_transfer_is_kept_and_only_the_rest_is_fetched(server, target, part):
    server.cuts = [100_000]
    message = refusal(server, target)
    assert "the connection broke after 100000 bytes of 300000" in message
    assert "Run the command again: it goes on from there" in message
    assert names(target) == ["net.pth.part"]
    assert part.read_bytes() == DATA[:100_000]
    server.sent = 0
    fetch(server, target)
    assert target.read_bytes() == DATA
    assert names(target) == ["net.pth"]
    assert server.requests[1:] == [("GET", PATH, "bytes=100000-")]
    assert server.sent == 200_000


def test_a_reset_connection_keeps_what_was_read(server, target, part):
    server.cuts, server.reset, server.go_on = [100_000], True, threading.Event()

    def reset(title, done, total):
        if part.stat().st_size >= 1 << 16:
            server.go_on.set()

    assert "Connection reset by peer)" in refusal(server, target, progress=reset)
    kept = part.read_bytes()
    assert len(kept) >= 1 << 16 and DATA.startswith(kept)
    fetch(server, target)
    assert target.read_bytes() == DATA


def test_any_number_of_cuts_ends_with_the_file(server, target):
    server.cuts = [0, 1, 0, 70_000, 65_536, 99_999]
    for _ in range(6):
        refusal(server, target)
        assert not target.exists()
    fetch(server, target)
    assert target.read_bytes() == DATA
    assert server.sent == len(DATA)


def test_nothing_is_left_where_nothing_arrived(server, target):
    server.cuts = [0]
    refusal(server, target)
    assert names(target) == []


def test_a_server_that_sends_no_parts_begins_again(server, target, part):
    put(part, DATA[:100_000])
    server.ranges = False
    fetch(server, target)
    assert target.read_bytes() == DATA
    assert server.requests == [("GET", PATH, "bytes=100000-")]
    assert server.sent == len(DATA)


def test_a_server_that_sends_another_part_begins_again(server, target, part):
    put(part, DATA[:100_000])
    server.shift = 10
    fetch(server, target)
    assert target.read_bytes() == DATA
    assert server.requests == [("GET", PATH, "bytes=100000-"), ("GET", PATH, None)]


def test_a_whole_part_is_not_fetched_again(server, target, part):
    put(part, DATA)
    fetch(server, target)
    assert target.read_bytes() == DATA
    assert names(target) == ["net.pth"]
    assert not server.requests


@pytest.mark.parametrize("wrong", [bytes(len(DATA)), DATA + b"more"])
def test_a_part_with_nothing_missing_that_is_wrong_is_fetched_again(server, target, part, wrong):
    put(part, wrong)
    fetch(server, target)
    assert target.read_bytes() == DATA
    assert server.requests == [("GET", PATH, f"bytes={len(wrong)}-"), ("GET", PATH, None)]


def test_a_wrong_part_does_not_get_the_name(server, target, part):
    put(part, b"of another file")
    message = refusal(server, target)
    assert f"SHA-256 {hashlib.sha256(b'of another file' + DATA[15:]).hexdigest()}" in message
    assert names(target) == []
    fetch(server, target)
    assert target.read_bytes() == DATA


def test_progress_goes_on_where_it_stopped(server, target, part):
    data = bytes(3 << 20)
    server.files[PATH] = data
    put(part, data[: 2 << 20])
    told = []
    fetch(server, target, hashlib.sha256(data).hexdigest(), lambda *what: told.append(what))
    assert told[0] == ("net.pth, MiB", 2, 3)
    assert told[-1] == ("net.pth, MiB", 3, 3)


# Faults


@pytest.mark.parametrize(
    ("expected", "said"), [("ab" * 32, "Expected " + "ab" * 32), ("abcd1234", "begins with abcd1234")]
)
def test_a_wrong_checksum_is_told_and_nothing_is_kept(server, target, expected, said):
    message = refusal(server, target, sha256=expected)
    assert DIGEST in message and said in message and "was removed" in message
    assert names(target) == []


@pytest.mark.parametrize(("status", "words"), [(404, "404 Not Found"), (500, "500 Internal"), (503, "503 Service")])
def test_a_server_s_refusal_keeps_the_part(server, target, part, status, words):
    put(part, DATA[:7])
    server.statuses[PATH] = status
    message = refusal(server, target)
    assert words in message and PATH in message and "Ask a friend" in message
    assert part.read_bytes() == DATA[:7]
    assert names(target) == ["net.pth.part"]


def test_no_connection(server, target):
    with socket.socket() as closed:
        closed.bind(("127.0.0.1", 0))
        server.url = f"http://127.0.0.1:{closed.getsockname()[1]}"
        message = refusal(server, target)
    assert message.startswith(f"no connection to {server.url[7:]}: ") and "refused" in message
    assert message.endswith("Ask a friend.")
    assert names(target) == []


def test_a_name_that_is_not_resolved(server, target, monkeypatch):
    def unknown(*args, **options):
        raise socket.gaierror(socket.EAI_NONAME, "Name or service not known")

    monkeypatch.setattr(socket, "getaddrinfo", unknown)
    server.url = "https://weights.invalid"
    message = refusal(server, target)
    assert message.startswith("no connection to weights.invalid: ") and "Name or service not known" in message


def test_a_server_that_falls_silent(server, target, part, monkeypatch):
    monkeypatch.setattr(module, "TIMEOUT", 0.2)
    server.cuts, server.go_on = [65_536], threading.Event()
    assert "the connection broke after 65536 bytes of 300000 (timed out)" in refusal(server, target)
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
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (room, limits[1]))
    try:
        message = refusal(server, target)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert f"cannot write to {part}" in message and f"after {room} bytes" in message and "Make room" in message
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


def test_an_interruption_keeps_what_arrived(server, target, part):
    def interrupt(title, done, total):
        if part.stat().st_size >= 100_000:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fetch(server, target, progress=interrupt)
    kept = part.stat().st_size
    assert 100_000 <= kept < len(DATA)
    fetch(server, target)
    assert target.read_bytes() == DATA
    assert server.requests[1] == ("GET", PATH, f"bytes={kept}-")


# Two at once


def test_a_second_process_waits_its_turn(server, target):
    server.cuts, server.go_on = [100_000], threading.Event()
    arrived = threading.Event()
    first = threading.Thread(target=fetch, args=(server, target, DIGEST, lambda *_: arrived.set()))
    first.start()
    assert arrived.wait(10)
    message = refusal(server, target)
    assert "net.pth.part is being written by another process" in message
    server.go_on.set()
    first.join()
    assert target.read_bytes() == DATA
    assert len(server.requests) == 1


def test_a_file_that_was_named_between_opening_and_locking_is_not_touched(server, target, part, monkeypatch):
    """The other process is done at the worst moment: the second has the installed file open for appending."""
    put(part, DATA)
    lock = module.fcntl.flock

    def late(file, operation):
        part.rename(target)
        lock(file, operation)

    monkeypatch.setattr(module.fcntl, "flock", late)
    assert "another process" in refusal(server, target)
    assert target.read_bytes() == DATA
    assert names(target) == ["net.pth"]


def test_many_at_once(server, target):
    for _ in range(10):
        start, faults = threading.Barrier(6), []

        def one(start=start, faults=faults):
            start.wait()
            try:
                fetch(server, target)
            except InputError as error:
                faults.append(str(error))

        threads = [threading.Thread(target=one) for _ in range(6)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert all("another process" in fault for fault in faults)
        assert target.read_bytes() == DATA
        assert names(target) == ["net.pth"]
        target.unlink()


# The package


def test_checksum_of_a_file_that_cannot_be_read(tmp_path):
    with pytest.raises(InputError, match="cannot read"):
        file_sha256(tmp_path)


def test_nothing_else_in_the_package_reaches_for_the_network():
    package = Path(module.__file__).parents[1]
    users = set()
    for path in package.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            imported = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            imported += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            roots = {name.partition(".")[0] for name in imported if name != "urllib.parse"}
            if roots & {"urllib", "http", "socket", "requests", "ftplib"}:
                users.add(path.relative_to(package).as_posix())
            if isinstance(node, ast.ImportFrom) and node.module == "coliags_plugin.core.download":
                assert path.name == "lpips_install.py"
    # The executor only asks whether the cluster that the user named answers, the viewer whether its own port is free.
    assert users == {"core/download.py", "comparison/ray_executor.py", "export/viewer/library.py"}
