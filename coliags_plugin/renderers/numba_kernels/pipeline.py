"""Execution of the kernels in order, and their memory."""

from __future__ import annotations

from collections.abc import Callable, Collection
from typing import Any, NamedTuple

import numpy as np

from coliags_plugin.core.numba_kernels.compilation import Array
from coliags_plugin.core.numba_kernels.threads import Runner, workers
from coliags_plugin.renderers.numba_kernels import (
    binning,
    layout,
    projection,
    projection_backward,
    sweep_backward,
    sweep_forward,
    tiles,
)
from coliags_plugin.renderers.numba_kernels.buffers import ArenaPool, Results

#: Pieces of work per thread where their costs differ.
_PIECES = 8
#: Fewer Gaussians are sorted by one thread: bringing others in several times over costs more than they gain.
_WORTH_SHARING_SORT = 1 << 17
#: Largest number of pairs of the lists.
_MOST_PAIRS = 2**31 - 1

_arenas = ArenaPool()
_results = Results()


class UnusableGaussianError(Exception):
    """A Gaussian cannot be projected; the caller determines which and why."""


class TooManyPairsError(Exception):
    """The Gaussians cover more tiles than the lists can hold; the argument is the number of tiles."""


class Primitive(NamedTuple):
    """Kernels, columns of the tables, and outputs of 3D Gaussians or of surfels.

    Attributes:
        project, sweep_forward, sweep_backward, gather, project_backward: The kernels, in their order.
        outputs: What is composited, from the images wanted, fields of ``layout.Images``.
        scales: Scales of a Gaussian.
        circle: Whether Gaussians also reach a circle, the low-pass filter's: outlines differ from records then.
        constant_images: Images without derivatives.
        first_channel: First of the channels' columns of records.
        first_sum: First of the channels' columns of sums.
        feature_channels: How many feature channels one sweep composites.
        feature_images: The images that hold them.
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
    feature_channels: int
    feature_images: tuple[str, ...]


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
    feature_channels=layout.MAX_CHANNELS,
    feature_images=("rgb", "depth", "inverse_depth", "normals"),
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
    feature_channels=3,  # as colours alone, whose kernels serve
    feature_images=("rgb",),
)


class Layer(NamedTuple):
    """Inputs of one forward and backward sweep: projected Gaussians, the view, and what is composited."""

    projections: layout.Projections
    view: Array
    outputs: layout.Outputs


class Pipeline:
    """Rendering of N Gaussians, or surfels, from one camera, stage by stage, with the intermediate tables.

    ``view`` is that of ``layout``; ``wanted`` are the images to draw, fields of ``layout.Images``; depth is among them if
    expected is.
    """

    def __init__(self, primitive: Primitive, view: Array, width: int, height: int, wanted: Collection[str]) -> None:
        columns = -(-width // layout.TILE)
        self._primitive = primitive
        self._view = view
        self._grid = layout.Grid(width, height, columns, columns * -(-height // layout.TILE))
        self._wanted = wanted
        self._outputs = primitive.outputs(wanted)
        self._arena = _arenas.lend(self)
        self._count = 0
        self._tail: layout.Parameters
        self._projections: layout.Projections
        self._bins: layout.Bins
        self._composited: Array
        self._feature_composited: Array

    @property
    def constant_images(self) -> tuple[str, ...]:
        """Images without derivatives."""
        return self._primitive.constant_images

    @property
    def _main_layer(self) -> Layer:
        """Colours and all that is wanted besides."""
        return Layer(self._projections, self._view, self._outputs)

    def _sums(self, outputs: layout.Outputs) -> int:
        """Sums of each Gaussian and entry."""
        return self._primitive.first_sum + len(outputs.channels) + len(outputs.normals)

    def _sums_size(self, outputs: layout.Outputs, rows: int) -> int:
        """Length of the table of sums of ``rows`` Gaussians or entries: 16 floats each, 17 if there are too many sums."""
        return (layout.ROW + (self._sums(outputs) > layout.ROW)) * rows

    def _sweep(self, run: Runner, kernel: Callable[..., None], layer: Layer, *tables: Any) -> None:
        """Run a sweep, which takes or writes the tables."""
        numbers = self._arena.take("numbers", run.workers * tiles.NUMBERS)
        scratch = layout.Scratch(numbers, self._arena.take("integers", run.workers * tiles.INTEGERS, np.int32))
        run(kernel, layer.projections, self._bins, layer.view, self._grid, layer.outputs, scratch, *tables)

    def _sweep_backward(
        self, run: Runner, layer: Layer, composited: Array, of_images: layout.Images, sums: Array, of_means2d: Array
    ) -> None:
        """Find the sums of Gaussians, and the derivative with respect to the projected centres."""
        entry_sums = self._arena.take("entry_sums", self._sums_size(layer.outputs, int(self._bins.starts[-1])))
        seventeen = self._sums(layer.outputs) > layout.ROW
        tables = (composited, _flat_images(of_images), seventeen, entry_sums)
        self._sweep(run, self._primitive.sweep_backward, layer, *tables)
        gathered = (entry_sums, sums, of_means2d.reshape(-1))
        run(self._primitive.gather, layer.projections, self._bins, layer.view, seventeen, *gathered)

    # --- stages -------------------------------------------------------------------------------------------------------

    def project(self, gaussians: layout.Parameters) -> tuple[Array, Array, Array]:
        """Project Gaussians; UnusableGaussianError where one is not finite, has no direction or a negative scale.

        Returns projected centres in pixels [N, 2], radii in pixels [N], and a table without content of the shape of the Gaussians'
        sums, which stands for all else in the graph of derivatives.
        """
        self._count = count = len(gaussians.opacities)
        groups, filled, take = -(-count // layout.GROUP), self._filled, self._arena.take
        self._tail = _tail(gaussians, count, self._primitive.scales)
        records = take("records", layout.ROW * filled)
        self._projections = layout.Projections(
            records=records,
            outlines=take("outlines", len(records)) if self._primitive.circle else records,
            remainders=take("remainders", 2 * filled * self._primitive.circle),
            depths=take("depths", filled),
            bounds=take("bounds", 4 * filled),
            drawn=take("drawn", groups, np.int64),
            parcels=take("parcels", 2 * -(-count // layout.PARCEL), np.int64),
        )
        means2d, radii = _results.take(filled, 2), _results.take(filled)
        written = (self._projections, means2d.reshape(-1), radii)
        with workers() as run:
            normals = "normals" in self._wanted
            run(self._primitive.project, count, gaussians, self._tail, self._view, normals, *written)
        if count and self._projections.parcels[::2].min() < 0:
            raise UnusableGaussianError
        return means2d[:count], radii[:count], take("links", self._sums_size(self._outputs, filled))

    def composite(self) -> layout.Images:
        """Draw the Gaussians projected: [H, W, 3] or [H, W], None where not wanted. May raise TooManyPairsError."""
        layer = self._main_layer
        images = self._images(self._wanted, _results.take)
        with workers() as run:
            self._bin(run)
            self._composited = self._arena.take("composited", self._composited_size(layer.outputs))
            self._sweep(run, self._primitive.sweep_forward, layer, self._composited, _flat_images(images))
        return images

    def composite_features(self, features: Array) -> Array:
        """Composite features [N, C] over 0, after :meth:`composite` and over the same bins: [H, W, C].

        Some channels at a time take the place of the others in the records.
        """
        grid, width, count = self._grid, self._primitive.feature_channels, features.shape[1]
        sweeps = -(-count // width)
        size = self._composited_size(self._feature_outputs)
        result = np.empty((grid.height, grid.width, width * sweeps), np.float32)
        self._feature_composited = self._arena.take("feature_composited", sweeps * size)
        with workers() as run:
            for sweep in range(sweeps):
                layer, images = self._features_layer(features, sweep), self._feature_images()
                composited = self._feature_composited[sweep * size : (sweep + 1) * size]
                self._sweep(run, self._primitive.sweep_forward, layer, composited, _flat_images(images))
                result[..., width * sweep : width * (sweep + 1)] = self._joined(images)
        return result[..., :count]

    def composite_features_backward(self, features: Array, of_features: Array) -> tuple[Array, Array, Array]:
        """Derivatives of :meth:`composite_features`, given those with respect to its result. [H, W, C]

        Returns the derivative with respect to the projected centres [N, 2], the sums of each Gaussian without those of the
        channels, and the derivative with respect to the features [N, C].
        """
        width, filled, first_sum = self._primitive.feature_channels, self._filled, self._primitive.first_sum
        size = self._composited_size(self._feature_outputs)
        part, of_part = self._arena.take("feature_sums", layout.ROW * filled), np.empty((filled, 2), np.float32)
        total, of_means2d = np.zeros((filled, layout.ROW), np.float32), np.zeros((filled, 2), np.float32)
        result = np.empty_like(features)
        with workers() as run:
            for first in range(0, features.shape[1], width):
                sweep = first // width
                of_images = self._feature_images()
                self._part_into(of_features[..., first : first + width], of_images)
                layer = self._features_layer(features, sweep)
                composited = self._feature_composited[sweep * size : (sweep + 1) * size]
                self._sweep_backward(run, layer, composited, of_images, part, of_part)
                rows = part.reshape(filled, layout.ROW)
                total[:, :first_sum] += rows[:, :first_sum]
                of_means2d += of_part
                columns = min(width, features.shape[1] - first)
                result[:, first : first + columns] = rows[: self._count, first_sum : first_sum + columns]
        sums = np.zeros(self._sums_size(self._outputs, filled), np.float32)
        sums[: layout.ROW * filled] = total.reshape(-1)
        return of_means2d[: self._count], sums, result

    def composite_backward(self, of_images: layout.Images) -> tuple[Array, Array]:
        """Derivatives of :meth:`composite`, any number of times, given those with respect to the images, None where 0.

        Returns the derivative with respect to the projected centres [N, 2], and the sums of each Gaussian, which are good until
        the next call.
        """
        layer, filled = self._main_layer, self._filled
        gaussian_sums = self._arena.take("gaussian_sums", self._sums_size(layer.outputs, filled))
        of_means2d = _results.take(filled, 2)
        with workers() as run:
            self._sweep_backward(run, layer, self._composited, of_images, gaussian_sums, of_means2d)
        return of_means2d[: self._count], gaussian_sums

    def project_backward(
        self, gaussians: layout.Parameters, of_means2d: Array | None, gaussian_sums: Array | None
    ) -> tuple[layout.Parameters, Array]:
        """Derivatives of :meth:`project`, given that of the projected centres and the Gaussians' sums; None where 0.

        Returns those with respect to the Gaussians, and to the upper three rows of ``camera_to_world``. [3, 4]
        """
        filled, outputs = self._filled, self._outputs
        padded = self._arena.take("padded_means2d", 2 * filled)
        padded[: 2 * self._count] = 0.0 if of_means2d is None else of_means2d.reshape(-1)
        padded[2 * self._count :] = 0.0
        if gaussian_sums is None:
            gaussian_sums = np.zeros(self._sums_size(outputs, filled), np.float32)
        of_pose = self._arena.take("of_pose", layout.ROW * -(-self._count // layout.PARCEL))
        results = layout.Parameters(*(_results.take(filled, width) for width in (3, 4, self._primitive.scales, 1, 3)))
        flat = layout.Parameters(*(result.reshape(-1) for result in results))
        channels = len(outputs.channels) + len(outputs.normals)
        tables = (channels, self._projections, gaussian_sums, padded, flat, of_pose)
        with workers() as run:
            run(self._primitive.project_backward, self._count, gaussians, self._tail, self._view, *tables)
        columns = of_pose.reshape(-1, layout.ROW)[:, :12].sum(axis=0, dtype=np.float64).reshape(4, 3)
        return layout.Parameters(*(result[: self._count] for result in results)), columns.T

    # --- features -----------------------------------------------------------------------------------------------------

    @property
    def _feature_outputs(self) -> layout.Outputs:
        return layout.Outputs(layout.count(self._primitive.feature_channels))

    def _features_layer(self, features: Array, sweep: int) -> Layer:
        """A part of the features as channels, over black."""
        width = self._primitive.feature_channels
        part = features[:, width * sweep : width * (sweep + 1)]
        records = self._arena.take("feature_records", len(self._projections.records))
        records[:] = self._projections.records
        rows = records.reshape(-1, layout.ROW)[: self._count, self._primitive.first_channel :]
        rows[:, :width] = 0.0
        rows[:, : part.shape[1]] = part
        view = self._view.copy()
        view[layout.VIEW_BACKGROUND : layout.VIEW_BACKGROUND + 3] = 0.0
        return Layer(self._projections._replace(records=records), view, self._feature_outputs)

    def _feature_images(self) -> layout.Images:
        """Images for the channels of a sweep."""
        return self._images(self._primitive.feature_images, lambda *shape: np.zeros(shape, np.float32))

    def _images(self, names: Collection[str], make: Callable[..., Array]) -> layout.Images:
        """Images of these names made from their shapes, None for the others."""
        size = (self._grid.height, self._grid.width)
        shapes = {name: (*size, 3) if name in ("rgb", "normals") else size for name in names}
        return layout.Images(*(make(*shapes[name]) if name in names else None for name in layout.Images._fields))

    def _joined(self, images: layout.Images) -> Array:
        """The channels of a sweep from the images that hold them. [H, W, feature_channels]"""
        size = (self._grid.height, self._grid.width, -1)
        parts = [getattr(images, name).reshape(size) for name in self._primitive.feature_images]
        return np.concatenate(parts, axis=-1)[..., : self._primitive.feature_channels]

    def _part_into(self, channels: Array, images: layout.Images) -> None:
        """Split at most as many channels into images; the inverse of :meth:`_joined`. [H, W, C]"""
        size, first = (self._grid.height, self._grid.width, -1), 0
        for name in self._primitive.feature_images:
            image = getattr(images, name).reshape(size)
            part = channels[..., first : first + image.shape[2]]
            image[..., : part.shape[2]] = part
            first += image.shape[2]

    # --- bins ---------------------------------------------------------------------------------------------------------

    def _bin(self, run: Runner) -> None:
        """List the Gaussians of each tile."""
        take, grid = self._arena.take, self._grid
        drawn, within_bounds = (int(total) for total in self._projections.parcels.reshape(-1, 2).sum(axis=0))
        if within_bounds > _MOST_PAIRS:
            raise TooManyPairsError(within_bounds)
        stretches = run.workers * _PIECES if run.workers > 1 else 1
        self._bins = bins = layout.Bins(
            keys=self._sorted_keys(run, drawn),
            entry_counts=take("entry_counts", drawn, np.int32),
            stretch_entries=take("stretch_entries", stretches + 1, np.int64),
            cells=take("cells", layout.CELL * within_bounds, np.int32),
            starts=take("starts", grid.tiles + 1, np.int64),
            order=take("order", grid.tiles, np.int64),
            reached=take("reached", grid.tiles, np.int64),
        )
        pairs = layout.Pairs(
            gaussian=take("pair_gaussian", within_bounds, np.int32),
            tile=take("pair_tile", within_bounds, np.int32),
            blocks=take("pair_blocks", within_bounds, np.int32),
            begins=take("pair_begins", stretches, np.int64),
            ends=take("pair_ends", stretches, np.int64),
            tile_counts=take("tile_counts", stretches * grid.tiles, np.int32),
        )
        circle = layout.count(self._primitive.circle)
        run(binning.find_pairs, self._projections, self._view, grid, circle, bins.keys, pairs, bins.entry_counts)
        binning.place_entries(grid, pairs, bins)
        run(binning.sort_pairs, grid, pairs, bins)

    def _sorted_keys(self, run: Runner, drawn: int) -> Array:
        """Indices of the Gaussians drawn, nearest first."""
        take = self._arena.take
        keys, moved = take("keys", drawn, np.int64), take("moved", drawn, np.int64)
        if not drawn:
            return keys
        if drawn < _WORTH_SHARING_SORT:
            run = Runner(1)
        counts = self._projections.parcels[::2]
        lowest, highest = np.empty_like(counts), np.empty_like(counts)
        depth_bits = self._projections.depths.view(np.int32)
        run(binning.collect, depth_bits, self._projections.drawn, np.cumsum(counts) - counts, keys, lowest, highest)
        least = int(lowest.min())
        significant = (int(highest.max()) - least).bit_length()
        passes = -(-significant // binning.DIGIT_BITS)
        digits = take("digits", run.workers * binning.DIGITS, np.int32)
        for turn in range(passes):
            width = -(-significant // passes)
            arguments = (run.workers, keys, least, turn * width, (1 << width) - 1, digits)
            run(binning.count_digits, *arguments)
            binning.place_digits(run.workers, (1 << width) - 1, digits)
            run(binning.move_by_digit, *arguments, moved)
            keys, moved = moved, keys
        return keys

    @property
    def _filled(self) -> int:
        """Gaussians with the last group filled up."""
        return self._count + -self._count % layout.GROUP

    def _composited_size(self, outputs: layout.Outputs) -> int:
        """Numbers that a forward sweep leaves."""
        return 16 * layout.BLOCKS * self._grid.tiles * tiles.composited_vectors(outputs)


def _flat_images(images: layout.Images) -> layout.Images:
    return layout.Images(*(np.empty(0, np.float32) if image is None else image.reshape(-1) for image in images))


def _tail(gaussians: layout.Parameters, count: int, scales: int) -> layout.Parameters:
    """The Gaussians behind the last full group, filled up with ones that are not drawn."""
    first = count // layout.GROUP * layout.GROUP
    tails = []
    for array, width, filling in zip(gaussians, (3, 4, scales, 1, 3), (0.0, 1.0, 0.0, 0.0, 0.0), strict=True):
        tail = np.full(layout.GROUP * width, filling, np.float32)
        tail[: width * (count - first)] = array[width * first :]
        tails.append(tail)
    return layout.Parameters(*tails)
