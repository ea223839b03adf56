"""Every method of method_configs/ keeps the contract of all methods."""

from __future__ import annotations

import pytest

from coliags_plugin.checks.method.check import CHECKS, check_method
from coliags_plugin.config.components import is_auto
from coliags_plugin.config.method_config import load_method
from coliags_plugin.config.method_files import method_files, method_folder

FOLDER = method_folder()
METHODS = sorted(name for name, path in method_files().items() if path.is_relative_to(FOLDER))

#: Methods of the quick suite; ``make test-thorough`` checks the others, which take longer or differ by few options.
QUICK = {"coliags", "3dgs"}
#: Networks so small that a CPU trains them in seconds, by the field's name.
SMALL_NETWORKS = {
    "reim-nerf": (
        *("field.width=32", "field.color_width=16", "sampler.pixels=256"),
        *("renderer.samples=16", "renderer.importance_samples=16"),
    )
}


@pytest.mark.parametrize(
    "method", [pytest.param(name, marks=() if name in QUICK else pytest.mark.thorough) for name in METHODS]
)
def test_the_contract(method, tmp_path):
    config = load_method(method).config
    overrides = SMALL_NETWORKS.get(config.field.name, ())
    results = {result.name: result for result in check_method(method, tmp_path, overrides)}
    assert [f"{result.name}: {result.detail}" for result in results.values() if result.status == "failed"] == []
    automatic = is_auto("renderers", config.renderer.name)  # which chooses among renderers of Gaussians
    inapplicable = {
        "pixels": automatic or not config.renderer.target.renders_pixels,
        "rows": config.strategy.target.serves is None,
    }
    assert {name for name, result in results.items() if result.status == "skipped"} == {
        name for name, holds in inapplicable.items() if holds
    }
    assert list(results) == [check.name for check in CHECKS]


def test_there_are_methods_to_check():
    assert QUICK | {"ablations/none"} <= set(METHODS)
