"""Downloads by pooch that go on where they stopped and are checked before they get their name.

Only ``coliags weights`` downloads, and nothing else imports this.
"""

from __future__ import annotations

import os
import re
from contextlib import suppress
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any
from urllib.parse import urlsplit

from coliags_plugin._version import __version__
from coliags_plugin.core.checksums import file_sha256
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.files import make_folder, reporting_unwritable
from coliags_plugin.core.locks import locked
from coliags_plugin.core.progress import Progress

if TYPE_CHECKING:
    import requests

#: Without any byte for so long, a connection counts as lost, seconds.
TIMEOUT = 30.0
_CHUNK = 1 << 16
_MIB = 1 << 20


def download(url: str, target: Path, sha256: str, progress: Progress, otherwise: str = "") -> None:
    """Fetch a file by HTTP, through the proxy of ``HTTPS_PROXY`` where that is set; nothing where ``target`` exists.

    What arrives is written to ``target`` with ``.part`` appended, which is kept when the transfer fails or is
    interrupted, continued by the next call, and renamed once its checksum is right. ``sha256`` is hexadecimal, or the
    first digits of it; progress is in MiB; ``otherwise`` says what the user can do where the server cannot be reached.
    """
    make_folder(target.parent)
    part, lock = (target.with_name(f"{target.name}.{suffix}") for suffix in ("part", "lock"))
    with reporting_unwritable(part.parent), locked(lock, part):
        try:
            if not target.exists():
                _fetch(url, part, sha256, progress, otherwise)
                os.replace(part, target)
        finally:
            # Nothing of the download is touched from here on, and filelock grants no lock of an unlinked file.
            with suppress(OSError):  # on Windows a locked file
                lock.unlink()


def _fetch(url: str, part: Path, sha256: str, progress: Progress, otherwise: str) -> None:
    """Complete a part and check it."""
    with part.open("ab") as file:
        # The last call may have been stopped between the last byte and the renaming.
        digest = file_sha256(part)
        if not digest.startswith(sha256):
            try:
                _Transfer(url, file, part.stem, progress).run(otherwise)
            finally:
                if not part.stat().st_size:
                    part.unlink()
            digest = file_sha256(part)
        os.fsync(file.fileno())
    if not digest.startswith(sha256):
        part.unlink()
        raise InputError(
            f"{url}: what arrived has the SHA-256 {digest}",
            sha256 if len(sha256) == len(digest) else f"one that begins with {sha256}",
            f"It was removed. Perhaps a proxy answered in the server's place. {otherwise}",
        )


class _UnusableRangeError(Exception):
    """The server's answer does not continue the part."""


class _Transfer:
    """The transfer of what is missing of a file, or of all of it where the server cannot send a part.

    It is also the progress bar that pooch updates: its public names are pooch's.
    """

    def __init__(self, url: str, file: IO[bytes], name: str, progress: Progress) -> None:
        self.url, self.file, self.name, self.progress = url, file, name, progress
        self.response: requests.Response | None = None
        self.total, self.offset = 0, 0

    def run(self, otherwise: str) -> None:
        """Append to the file, or write it anew."""
        import pooch
        import requests

        self.offset = self.file.tell()
        # Some content networks refuse a library's own name. Compressed answers would have other ranges.
        headers = {"User-Agent": f"coliags_plugin/{__version__}", "Accept-Encoding": "identity"}
        headers |= {"Range": f"bytes={self.offset}-"} if self.offset else {}
        hooks = {"response": self._answered}
        fetch = pooch.HTTPDownloader(self, _CHUNK, timeout=TIMEOUT, headers=headers, hooks=hooks)
        try:
            fetch(self.url, self.file, None)
        except _UnusableRangeError:
            self.file.seek(0)
            self.file.truncate()
            self.run(otherwise)
        except requests.HTTPError as error:
            status = f"{error.response.status_code} {error.response.reason}"
            raise InputError(f"{self.url}: the server answered {status}", "the file", otherwise) from error
        except requests.RequestException as error:
            if self.response is None:
                reason = getattr(error.args[0] if error.args else error, "reason", error)
                raise InputError(f"no connection to {urlsplit(self.url).netloc}: {reason}", "", otherwise) from error
            arrived = f"{self.file.tell()} bytes" + (f" of {self.offset + self.total}" if self.total else "")
            raise InputError(
                f"{self.url}: the connection broke after {arrived}", "", "Run the command again: it goes on from there"
            ) from error

    def _answered(self, response: requests.Response, *_: Any, **__: Any) -> None:
        """Prepare the file for the body of a response; redirections and failures have none."""
        begin = re.match(r"bytes (\d+)-", response.headers.get("Content-Range", ""))
        begins_elsewhere = response.status_code == 206 and (begin is None or int(begin[1]) != self.offset)
        if self.offset and (begins_elsewhere or response.status_code == 416):
            response.close()
            raise _UnusableRangeError
        self.response = response
        if response.status_code == 200 and self.offset:
            self.file.seek(0)
            self.file.truncate()
            self.offset = 0

    def update(self, size: int) -> None:
        """Report what has arrived; the whole is reported once, by :meth:`close`."""
        done, total = self.file.tell(), self.offset + self.total
        if done < total:
            self.progress(f"{self.name}, MiB", done // _MIB, -(-total // _MIB))

    def reset(self) -> None:
        """Nothing: what has arrived is told from the file."""

    def close(self) -> None:
        """Report that all has arrived, where the server told how much that is."""
        if self.total:
            total = -(-(self.offset + self.total) // _MIB)
            self.progress(f"{self.name}, MiB", total, total)
