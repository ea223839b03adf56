"""Runs to look at."""

from __future__ import annotations

import pytest

import coliags_plugin as cp
from coliags_plugin.config.method_config import load_method
from coliags_plugin.config.yaml_tree import parse_assignments
from tests.scenes import SMALL


@pytest.fixture(scope="session")
def run_of(wall, tmp_path_factory):
    """A handle of a run of a method after two steps; each is trained once."""
    runs = {}

    def trained(method, *settings):
        if method not in runs:
            small = SMALL if load_method(method).config.field.name == "anchors" else (SMALL[0], SMALL[2])
            torch = ["renderer=torch"] if method == "2dgs" else []  # numba compiles kernels of surfels for long
            options, folder = parse_assignments([*small, *torch, *settings]), tmp_path_factory.mktemp("runs") / method
            runs[method] = cp.train(method, wall, folder, steps=2, settings=options)
        return runs[method]

    return trained


@pytest.fixture(scope="session")
def anchors(run_of):
    return run_of("coliags")
