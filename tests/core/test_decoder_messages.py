"""What decoders in C print: nothing on the terminal, and a warning where no error tells it."""

from __future__ import annotations

import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from coliags_plugin.core.decoder_messages import decoder_messages
from coliags_plugin.core.images import encode_image
from tests.layouts.rotatecolon import write_exr

READ = """if True:
    import logging, sys
    from pathlib import Path
    from coliags_plugin.core.decoder_messages import separate_stderr
    from coliags_plugin.core.errors import InputError
    from coliags_plugin.core.images import decode_image
    from coliags_plugin.datamanagers.rotatecolon.exr_depth import read_exr_channel
    separate_stderr()
    logging.basicConfig(format="log: %(message)s")
    path = Path(sys.argv[1])
    try:
        read_exr_channel(path, "Y") if path.suffix == ".exr" else decode_image(path)
    except InputError as error:
        print("refused:", error, file=sys.stderr)
"""


def said(path) -> list[str]:
    """All lines that a process writes which reads an image."""
    done = subprocess.run([sys.executable, "-c", READ, str(path)], capture_output=True, text=True, check=True)
    assert done.stdout == ""
    return done.stderr.splitlines()


@pytest.fixture
def pixels():
    return np.random.default_rng(0).integers(0, 255, (40, 50, 3)).astype(np.uint8)


def test_a_damaged_png_is_told_once(tmp_path, pixels):
    data = bytearray(encode_image(pixels))
    data[len(data) // 2] ^= 0xFF
    (tmp_path / "a.png").write_bytes(data)  # libpng: CRC error
    (line,) = said(tmp_path / "a.png")
    assert line.startswith(f"refused: {tmp_path / 'a.png'}")


def test_a_short_tiff_is_told_once(tmp_path, pixels):
    data = encode_image(pixels, ".tiff")
    (tmp_path / "a.tiff").write_bytes(data[: len(data) // 2])  # libtiff: seek error
    (line,) = said(tmp_path / "a.tiff")
    assert line.startswith("refused: ")


def test_a_short_exr_is_told_once(tmp_path, pixels):
    write_exr(tmp_path / "a.exr", {"Y": np.random.default_rng(0).random((40, 50)).astype(np.float32)})
    data = (tmp_path / "a.exr").read_bytes()
    (tmp_path / "a.exr").write_bytes(data[: len(data) // 2])  # OpenEXR: corrupt leader, and a warning on stdout
    (line,) = said(tmp_path / "a.exr")
    assert line.startswith("refused: ")


def test_damage_that_is_decoded_is_a_warning(tmp_path, pixels):
    data = encode_image(pixels, ".jpg")
    (tmp_path / "a.jpg").write_bytes(data[:-2] + b"0123456789" + data[-2:])  # libjpeg: extraneous bytes
    (line,) = said(tmp_path / "a.jpg")
    assert line.startswith("log: an image is read that may be damaged; its decoder says: Corrupt JPEG data: ")


def test_threads_share_it_and_the_terminal_comes_back(capfd, caplog):
    def decode(number):
        with decoder_messages():
            os.write(2, b"noise\n")
        return number

    with ThreadPoolExecutor(8) as pool:
        assert list(pool.map(decode, range(200))) == list(range(200))
    assert {record.message.rpartition(": ")[2] for record in caplog.records} == {"noise"}
    with pytest.raises(KeyError), decoder_messages():
        os.write(2, b"noise\n")
        raise KeyError
    os.write(2, b"after\n")
    assert capfd.readouterr().err == "after\n"
