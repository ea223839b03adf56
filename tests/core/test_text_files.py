"""Text files are read up to a size, and long ones line by line."""

from __future__ import annotations

import pytest

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.text_files import read_text, text_lines, whole_text


def test_text_with_and_without_a_byte_order_mark(tmp_path):
    (tmp_path / "plain").write_bytes("à\nb\n".encode())
    (tmp_path / "marked").write_bytes(b"\xef\xbb\xbf" + "à\nb\n".encode())
    for name in ("plain", "marked"):
        assert whole_text(tmp_path / name) == read_text(tmp_path / name, "x") == "à\nb\n"
        assert list(text_lines(tmp_path / name, "x")) == [(1, "à\n"), (2, "b\n")]


def test_sizes_up_to_the_largest_are_read(tmp_path):
    file = tmp_path / "a"
    file.write_bytes(b"abc")
    assert whole_text(file, 3) == "abc"
    with pytest.raises(ValueError, match="3 bytes, and at most 2"):
        whole_text(file, 2)
    file.write_bytes(bytes(1_000_001))
    with pytest.raises(InputError, match=r"cannot read .*a: it has 1,000,001 bytes, and at most 1,000,000 are read"):
        read_text(file, "x")
    assert sum(len(line) for _, line in text_lines(file, "x")) == 1_000_001


@pytest.mark.parametrize("content", [None, b"\xff"])
def test_what_is_not_text_is_a_message(tmp_path, content):
    if content is not None:
        (tmp_path / "a").write_bytes(content)
    for read in (read_text, lambda *args: list(text_lines(*args))):
        with pytest.raises(InputError, match="cannot read") as caught:
            read(tmp_path / "a", "a test")
        assert caught.value.expected == "a test"
