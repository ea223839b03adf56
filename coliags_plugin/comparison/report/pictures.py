"""Pictures of a page: within it as long as it stays small, then in a folder beside it."""

from __future__ import annotations

import hashlib
import re
import shutil
from base64 import b64encode
from pathlib import Path

from coliags_plugin.comparison.report.views import EncodedImage
from coliags_plugin.core.files import atomic_write

_SUFFIXES = {"image/jpeg": ".jpg", "image/png": ".png", "image/webp": ".webp"}
#: Names that this class gives; nothing else is ever removed.
_NAME = re.compile(r"[0-9a-f]{20}\.(jpg|png|webp)")


def data_uri(image: EncodedImage) -> str:
    """A picture as its own address."""
    return f"data:{image.mime};base64,{b64encode(image.data).decode('ascii')}"


class Pictures:
    """Addresses of pictures.

    Args:
        page: The HTML file.
        room: Bytes that pictures may take of it.
    """

    def __init__(self, page: Path, room: int) -> None:
        self.folder = page.with_name(f"{page.stem}_files")
        self.beside = 0
        self._room = room
        self._written: set[str] = set()

    def address(self, image: EncodedImage) -> str:
        """A data URI, or, once there is no more room for one, the path of a file beside the page.

        Raises:
            InputError: The file cannot be written.
        """
        size = 4 * ((len(image.data) + 2) // 3)
        if size <= self._room and not self.beside:
            self._room -= size
            return data_uri(image)
        name = f"{hashlib.sha256(image.data).hexdigest()[:20]}{_SUFFIXES[image.mime]}"
        if name not in self._written:
            atomic_write(self.folder / name, image.data)
            self._written.add(name)
        self.beside += 1
        return f"{self.folder.name}/{name}"

    def remove_former(self) -> None:
        """Remove the pictures of a former page of this name that this one has not."""
        if not self.folder.is_dir():
            return
        for file in self.folder.iterdir():
            if _NAME.fullmatch(file.name) and file.name not in self._written:
                file.unlink()
        if not any(self.folder.iterdir()):
            shutil.rmtree(self.folder)
