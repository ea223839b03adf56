"""Settings and assignments: each is the other, exactly."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from coliags_plugin.config.assignments import assignments, parse_assignments
from coliags_plugin.config.method_config import load_method
from coliags_plugin.core.errors import InputError

numbers = st.floats(allow_nan=False)
plain = st.recursive(
    st.none() | st.booleans() | st.integers() | numbers | st.text(st.characters(exclude_categories=["C"]), max_size=8),
    lambda inner: (
        st.lists(inner, max_size=3).map(tuple)
        | st.dictionaries(st.text("abc1e.-_ ", min_size=1, max_size=6), inner, max_size=3)
    ),
    max_leaves=6,
)
paths = st.from_regex(r"[a-z_]{1,8}(\.[a-z_]{1,8}){0,2}", fullmatch=True)


@settings(max_examples=40, deadline=None)
@given(settings=st.dictionaries(paths, plain, max_size=4))
def test_settings_survive_as_texts(settings):
    found = parse_assignments(assignments(settings))
    assert found == settings and list(found) == list(settings)
    assert repr(found) == repr(settings)  # 1 is not 1.0, nor is True


@pytest.mark.parametrize(
    "text", ["1e5", "1.5", "on", "yes", "null", "~", "true", "", " x ", "a: b", "[1]", "#1", "1_000", "0x1f", "12:30"]
)
def test_text_that_looks_like_something_else_stays_text(text):
    assert parse_assignments(assignments({"a": text})) == {"a": text}


def test_what_people_write_reads_as_they_would_type_it():
    settings = {
        "field.voxel_size": 1e-3,
        "losses.depth": None,
        "split": "block",
        "offset": (1, 2.5),
        "losses": {"l1": {"name": "l1"}},
    }
    assert assignments(settings) == (
        "field.voxel_size=0.001",
        "losses.depth=null",
        "split=block",
        "offset=[1, 2.5]",
        "losses={l1: {name: l1}}",
    )
    assert assignments(None) == ()


def test_numbers_of_numpy_and_torch_and_paths_are_plain():
    settings = {"a": np.float32(0.5), "b": np.int64(3), "c": np.bool_(True), "d": Path("x/y"), "e": torch.tensor(2)}
    assert parse_assignments(assignments(settings)) == {"a": 0.5, "b": 3, "c": True, "d": "x/y", "e": 2}
    assert parse_assignments(assignments({"a": -math.inf})) == {"a": -math.inf}
    # Of a key that is there twice the last counts, in its place.
    assert list(parse_assignments(["a=1", "b=2", "a=3"]).items()) == [("b", 2), ("a", 3)]
    settings = {"field.geometry_head.frequencies": 7, 'optimizers."offsets".lr': 0.5, "losses.depth": None}
    config = load_method("coliags", assignments(settings)).config
    assert config.field.settings.geometry_head.settings.frequencies == 7
    assert config.optimizers["offsets"].lr == 0.5 and "depth" not in config.losses


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (["schedule.steps=5"], "values by key path"),
        ({3: 1}, "values by key path"),
        ({"a": object()}, "setting a is a object"),
        ({"a": {"b": [np.zeros(2)]}}, r"setting a\.b is a ndarray"),
    ],
)
def test_other_things_are_refused(settings, message):
    with pytest.raises(InputError, match=message):
        assignments(settings)


def test_a_text_without_a_value_is_refused_by_its_option():
    with pytest.raises(InputError, match=r"--light power\. Expected power=10"):
        parse_assignments(["power"], "--light", "power=10")
