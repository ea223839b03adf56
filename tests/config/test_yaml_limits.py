"""Short YAML texts that expand without end, or are nested without end, are refused."""

from __future__ import annotations

import pytest

from coliags_plugin.config.yaml_tree import parse_assignment, parse_tree
from coliags_plugin.core.errors import InputError


def bomb(levels):
    lines = ["a0: &a0 [x, x]"] + [f"a{level}: &a{level} [*a{level - 1}, *a{level - 1}]" for level in range(1, levels)]
    return "\n".join(lines)


def test_aliases():
    assert parse_tree(bomb(5), "x").plain()["a4"][0][0][0][0] == ("x", "x")
    with pytest.raises(InputError, match="values, aliases expanded"):
        parse_tree(bomb(40), "x")
    with pytest.raises(InputError, match="endlessly many values"):
        parse_tree("a: &a [*a]", "x")
    with pytest.raises(InputError, match="endlessly many values"):
        parse_tree("a: &a {b: *a}", "x")


@pytest.mark.parametrize("text", ["a: " + "[" * 20_000, "a: " + "{b: " * 20_000, "- " * 20_000])
def test_nesting(text):
    with pytest.raises(InputError):
        parse_tree(text, "x")


def test_numbers_of_thousands_of_digits():
    with pytest.raises(InputError, match="4300 digits"):
        parse_tree(f"a: {'9' * 5000}", "x")


def test_text_that_cannot_be_encoded():
    for text in (r'a: "\ud800"', r'"\ud800": 1', r'a: ["x", "\ud800"]'):
        with pytest.raises(InputError, match=r"x:1: .*ud800.* is not text"):
            parse_tree(text, "x")
    with pytest.raises(InputError, match=r"--set .*udcff.* UTF-8"):
        parse_assignment("a=\udcff")
