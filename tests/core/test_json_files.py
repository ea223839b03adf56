from __future__ import annotations

import pytest

from coliags_plugin.core.bounds import JSON_BYTES
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.json_files import read_json


@pytest.mark.parametrize("content", [b'{"a": [1, 2.5]}', b'\xef\xbb\xbf{"a": [1, 2.5]}'])
def test_values_with_and_without_a_byte_order_mark(tmp_path, content):
    (tmp_path / "a.json").write_bytes(content)
    assert read_json(tmp_path / "a.json", "x") == {"a": [1, 2.5]}


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "is not JSON"),
        (b"{", "is not JSON"),
        (b"\xff\xfe", "cannot read"),
        (b"[" * 100_000, "is not JSON"),
        (b"9" * 5000, "is not JSON"),
        (b" " * (JSON_BYTES + 1), "it has 100,000,001 bytes"),
    ],
)
def test_anything_else_is_a_message(tmp_path, content, message):
    (tmp_path / "a.json").write_bytes(content)
    with pytest.raises(InputError, match=rf"a\.json.*{message}|{message}.*a\.json") as caught:
        read_json(tmp_path / "a.json", "a test", "Repair it")
    assert (caught.value.expected, caught.value.do) == ("a test", "Repair it")


def test_links_that_lead_nowhere(tmp_path):
    (tmp_path / "loop").symlink_to("loop")
    for name in ("loop", "missing"):
        with pytest.raises(InputError, match="cannot read"):
            read_json(tmp_path / name, "x")


@pytest.mark.parametrize("number", ["NaN", "-Infinity", "1e999"])
def test_numbers_that_cannot_be_written_again(tmp_path, number):
    (tmp_path / "a.json").write_text(f'{{"a": [{number}]}}')
    assert set(read_json(tmp_path / "a.json", "x")) == {"a"}
    with pytest.raises(InputError, match=f"{number} is not a finite number"):
        read_json(tmp_path / "a.json", "x", finite=True)
