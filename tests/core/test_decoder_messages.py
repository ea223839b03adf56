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
    from coliags_plugin.datamanagers.rotatecolon import read_exr_channel
    separate_stderr()
    logging.basicConfig(format="log: %(message)s")
    for path in map(Path, sys.argv[1:]):
        try:
            read_exr_channel(path, "Y") if path.suffix == ".exr" else decode_image(path)
        except InputError as error:
            print("refused:", error, file=sys.stderr)
"""


@pytest.mark.thorough
def test_damage_is_told_once_and_a_warning_where_it_is_decoded(tmp_path):
    pixels = np.random.default_rng(0).integers(0, 255, (40, 50, 3)).astype(np.uint8)
    write_exr(tmp_path / "a.exr", {"Y": np.random.default_rng(0).random((40, 50)).astype(np.float32)})
    png, tiff, jpg = (encode_image(pixels, suffix) for suffix in (".png", ".tiff", ".jpg"))
    exr, middle = (tmp_path / "a.exr").read_bytes(), len(png) // 2
    damaged = {
        "a.png": png[:middle] + bytes([png[middle] ^ 0xFF]) + png[middle + 1 :],  # libpng: CRC error
        "a.tiff": tiff[: len(tiff) // 2],  # libtiff: seek error
        "a.exr": exr[: len(exr) // 2],  # OpenEXR: corrupt leader, and a warning on stdout
        "a.jpg": jpg[:-2] + b"0123456789" + jpg[-2:],  # libjpeg: extraneous bytes
    }
    for name, data in damaged.items():
        (tmp_path / name).write_bytes(data)
    command = [sys.executable, "-c", READ, *(str(tmp_path / name) for name in damaged)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    *refused, warning = done.stderr.splitlines()
    assert done.stdout == "" and len(refused) == 3
    for line, name in zip(refused, damaged, strict=False):
        assert line.startswith("refused: ") and str(tmp_path / name) in line
    assert warning.startswith("log: an image is read that may be damaged; its decoder says: Corrupt JPEG data: ")


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
