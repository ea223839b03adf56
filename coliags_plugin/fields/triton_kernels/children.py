"""Visible anchors and their children by the kernels, with their gradients."""

from __future__ import annotations

from typing import Any

import torch
import triton
from jaxtyping import Float, Int
from torch import Tensor
from torch.autograd.function import once_differentiable

from coliags_plugin.contracts import HeadNetworks
from coliags_plugin.core.cameras import Camera
from coliags_plugin.fields.children import AnchorRows, DrawnChildren
from coliags_plugin.fields.points import DRAWN_SIGMAS
from coliags_plugin.fields.triton_kernels import decoding
from coliags_plugin.fields.triton_kernels.networks import OUTPUTS, ROWS, Network

#: Programs of the backward pass, and slabs in which each adds up gradients of the networks: about two for each
#: multiprocessor of current GPUs, but as many on all of them, so that sums have one order.
SLABS = 256
#: How kernels are compiled. Two programs of the backward pass share a multiprocessor's registers.
OPTIONS = {"num_warps": 8, "num_stages": 1, "enable_fp_fusion": True}
BACKWARD_OPTIONS = {**OPTIONS, "num_warps": 4}


def visible_children(
    rows: AnchorRows,
    camera: Camera,
    features: Float[Tensor, "M F"],
    geometry: HeadNetworks,
    appearance: HeadNetworks,
) -> tuple[DrawnChildren, Int[Tensor, "V"]]:
    """:func:`~coliags_plugin.fields.children.drawn_children` of the anchors that a camera sees, and these anchors. [V]

    The networks' inputs and ``features`` are those of all M anchors, of which the visible ones are read. The host waits
    once, for both numbers. Differentiable once, and not in the anchors' positions.
    """
    mlps = (*geometry.mlps, *appearance.mlps)
    networks = networks_of(rows.offsets.shape[1], features.shape[1], geometry, appearance)
    table = torch.cat([parameter.reshape(-1) for mlp in mlps for parameter in mlp.parameters()])
    tables = (*rows, features, geometry.inputs, appearance.inputs, table)
    *drawn, visible = _Decode.apply(camera, networks, *(values.contiguous() for values in tables))  # type: ignore[no-untyped-call]
    return DrawnChildren(*drawn), visible


def networks_of(children: int, features: int, geometry: HeadNetworks, appearance: HeadNetworks) -> tuple[Network, ...]:
    """The networks of opacity, covariance and colour, one behind the other in the table."""
    networks: list[Network] = []
    start = 0
    for head in (geometry, appearance):
        plain = head.inputs.shape[1]
        columns = features + plain + 2 * head.embedded * head.frequencies
        for mlp in head.mlps:
            units, outputs = (len(mlp.get_parameter(name)) for name in ("0.bias", "2.bias"))
            each = outputs // children
            networks.append(Network(start, units, each, children, features, plain, head.embedded, columns))
            start = networks[-1].end
    return tuple(networks)


class _Decode(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, camera: Camera, networks: tuple[Network, ...], *tables: Tensor) -> tuple[Tensor, ...]:
        positions, offsets, scalings, features, of_geometry, of_appearance, table = tables
        opacity, covariance, color = networks
        anchors, children = offsets.shape[:2]
        tiles = triton.cdiv(anchors, ROWS.value)
        new = positions.new_empty
        visible, opacities = new(anchors, dtype=torch.bool), new(anchors, children)
        counts = torch.zeros(2, tiles + 1, dtype=torch.int32, device=positions.device)
        decoding.decode_opacities[(tiles,)](
            *(positions, offsets, scalings, features, of_geometry, table),
            *(camera.camera_to_world.contiguous(), visible, opacities, counts),
            *(anchors, tiles, camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height),
            *(camera.near_plane, DRAWN_SIGMAS),
            NETWORK=opacity,
            SLOTS=block_of(children),
            **OPTIONS,
        )
        starts = counts.cumsum(1)
        visible_count, count = starts[:, -1].tolist()
        sources, visible_sources = (starts.new_empty(length) for length in (count, visible_count))
        means, quats, inverse_lengths, scales, values, colors = (
            new(count, *width) for width in ((3,), (4,), (), (3,), (), (3,))
        )
        decoding.draw[(tiles,)](
            *(positions, offsets, scalings, features, of_geometry, of_appearance, table, visible, opacities, starts),
            *(means, quats, inverse_lengths, scales, values, colors, sources, visible_sources, anchors, tiles),
            COVARIANCE=covariance,
            COLOR=color,
            SLOTS=block_of(children),
            **OPTIONS,
        )
        ctx.save_for_backward(*tables[1:], visible, opacities, starts, quats, inverse_lengths, scales, colors)
        ctx.networks = networks
        ctx.mark_non_differentiable(sources, visible_sources)
        return means, quats, scales, values, colors, sources, visible_sources

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        offsets, scalings, features, of_geometry, of_appearance, table, visible, *of_drawn = ctx.saved_tensors
        opacities, starts, quats, *_ = of_drawn
        opacity, covariance, color = ctx.networks
        anchors, children = offsets.shape[:2]
        tiles = starts.shape[1] - 1
        of_offsets, of_scalings = torch.empty_like(offsets), torch.empty_like(scalings)
        of_outputs = quats.new_empty(len(quats), OUTPUTS.value)
        decoding.draw_backward[(tiles,)](
            *(offsets, scalings, *of_drawn, *(values.contiguous() for values in gradients[:5])),
            *(of_offsets, of_scalings, of_outputs, anchors, tiles),
            CHILDREN=children,
            SLOTS=block_of(children),
            **OPTIONS,
        )
        of_features = torch.zeros_like(features)
        needs_inputs = ctx.needs_input_grad[6:8]
        of_inputs = [
            torch.zeros_like(inputs) if want else None
            for inputs, want in zip((of_geometry, of_appearance), needs_inputs, strict=True)
        ]
        programs = min(SLABS, tiles)
        sums = table.new_zeros(programs, len(table))
        decoding.networks_backward[(programs,)](
            *(features, of_geometry, of_appearance, table, visible, opacities, starts, of_outputs),
            *(of_features, *(sums if of_input is None else of_input for of_input in of_inputs), sums, anchors, tiles),
            OPACITY=opacity,
            COVARIANCE=covariance,
            COLOR=color,
            LENGTH=len(table),
            WITH_GEOMETRY=needs_inputs[0],
            WITH_APPEARANCE=needs_inputs[1],
            SLOTS=block_of(children),
            INPUTS=block_of(max(of_geometry.shape[1], of_appearance.shape[1])),
            **BACKWARD_OPTIONS,
        )
        return None, None, None, of_offsets, of_scalings, of_features, *of_inputs, sums.sum(0)


def block_of(columns: int) -> int:
    """Columns of a block of so many: products of matrices need a power of two that is not below 16."""
    return max(16, triton.next_power_of_2(columns))
