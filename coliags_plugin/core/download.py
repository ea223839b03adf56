"""Downloads that go on where they stopped and are checked before they get their name.

Only ``coliags weights`` downloads, and nothing else imports this.
"""

from __future__ import annotations

import fcntl
import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from http.client import HTTPException, HTTPResponse
from io import FileIO
from pathlib import Path
from urllib.error import HTTPError
from urllib.parse import urlsplit
from urllib.request import Request, build_opener

from coliags_plugin._version import __version__
from coliags_plugin.core.checksums import file_sha256
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.files import make_folder, not_writable
from coliags_plugin.core.progress import Progress

#: Without any byte for so long, a connection counts as lost, seconds.
TIMEOUT = 30.0
_CHUNK = 1 << 16
_MIB = 1 << 20


def download(url: str, target: Path, sha256: str, progress: Progress, otherwise: str = "") -> None:
    """Fetch a file by HTTP, through the proxy of ``HTTPS_PROXY`` where that is set.

    What arrives is written to ``target`` with ``.part`` appended, which is locked, kept when the transfer fails or is
    interrupted, continued by the next call, and renamed once its checksum is right.

    Args:
        url: Where the file is.
        target: The file to write. Where it exists, nothing is done.
        sha256: Its SHA-256 in hexadecimal, or the first digits of it.
        progress: Called with what has arrived and all there is, MiB.
        otherwise: What the user can do where the server cannot be reached.

    Raises:
        InputError: No connection, a status of the server other than success, a transfer that ended early, another
            checksum, a folder or disk that cannot be written, or another process that fetches the same file.
    """
    make_folder(target.parent)
    part = target.with_name(f"{target.name}.part")
    with _locked(part) as file:
        if target.exists():
            return
        # The last call may have been stopped between the last byte and the renaming.
        seen = file_sha256(part)
        if not seen.startswith(sha256):
            _transfer(url, file, target.name, progress, otherwise)
            seen = file_sha256(part)
        if not seen.startswith(sha256):
            part.unlink()
            raise InputError(
                f"{url}: what arrived has the SHA-256 {seen}",
                sha256 if len(sha256) == len(seen) else f"one that begins with {sha256}",
                f"It was removed. Perhaps a proxy answered in the server's place. {otherwise}",
            )
        try:
            os.fsync(file.fileno())
            os.replace(part, target)
        except OSError as error:
            raise not_writable(part.parent, error) from error


@contextmanager
def _locked(part: Path) -> Iterator[FileIO]:
    """The file, opened for appending by this process alone, and removed at the end where nothing is in it."""
    try:
        file = FileIO(part, "ab")
    except OSError as error:
        raise not_writable(part.parent, error) from error
    with file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            # Between opening and locking, another process may have given the file its final name.
            alone = part.exists() and os.path.samestat(part.stat(), os.fstat(file.fileno()))
        except BlockingIOError:
            alone = False
        except OSError as error:
            raise not_writable(part.parent, error) from error
        if not alone:
            raise InputError(f"{part} is being written by another process", "", "Wait until that is done")
        try:
            yield file
        finally:
            if _size(file) == 0:
                part.unlink(missing_ok=True)


def _transfer(url: str, file: FileIO, name: str, progress: Progress, otherwise: str) -> None:
    """Append what is missing of the file, or all of it where the server cannot send a part."""
    try:
        response, received = _request(url, _size(file))
    except HTTPError as error:
        raise InputError(f"{url}: the server answered {error.code} {error.reason}", "the file", otherwise) from error
    except (OSError, HTTPException) as error:
        reason = getattr(error, "reason", error)
        raise InputError(f"no connection to {urlsplit(url).netloc}: {reason}", "", otherwise) from error
    with response:
        total = None if response.length is None else received + response.length
        _write(file, b"", at=received)
        stopped: Exception | None = None
        while True:
            if total is not None:
                progress(f"{name}, MiB", received // _MIB if received < total else -(-total // _MIB), -(-total // _MIB))
            try:
                chunk = response.read(_CHUNK)
            except (OSError, HTTPException) as error:
                stopped = error
                break
            if not chunk:
                break
            _write(file, chunk)
            received += len(chunk)
    if stopped is not None or (total is not None and received < total):
        raise InputError(
            f"{url}: the connection broke after {received} bytes"
            + (f" of {total}" if total is not None else "")
            + (f" ({stopped})" if stopped is not None else ""),
            "",
            "Run the command again: it goes on from there",
        ) from stopped


def _request(url: str, have: int) -> tuple[HTTPResponse, int]:
    """The server's response, and the position in the file of its first byte: ``have`` or, failing that, 0."""
    # Some content networks refuse urllib's own name, for which reason torch.hub gives another too.
    headers = {"User-Agent": f"coliags_plugin/{__version__}"} | ({"Range": f"bytes={have}-"} if have else {})
    try:
        response: HTTPResponse = build_opener().open(Request(url, headers=headers), timeout=TIMEOUT)
    except HTTPError as error:
        if have and error.code == 416:  # nothing beyond what is there, which is not the file
            return _request(url, 0)
        raise
    if not have or response.status != 206:
        return response, 0
    begin = re.match(r"bytes (\d+)-", response.headers.get("Content-Range", ""))
    if begin is not None and int(begin[1]) == have:
        return response, have
    response.close()
    return _request(url, 0)


def _write(file: FileIO, data: bytes, at: int | None = None) -> None:
    """Append data; with ``at``, cut the file there first."""
    try:
        if at is not None:
            file.truncate(at)
        while data:
            data = data[file.write(data) :]
    except OSError as error:
        raise InputError(
            f"cannot write to {file.name}: {error.strerror} after {_size(file)} bytes",
            "",
            "Make room or choose another folder. Run again, the command goes on from there",
        ) from error


def _size(file: FileIO) -> int:
    return os.fstat(file.fileno()).st_size
