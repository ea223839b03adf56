"""The triton kernels of decoding, compiled for GPUs that are not here; what they compute: test_fused_decoding.py."""

from __future__ import annotations

from importlib.util import find_spec

import pytest
import torch

from coliags_plugin.config.method_config import load_method
from tests.triton_compiler import TARGETS, assert_compiles

pytestmark = pytest.mark.skipif(find_spec("triton") is None, reason="triton is not installed")
TYPES = {
    **{"visible": "*i1", "counts": "*i32"},
    **dict.fromkeys(("anchors", "tiles", "width", "height"), "i32"),
    **dict.fromkeys(("fx", "fy", "cx", "cy", "near_plane", "sigmas"), "fp32"),
    **dict.fromkeys(("starts", "sources", "visible_sources"), "*i64"),
}


def variants():
    """The kernels for the networks of `coliags`, with the gradients of the pose."""
    from coliags_plugin.fields.triton_kernels import children, decoding

    node = load_method("coliags").config.field
    field = node.target(node.settings, 1, torch.Generator())
    seen = (field.features, *(torch.zeros(1, width) for width in (3, 1, 1)), None)
    heads = field.geometry_head.networks(*seen[:2]), field.appearance_head.networks(*seen)
    opacity, covariance, color = children.networks_of(field.slots_per_element, field.features.shape[1], *heads)
    constants = {
        **{"NETWORK": opacity, "OPACITY": opacity, "COVARIANCE": covariance, "COLOR": color, "LENGTH": color.end},
        **{"CHILDREN": color.children, "WITH_GEOMETRY": True, "WITH_APPEARANCE": True},
        **{"SLOTS": children.block_of(color.children), "INPUTS": children.block_of(color.given)},
    }
    for kernel in (decoding.decode_opacities, decoding.draw, decoding.draw_backward):
        yield kernel.__name__, kernel, TYPES, constants, children.OPTIONS
    yield "networks_backward", decoding.networks_backward, TYPES, constants, children.BACKWARD_OPTIONS


@pytest.mark.parametrize("target", TARGETS)
def test_every_kernel_compiles_without_a_device(target, tmp_path, monkeypatch):
    assert_compiles(__file__, target, tmp_path, monkeypatch)
