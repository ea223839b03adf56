"""Children of visible anchors as Gaussians: those of positive opacity (docs/methods.md 3.5)."""

from __future__ import annotations

from functools import cache
from typing import Any, NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.nn import functional

from coliags_plugin.contracts import HeadNetworks
from coliags_plugin.core.cameras import Camera
from coliags_plugin.core.tensors import tables
from coliags_plugin.fields.points import DRAWN_SIGMAS, frustum_planes


class AnchorRows(NamedTuple):
    """Positions, children's offsets and log scales of the M anchors of a field."""

    positions: Float[Tensor, "M 3"]
    offsets: Float[Tensor, "M K 3"]
    scalings: Float[Tensor, "M 6"]


class DrawnChildren(NamedTuple):
    """The N children that are drawn, in the order of anchors and children."""

    means: Float[Tensor, "N 3"]
    quats_wxyz: Float[Tensor, "N 4"]
    scales: Float[Tensor, "N 3"]
    opacities: Float[Tensor, "N"]
    colors: Float[Tensor, "N 3"]
    source_index: Int[Tensor, "N"]  # in M * K


def drawn_children(
    rows: AnchorRows,
    visible: Int[Tensor, "V"],
    opacities: Float[Tensor, "V K"],
    covariances: Float[Tensor, "V K 7"],
    colors: Float[Tensor, "V K 3"],
) -> DrawnChildren:
    """Gaussians decoded from the visible anchors: their children of positive opacity."""
    children = rows.offsets.shape[1]
    slots = (opacities.reshape(-1) > 0.0).nonzero().squeeze(1)
    parents = visible.index_select(0, slots // children)
    sources = parents * children + slots % children
    covariances = covariances.reshape(-1, 7).index_select(0, slots)
    scales = rows.scalings.index_select(0, parents).exp()
    shifts = rows.offsets.reshape(-1, 3).index_select(0, sources)
    return DrawnChildren(
        means=rows.positions.index_select(0, parents) + shifts * scales[:, :3],
        quats_wxyz=functional.normalize(covariances[:, 3:], dim=1),
        scales=scales[:, 3:] * covariances[:, :3].sigmoid(),
        opacities=opacities.reshape(-1).index_select(0, slots),
        colors=colors.reshape(-1, 3).index_select(0, slots),
        source_index=sources,
    )


def visible_anchors(rows: AnchorRows, camera: Camera) -> Int[Tensor, "V"]:
    """Indices of anchors of which any child may overlap the image, by a kernel for float32 on the CPU."""
    from coliags_plugin.core.numba_kernels.threads import Crew
    from coliags_plugin.fields.numba_kernels.decoding import find_visible

    camera = camera.to(torch.device("cpu"), torch.float32)
    visible = torch.empty(len(rows.positions), dtype=torch.bool)
    arguments = tables(rows.positions, rows.offsets, rows.scalings.exp(), camera.center, frustum_planes(camera))
    Crew().run(find_visible, rows.offsets.shape[1], DRAWN_SIGMAS, *arguments, camera.near_plane, visible.numpy())
    return visible.nonzero().squeeze(1)


def fused_children(
    rows: AnchorRows,
    visible: Int[Tensor, "V"],
    features: Float[Tensor, "V F"],
    geometry: HeadNetworks,
    appearance: HeadNetworks,
) -> DrawnChildren:
    """:func:`drawn_children` from the heads' networks, by kernels for float32 on the CPU.

    ``visible`` is ascending. Differentiable once, and not in the anchors' positions.
    """
    children, count = rows.offsets.shape[1], features.shape[1]
    mlps = (*geometry.mlps, *appearance.mlps)
    first = [_filled(mlp.get_parameter("0.weight")).t() for mlp in mlps]  # with inputs as rows, units as columns
    first_biases = [_filled(mlp.get_parameter("0.bias")) for mlp in mlps]
    weights: list[Tensor] = [mlp.get_parameter("2.weight") for mlp in mlps]
    biases: list[Tensor] = [mlp.get_parameter("2.bias") for mlp in mlps]
    weights[1], biases[1] = (_scales_first(values[1], children) for values in (weights, biases))
    last = [_filled(_filled(weight).t()) for weight in weights]  # with units as rows, outputs as columns
    last_biases = [_filled(bias) for bias in biases]
    networks = (
        torch.cat([weight[:count] for weight in first], dim=1),
        _filled(torch.cat([weight[count:] for weight in first[:2]], dim=1)),
        _filled(first[2][count:]),
        *last,
        torch.cat(first_biases),
        *last_biases,
    )
    units, outputs = ([len(bias) for bias in biases] for biases in (first_biases, last_biases))
    widths = (*units, *outputs, 3 * children + _missing(3 * children), count, children)
    waves = [(head.embedded, head.frequencies) for head in (geometry, appearance)]
    inputs = (geometry.inputs, appearance.inputs)
    return DrawnChildren(*_Fused.apply(widths, waves, visible, *rows, features, *inputs, *networks))  # type: ignore[no-untyped-call]


def _scales_first(values: Float[Tensor, "7K *H"], children: int) -> Float[Tensor, "C *H"]:
    """Rows of covariances, those of the logits of all scales before those of all quaternions."""
    parts: Any = values.view(children, 7, *values.shape[1:]).split((3, 4), dim=1)  # type: ignore[no-untyped-call]
    return torch.cat([_filled(part.flatten(0, 1)) for part in parts])


@cache
def _waves(plain: int, embedded: int, frequencies: int) -> tuple[Tensor, Tensor]:
    """Octaves and quadrants of ``numba_kernels.decoding.Inputs``: inputs as they are, then gamma of the last ones."""
    octaves = torch.zeros(embedded, plain + 2 * embedded * frequencies)
    blocks = octaves[:, plain:].view(embedded, frequencies, 2, embedded)
    for place in range(embedded):
        blocks[place, :, :, place] = 2.0 ** torch.arange(frequencies)[:, None]
    quadrants = torch.zeros(octaves.shape[1])
    quadrants[plain:].view(frequencies, 2, embedded)[:, 1] = 1.0
    return _filled(octaves.t()).t().contiguous(), _filled(quadrants)


def _missing(count: int) -> int:
    """Number of zero rows that pad this many rows to whole SIMD vectors."""
    from coliags_plugin.core.numba_kernels.lanes import WIDTH

    return -count % WIDTH


def _filled(values: Tensor) -> Tensor:
    """Zero-pad the rows of a table to whole SIMD vectors."""
    missing = _missing(len(values))
    return functional.pad(values, (0, 0) * (values.dim() - 1) + (0, missing)) if missing else values


class _Fused(torch.autograd.Function):
    """The kernels of ``numba_kernels/decoding.py``."""

    @staticmethod
    def forward(ctx: Any, widths: tuple[int, ...], waves: list[tuple[int, int]], *inputs: Tensor) -> tuple[Tensor, ...]:
        from coliags_plugin.core.numba_kernels.threads import Crew
        from coliags_plugin.fields.numba_kernels import decoding as kernels

        visible, positions, offsets, scalings, features, geometry, appearance, *networks = inputs
        new = positions.new_empty
        ctx.widths, ctx.waves = kernels.Widths(*widths), waves
        hidden, opacities = new(len(visible), networks[0].shape[1]), new(len(visible), ctx.widths.opacities)
        ctx.hidden = tables(hidden, opacities)
        ctx.seen = (
            kernels.Anchors(*tables(visible, positions, offsets, scalings.exp(), features)),
            *(
                kernels.Inputs(values.shape[1], *tables(values, *_waves(values.shape[1], *wave)))
                for values, wave in zip((geometry, appearance), waves, strict=True)
            ),
        )
        decoding = (kernels.Networks(*tables(*networks)), *ctx.hidden)
        starts = torch.zeros(-(-len(visible) // kernels.TILE) + 1, dtype=torch.int64)
        Crew().run(kernels.decode_opacities, ctx.widths, *ctx.seen, *decoding, starts[1:].numpy())
        torch.cumsum(starts, 0, out=starts)
        count, ctx.starts = int(starts[-1]), starts[:-1].numpy()
        sources = torch.empty(count, dtype=torch.int64)
        *drawn, inverse_lengths = (new(count, *width) for width in ((3,), (4,), (3,), (), (3,), ()))
        ctx.drawn = kernels.Drawn(*tables(*drawn, sources, inverse_lengths))
        Crew().run(kernels.draw, ctx.widths, ctx.seen[0], *decoding, ctx.starts, ctx.drawn)
        ctx.save_for_backward(*inputs)
        ctx.mark_non_differentiable(sources)
        return *drawn, sources

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *of_outputs: Tensor) -> tuple[Tensor | None, ...]:
        from coliags_plugin.core.numba_kernels.threads import Crew
        from coliags_plugin.fields.numba_kernels import decoding as kernels

        visible, _, offsets, scalings, features, geometry, appearance, *networks = ctx.saved_tensors
        make = torch.empty_like if len(visible) else torch.zeros_like
        of_rows = [make(rows) for rows in (offsets, scalings)]
        zeros = features.new_zeros
        of_features = zeros(len(visible), features.shape[1] + _missing(features.shape[1]))
        of_embedded = [
            zeros(len(visible), len(inputs_of_head.quadrants)) if ctx.needs_input_grad[7 + place] else None
            for place, inputs_of_head in enumerate(ctx.seen[1:])
        ]
        sums = torch.zeros(kernels.SLABS, sum(network.numel() for network in networks))
        transposed = [_filled(weight).t() if weight.dim() == 2 else weight for weight in networks]
        written = [*of_rows, of_features, *(zeros(0) if embedded is None else embedded for embedded in of_embedded)]
        Crew().run(
            kernels.decode_backward,
            ctx.widths,
            *ctx.seen,
            kernels.Networks(*tables(*transposed)),
            *ctx.hidden,
            ctx.starts,
            ctx.drawn,
            kernels.Drawn(*tables(*of_outputs[:5]), *ctx.drawn[5:]),
            kernels.Found(*tables(*written)),
            sums.numpy(),
        )
        of_inputs = [
            None if embedded is None else _embedding_backward(embedded, values, *wave)
            for embedded, values, wave in zip(of_embedded, (geometry, appearance), ctx.waves, strict=True)
        ]
        parts: Any = torch.split(sums.sum(0), [network.numel() for network in networks])
        of_networks = [part.view(network.shape) for part, network in zip(parts, networks, strict=True)]
        return None, None, None, None, *of_rows, of_features[:, : features.shape[1]], *of_inputs, *of_networks


def _embedding_backward(
    of_embedded: Float[Tensor, "V E"], inputs: Float[Tensor, "V R"], embedded: int, frequencies: int
) -> Float[Tensor, "V R"]:
    """Derivative with respect to inputs, the last of which are embedded."""
    plain = inputs.shape[1]
    of_inputs = of_embedded[:, :plain].clone()
    of_waves = of_embedded[:, plain : plain + 2 * embedded * frequencies].reshape(len(inputs), frequencies, 2, embedded)
    octaves = 2.0 ** torch.arange(frequencies, device=inputs.device)[:, None]
    phases = octaves * inputs[:, None, plain - embedded :]
    of_phases = of_waves[:, :, 0] * phases.cos() - of_waves[:, :, 1] * phases.sin()
    of_inputs[:, plain - embedded :] += (octaves * of_phases).sum(1)
    return of_inputs
