"""Execution of the kernels in order, their memory, and the autograd functions that do both: Gaussians -> images.

Between projection and compositing goes, beside the projected centres, a tensor of links, whose content does not matter:
the gradients it receives are the sums that the layouts describe, from which the derivatives of the Gaussians follow more
directly and with less cancellation than from those of the projections.
"""

from __future__ import annotations

import math
import weakref
from collections import deque
from collections.abc import Callable, Collection, Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor
from torch.autograd.function import FunctionCtx, once_differentiable

from coliags_plugin.core.numba_kernels.compilation import Array
from coliags_plugin.core.numba_kernels.threads import Crew
from coliags_plugin.core.tensors import tables
from coliags_plugin.renderers.numba_kernels import (
    layout,
    projection,
    projection_backward,
    sweep_backward,
    sweep_forward,
    tiles,
)

#: Pieces of work per thread where their costs differ.
_PIECES = 8
#: Largest number of pairs of the lists.
_MOST_PAIRS = 2**31 - 1
#: Bytes that arrays begin at a multiple of, a line of the cache; and of a page of memory.
_ALIGNMENT, _PAGE = 64, 4096
#: Memory is taken this much larger than asked for, and of so many arrays it is kept for later.
_GROWTH, _KEPT = 1.25, 64


class UnusableGaussianError(Exception):
    """A Gaussian cannot be projected; the caller determines which and why."""


class TooManyPairsError(Exception):
    """The Gaussians cover more tiles than the lists can hold; the argument is the number of tiles."""


class Pool:
    """Arrays whose memory is used again when they are garbage collected: new pages cost more than the kernels.

    Safe to use from several threads, and without a lock: memory comes back whenever Python collects garbage, which may be
    in the middle of :meth:`take`.
    """

    def __init__(self) -> None:
        self._free: deque[npt.NDArray[np.uint8]] = deque(maxlen=_KEPT)

    def take(self, *shape: int, dtype: npt.DTypeLike = np.float32) -> Array:
        """Take an array with undefined content."""
        size = np.dtype(dtype).itemsize * math.prod(shape)
        # Views of views refer to the first array that does not refer to another: this one, because of the memoryview.
        buffer = self._buffer(size)
        array = np.frombuffer(memoryview(buffer)[:size], dtype)
        weakref.finalize(array, self._free.append, buffer).atexit = False
        return array.reshape(shape)

    def _buffer(self, size: int) -> npt.NDArray[np.uint8]:
        """The memory of this size that came back last, as the processor's caches may still hold it; or else new."""
        others, buffer = [], None
        for _ in range(len(self._free)):
            try:
                candidate = self._free.pop()
            except IndexError:
                break
            if size <= len(candidate) <= 2 * size + _PAGE:
                buffer = candidate
                break
            others.append(candidate)
        self._free.extend(reversed(others))
        if buffer is None:
            buffer = np.empty(int(size * _GROWTH) + 2 * _ALIGNMENT, np.uint8)
            buffer = buffer[-buffer.ctypes.data % _ALIGNMENT :]
        return buffer


_pool = Pool()


class Primitive(NamedTuple):
    """Kernels, columns of the tables, and outputs of 3D Gaussians or of surfels.

    Attributes:
        project, sweep_forward, sweep_backward, gather, project_backward: The kernels, in their order.
        outputs: What is composited, from the images wanted, fields of ``layout.Images``.
        scales: Scales of a Gaussian.
        circle: Whether Gaussians also reach a circle, the low-pass filter's: outlines differ from records then.
        constant_images: Images without derivatives.
        first_channel: First of the channels' columns of records, the colour's.
        first_sum: First of the channels' columns of sums.
    """

    project: Callable[..., None]
    sweep_forward: Callable[..., None]
    sweep_backward: Callable[..., None]
    gather: Callable[..., None]
    project_backward: Callable[..., None]
    outputs: Callable[[Collection[str]], layout.Outputs]
    scales: int
    circle: bool
    constant_images: tuple[str, ...]
    first_channel: int
    first_sum: int


def _gaussian_outputs(images: Collection[str]) -> layout.Outputs:
    """The channels up to the last one wanted, and the median."""
    channels = 8 if "normals" in images else 5 if "inverse_depth" in images else 4 if "depth" in images else 3
    return layout.Outputs(layout.count(channels), median=layout.count("median" in images))


def _surfel_outputs(images: Collection[str]) -> layout.Outputs:
    """Colour, normals where wanted, and the measures wanted."""
    measures = {name: layout.count(name in images) for name in ("depth", "inverse_depth", "median", "distortion")}
    return layout.Outputs(layout.count(3), layout.count(3 * ("normals" in images)), **measures)


GAUSSIANS = Primitive(
    projection.project,
    sweep_forward.sweep,
    sweep_backward.sweep,
    projection_backward.gather,
    projection_backward.project_backward,
    outputs=_gaussian_outputs,
    scales=3,
    circle=False,
    constant_images=("median",),
    first_channel=layout.CHANNELS,
    first_sum=layout.SUM_CHANNELS,
)
SURFELS = Primitive(
    projection.project_surfels,
    sweep_forward.sweep_surfels,
    sweep_backward.sweep_surfels,
    projection_backward.gather_surfels,
    projection_backward.project_surfels_backward,
    outputs=_surfel_outputs,
    scales=2,
    circle=True,
    constant_images=(),
    first_channel=layout.SURFEL_CHANNELS,
    first_sum=layout.SURFEL_SUM_CHANNELS,
)


class Layer(NamedTuple):
    """Input of a forward and a backward sweep: projected Gaussians, the view, numbers to composite, and images by name."""

    projections: layout.Projections
    view: Array
    outputs: layout.Outputs
    images: Collection[str]


class Pipeline:
    """Rendering of N Gaussians, or surfels, from one camera, stage by stage, with the tables between the stages.

    ``view`` is that of ``layout``; ``wanted`` are the images to draw, fields of ``layout.Images``; depth is among them if
    expected is.
    """

    def __init__(self, primitive: Primitive, view: Array, width: int, height: int, wanted: Collection[str]) -> None:
        columns = -(-width // layout.TILE)
        self.primitive = primitive
        self._view = view
        self._grid = layout.Grid(width, height, columns, columns * -(-height // layout.TILE))
        self._wanted = wanted
        self._outputs = primitive.outputs(wanted)
        self._crew = Crew()
        self._count = 0
        self._projections: layout.Projections
        self._bins: layout.Bins

    # --- projection ---------------------------------------------------------------------------------------------------

    def project(self, gaussians: layout.Parameters) -> tuple[Array, Array, Array]:
        """Project Gaussians, and list those of each tile.

        Returns projected centres in pixels [N, 2], radii in pixels [N], and a table without content of the shape of the
        Gaussians' sums, which stands for all else in the graph of derivatives.

        Raises:
            UnusableGaussianError: One is not finite, has no direction or a negative scale.
            TooManyPairsError: They cover too many tiles.
        """
        self._count = count = len(gaussians.opacities)
        filled, circle, take = self._filled, self.primitive.circle, _pool.take
        records = take(layout.ROW * filled)
        self._projections = layout.Projections(
            records=records,
            outlines=take(len(records)) if circle else records,
            remainders=take(2 * filled * circle),
            depths=take(filled),
            bounds=take(4 * filled),
            drawn=take(filled // layout.GROUP, dtype=np.int64),
            parcels=take(2 * -(-count // layout.PARCEL), dtype=np.int64),
        )
        means2d, radii = take(filled, 2), take(filled)
        written = (self._projections, means2d.reshape(-1), radii)
        self._crew.run(self.primitive.project, self._padded(gaussians), self._view, "normals" in self._wanted, *written)
        if count and self._projections.parcels[::2].min() < 0:
            raise UnusableGaussianError
        self._bin()
        return means2d[:count], radii[:count], take(self._sums_size(self._outputs, filled))

    def project_backward(
        self, gaussians: layout.Parameters, of_means2d: Array | None, gaussian_sums: Array | None
    ) -> tuple[layout.Parameters, Array]:
        """Derivatives of :meth:`project`, given that of the projected centres and the Gaussians' sums; None where 0.

        Returns those with respect to the Gaussians, and to the upper three rows of ``camera_to_world``. [3, 4]
        """
        filled, outputs = self._filled, self._outputs
        centers = np.zeros((filled, 2), np.float32)
        if of_means2d is not None:
            centers[: self._count] = of_means2d
        if gaussian_sums is None:
            gaussian_sums = np.zeros(self._sums_size(outputs, filled), np.float32)
        of_pose = _pool.take(layout.ROW * -(-self._count // layout.PARCEL))
        results = layout.Parameters(*(_pool.take(filled, width) for width in self._widths))
        flat = layout.Parameters(*(result.reshape(-1) for result in results))
        channels = len(outputs.channels) + len(outputs.normals)
        given = (channels, self._projections, gaussian_sums, centers.reshape(-1))
        self._crew.run(self.primitive.project_backward, self._padded(gaussians), self._view, *given, flat, of_pose)
        columns = of_pose.reshape(-1, layout.ROW)[:, :12].sum(axis=0, dtype=np.float64).reshape(4, 3)
        return layout.Parameters(*(result[: self._count] for result in results)), columns.T

    @property
    def _filled(self) -> int:
        """Number of Gaussians with the last group filled up."""
        return self._count + -self._count % layout.GROUP

    @property
    def _widths(self) -> tuple[int, ...]:
        """Numbers of a Gaussian in each of ``layout.Parameters``."""
        return 3, 4, self.primitive.scales, 1, 3

    def _padded(self, gaussians: layout.Parameters) -> layout.Parameters:
        """The Gaussians with the last group filled up by ones that are not drawn."""
        padded = []
        for array, width, filling in zip(gaussians, self._widths, (0.0, 1.0, 0.0, 0.0, 0.0), strict=True):
            whole = array
            if self._filled > self._count:
                whole = _pool.take(width * self._filled)
                whole[: len(array)], whole[len(array) :] = array, filling
            padded.append(whole)
        return layout.Parameters(*padded)

    def _bin(self) -> None:
        """List the Gaussians of each tile, front to back."""
        take, grid, crew = _pool.take, self._grid, self._crew
        nearest_first = self._nearest_first()
        drawn, within_bounds = len(nearest_first), int(self._projections.parcels[1::2].sum())
        if within_bounds > _MOST_PAIRS:
            raise TooManyPairsError(within_bounds)
        stretches = crew.size * _PIECES if crew.size > 1 else 1
        pairs = layout.Pairs(
            *(take(within_bounds, dtype=np.int32) for _ in range(3)),
            begins=take(stretches, dtype=np.int64),
            ends=take(stretches, dtype=np.int64),
            tile_counts=take(stretches * grid.tiles, dtype=np.int32),
        )
        entry_counts, circle = take(drawn, dtype=np.int32), layout.count(self.primitive.circle)
        given = (self._projections, self._view, grid, circle, nearest_first)
        crew.run(tiles.find_pairs, *given, pairs, entry_counts)
        counts = pairs.tile_counts.reshape(stretches, grid.tiles)
        ends = counts.T.cumsum(dtype=np.int64).reshape(grid.tiles, stretches)
        counts[:] = ends.T - counts
        starts = np.append(0, ends[:, -1])
        self._bins = layout.Bins(
            nearest_first=nearest_first,
            entry_counts=entry_counts,
            stretch_entries=np.append(0, np.cumsum(pairs.ends - pairs.begins)),
            cells=take(layout.CELL * within_bounds, dtype=np.int32),
            starts=starts,
            order=np.argsort(-np.diff(starts), kind="stable"),
            reached=take(grid.tiles, dtype=np.int64),
        )
        crew.run(tiles.sort_pairs, grid, pairs, self._bins)

    def _nearest_first(self) -> Array:
        """Indices of the Gaussians drawn; those of equal depth keep their order."""
        flags = self._projections.drawn[:, None] >> np.arange(layout.GROUP)
        index = np.flatnonzero(flags & 1)
        # The bits of positive floats order as the numbers do; numpy's stable sort of 16 bits is a radix sort.
        for shift in (0, 16):
            digits = (self._projections.depths[index].view(np.uint32) >> shift).astype(np.uint16)
            index = index[np.argsort(digits, kind="stable")]
        return index

    # --- compositing --------------------------------------------------------------------------------------------------

    def layer(self, colors: Array | None) -> Layer:
        """All images wanted; or other colours alone, over black. [N, 3]"""
        if colors is None:
            return Layer(self._projections, self._view, self._outputs, self._wanted)
        records, view = self._projections.records.copy(), self._view.copy()
        first = self.primitive.first_channel
        self._rows(records)[:, first : first + 3] = colors
        view[layout.VIEW_BACKGROUND : layout.VIEW_BACKGROUND + 3] = 0.0
        return Layer(self._projections._replace(records=records), view, layout.Outputs(layout.count(3)), ("rgb",))

    def composite(self, layer: Layer) -> tuple[layout.Images, Array]:
        """Images, [H, W, 3] or [H, W], None where not wanted; and what :meth:`composite_backward` needs."""
        size = (self._grid.height, self._grid.width)
        shapes = {name: (*size, 3) if name in ("rgb", "normals") else size for name in layer.images}
        images = [_pool.take(*shapes[name]) if name in shapes else None for name in layout.Images._fields]
        vectors = layout.BLOCKS * self._grid.tiles * tiles.composited_vectors(layer.outputs)
        composited = _pool.take(16 * vectors)
        self._sweep(self.primitive.sweep_forward, layer, composited, _flat_images(images))
        return layout.Images(*images), composited

    def composite_backward(
        self, layer: Layer, composited: Array, of_images: Iterable[Array | None]
    ) -> tuple[Array, Array]:
        """Derivatives of :meth:`composite`, given those with respect to the images, None where 0.

        Returns the derivative with respect to the projected centres [N, 2], and the sums of each Gaussian.
        """
        filled, seventeen = self._filled, self._sums(layer.outputs) > layout.ROW
        entry_sums = _pool.take(self._sums_size(layer.outputs, int(self._bins.starts[-1])))
        sums, of_means2d = _pool.take(self._sums_size(self._outputs, filled)), _pool.take(filled, 2)
        sums[layout.ROW * filled :] = 0.0
        self._sweep(self.primitive.sweep_backward, layer, composited, _flat_images(of_images), seventeen, entry_sums)
        gathered = (seventeen, entry_sums, sums, of_means2d.reshape(-1))
        self._crew.run(self.primitive.gather, layer.projections, self._bins, layer.view, *gathered)
        return of_means2d[: self._count], sums

    def split_colors(self, sums: Array) -> Array:
        """Take the derivative with respect to a layer's colours, [N, 3], out of its sums, which leaves 0 behind."""
        channels = self._rows(sums)[:, self.primitive.first_sum :]
        of_colors = channels[:, :3].copy()
        channels[:] = 0.0
        return of_colors

    def _rows(self, table: Array) -> Array:
        """The rows of all Gaussians in a table of records or sums. [N, 16]"""
        return table[: layout.ROW * self._count].reshape(-1, layout.ROW)

    def _sums(self, outputs: layout.Outputs) -> int:
        """Number of sums of each Gaussian and entry."""
        return self.primitive.first_sum + len(outputs.channels) + len(outputs.normals)

    def _sums_size(self, outputs: layout.Outputs, rows: int) -> int:
        """Length of the table of sums of ``rows`` Gaussians or entries: 16 floats each, 17 if there are too many sums."""
        return (layout.ROW + (self._sums(outputs) > layout.ROW)) * rows

    def _sweep(self, kernel: Callable[..., None], layer: Layer, *tables: Any) -> None:
        """Run a sweep, which takes or writes the tables."""
        threads = self._crew.size
        integers = _pool.take(threads * tiles.INTEGERS, dtype=np.int32)
        scratch = layout.Scratch(_pool.take(threads * tiles.NUMBERS), integers)
        self._crew.run(kernel, layer.projections, self._bins, layer.view, self._grid, layer.outputs, scratch, *tables)


def _flat_images(images: Iterable[Array | None]) -> layout.Images:
    return layout.Images(*(np.empty(0, np.float32) if image is None else image.reshape(-1) for image in images))


# --- autograd ---------------------------------------------------------------------------------------------------------


def render(
    gaussians: Iterable[Tensor], features: Sequence[Tensor], pose: Tensor, pipeline: Pipeline
) -> tuple[Tensor, Tensor, dict[str, Tensor], Sequence[Tensor]]:
    """Render one view on a new pipeline; differentiable, once, in all tensors.

    ``gaussians`` are float32 tensors on the CPU, checked for shape, in the order of ``layout.Parameters``; ``features`` are
    further channels to composite, [N, C] each; ``pose`` is the camera_to_world that the pipeline was made with.

    Returns:
        means2d, which holds its gradient after ``backward``; radii; the images by the names of ``layout.Images``, None where
        not wanted; and the features' images, [H, W, C] each.

    Raises:
        UnusableGaussianError, TooManyPairsError: See :meth:`Pipeline.project`.
    """
    means2d, links, radii = _Project.apply(*gaussians, pose, pipeline)  # type: ignore[no-untyped-call]
    if means2d.requires_grad:
        means2d.retain_grad()
    images = _Composite.apply(means2d, links, None, pipeline)  # type: ignore[no-untyped-call]
    by_name = dict(zip(layout.Images._fields, images, strict=True))
    if not features:
        return means2d, radii, by_name, ()
    widths = [feature.shape[1] for feature in features]
    channels = torch.nn.functional.pad(torch.cat(list(features), dim=1), (0, -sum(widths) % 3))
    parts = [_Composite.apply(means2d, links, part, pipeline)[0] for part in channels.split(3, dim=1)]  # type: ignore[no-untyped-call]
    return means2d, radii, by_name, torch.cat(parts, dim=-1)[..., : sum(widths)].split(widths, dim=-1)


class _Project(torch.autograd.Function):
    """Gaussians -> projected centres, links, radii."""

    @staticmethod
    def forward(ctx: FunctionCtx, *arguments: Tensor | Pipeline) -> tuple[Tensor, Tensor, Tensor]:
        *gaussians, _, pipeline = arguments
        means2d, radii, links = (torch.from_numpy(array) for array in pipeline.project(_flat_gaussians(gaussians)))
        ctx.save_for_backward(*gaussians)
        ctx.pipeline = pipeline
        ctx.set_materialize_grads(False)
        ctx.mark_non_differentiable(radii)
        return means2d, links, radii

    @staticmethod
    @once_differentiable
    def backward(
        ctx: FunctionCtx, of_means2d: Tensor | None, sums: Tensor | None, of_radii: None
    ) -> tuple[Tensor | None, ...]:
        gaussians = _flat_gaussians(ctx.saved_tensors)
        derivatives, of_pose = ctx.pipeline.project_backward(gaussians, _array(of_means2d), _array(sums))
        means, quats, scales, opacities, colors = (torch.from_numpy(array) for array in derivatives)
        pose = torch.zeros(4, 4)
        pose[:3] = torch.from_numpy(of_pose)
        return means, quats, scales, opacities[:, 0], colors, pose, None


class _Composite(torch.autograd.Function):
    """Projected centres and links -> images; or, of other colours than the Gaussians' own, one image. [N, 3]"""

    @staticmethod
    def forward(
        ctx: FunctionCtx, means2d: Tensor, links: Tensor, colors: Tensor | None, pipeline: Pipeline
    ) -> tuple[Tensor | None, ...]:
        ctx.pipeline, ctx.recolored = pipeline, colors is not None
        ctx.layer = pipeline.layer(_array(colors))
        arrays, ctx.composited = pipeline.composite(ctx.layer)
        images = layout.Images(*(None if array is None else torch.from_numpy(array) for array in arrays))
        ctx.set_materialize_grads(False)
        constant = [getattr(images, name) for name in pipeline.primitive.constant_images]
        ctx.mark_non_differentiable(*(image for image in constant if image is not None))
        return tuple(images)

    @staticmethod
    @once_differentiable
    def backward(ctx: FunctionCtx, *of_images: Tensor | None) -> tuple[Tensor | None, ...]:
        if all(gradient is None for gradient in of_images):
            return None, None, None, None
        arrays = [_array(gradient) for gradient in of_images]
        of_means2d, sums = ctx.pipeline.composite_backward(ctx.layer, ctx.composited, arrays)
        of_colors = torch.from_numpy(ctx.pipeline.split_colors(sums)) if ctx.recolored else None
        return torch.from_numpy(of_means2d), torch.from_numpy(sums), of_colors, None


def _array(tensor: Tensor | None) -> Array | None:
    return None if tensor is None else tensor.detach().contiguous().numpy()


def _flat_gaussians(tensors: Iterable[Tensor]) -> layout.Parameters:
    return layout.Parameters(*tables(*tensors))
