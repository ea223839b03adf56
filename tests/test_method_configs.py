"""Every method of method_configs/ keeps the contract of all methods."""

from __future__ import annotations

from contextlib import nullcontext

import pytest

from coliags_plugin.config.method_config import load_method, method_files, method_folder
from coliags_plugin.core.components import is_auto
from coliags_plugin.testing import METHOD_CHECKS, CheckContext, CheckSkippedError, name_of_check

METHODS = sorted(name for name, path in method_files().items() if path.is_relative_to(method_folder()))

#: Methods of the quick suite; ``make test-thorough`` checks the others, which take longer or differ by few options.
QUICK = {"coliags", "3dgs"}


@pytest.fixture(
    scope="module", params=[pytest.param(name, marks=[pytest.mark.thorough] * (name not in QUICK)) for name in METHODS]
)
def context(request, tmp_path_factory):
    small = ("field.width=32", "field.color_width=16", "sampler.pixels=256")  # a CPU trains them in seconds
    small += ("renderer.samples=16", "renderer.importance_samples=16")
    has_networks = load_method(request.param).config.field.name == "reim-nerf"
    return CheckContext(request.param, tmp_path_factory.mktemp("check"), small if has_networks else ())


@pytest.mark.parametrize("check", METHOD_CHECKS, ids=name_of_check)
def test_the_contract(context, check):
    config = context.loaded.config
    automatic = is_auto("renderers", config.renderer.name)  # which chooses among renderers of Gaussians
    is_inapplicable = {
        "pixels": automatic or not config.renderer.target.renders_pixels,
        "rows": config.strategy.target.serves is None,
    }
    with pytest.raises(CheckSkippedError) if is_inapplicable.get(name_of_check(check)) else nullcontext():
        context.run(check)
