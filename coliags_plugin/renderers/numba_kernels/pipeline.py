"""Execution of the kernels in order, and their memory."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import numpy.typing as npt
import torch

from coliags_plugin.renderers.numba_kernels import binning, layout, sorting, sweep_backward, sweep_forward
from coliags_plugin.renderers.numba_kernels.buffers import ArenaPool, Results
from coliags_plugin.renderers.numba_kernels.projection import project
from coliags_plugin.renderers.numba_kernels.projection_backward import gather, project_backward
from coliags_plugin.renderers.numba_kernels.threads import Crew

Array = npt.NDArray[Any]

#: Pieces of work per thread where their costs differ.
_PIECES = 8
#: Fewer Gaussians are sorted by one thread: bringing others in several times over costs more than they gain.
_WORTH_SHARING_SORT = 1 << 17
#: Largest number of pairs of the lists.
_MOST_PAIRS = 2**31 - 1

_crew = Crew()
_arenas = ArenaPool()
_results = Results()


class UnusableGaussianError(Exception):
    """A Gaussian cannot be projected; the caller determines which and why."""


class TooManyPairsError(Exception):
    """The Gaussians cover more tiles than the lists can hold; the argument is the number of tiles."""


class Pipeline:
    """Rendering of N Gaussians from one camera, stage by stage, with the intermediate tables.

    Args:
        view: Camera and options, see ``layout``.
        width, height: Pixels.
        extras: What to composite besides colour.
        expected: Also depth over alpha; needs depth among the extras.
        median: Also the median depth.
    """

    def __init__(
        self, view: Array, width: int, height: int, extras: layout.Extras, expected: bool, median: bool
    ) -> None:
        columns = -(-width // layout.TILE)
        self._view = view
        self._grid = layout.Grid(width, height, columns, columns * -(-height // layout.TILE))
        self._extras = extras
        self._expected = expected
        self._median = (0,) * median
        self._channels = (0,) * (3 + extras.depth + extras.inverse_depth + 3 * extras.normals)
        self._arena = _arenas.lend(self)
        self._count = 0
        self._tail: layout.Parameters
        self._projections: layout.Projections
        self._bins: layout.Bins
        self._composited: Array
        self._feature_composited: Array

    def project(self, gaussians: layout.Parameters) -> tuple[Array, Array, Array]:
        """Project Gaussians.

        Returns:
            Projected centres in pixels, radii in pixels, and the records, padded to whole groups. [N, 2], [N], [16 each]

        Raises:
            UnusableGaussianError: One is not finite, has no direction or a negative scale.
        """
        self._count = count = len(gaussians.opacities)
        groups = -(-count // layout.GROUP)
        filled = groups * layout.GROUP
        take = self._arena.take
        self._tail = _tail(gaussians, count)
        self._projections = projections = layout.Projections(
            records=take("records", layout.ROW * filled),
            depths=take("depths", filled),
            bounds=take("bounds", 4 * filled),
            drawn=take("drawn", groups, np.int64),
            parcels=take("parcels", 2 * -(-count // layout.PARCEL), np.int64),
        )
        means2d, radii = _results.take(filled, 2), _results.take(filled)
        with _workers() as run:
            run(
                project, count, gaussians, self._tail, self._view, self._extras, projections, means2d.reshape(-1), radii
            )  # fmt: skip
        if count and projections.parcels[::2].min() < 0:
            raise UnusableGaussianError
        return means2d[:count], radii[:count], projections.records

    def composite(self) -> layout.Images:
        """Draw the Gaussians projected.

        Returns:
            [H, W, 3] or [H, W]; None where not wanted.

        Raises:
            TooManyPairsError: They cover too many tiles.
        """
        grid, extras = self._grid, self._extras
        wanted = (True, True, extras.depth, extras.inverse_depth, self._expected, extras.normals, bool(self._median))
        images = layout.Images(
            *(
                _results.take(grid.height, grid.width, *((3,) if name in ("rgb", "normals") else ())) if want else None
                for name, want in zip(layout.Images._fields, wanted, strict=True)
            )
        )
        size = layout.BLOCKS * grid.tiles * 16 * (1 + len(self._channels))
        with _workers() as run:
            self._bin(run)
            self._composited = self._arena.take("composited", size)
            run(
                sweep_forward.sweep_forward, self._projections, self._bins, self._view, grid, extras, self._channels,
                self._median, self._scratch(run, sweep_forward), self._composited, _flat_images(images),
            )  # fmt: skip
        return images

    def composite_features(self, features: Array) -> Array:
        """Composite further channels of the Gaussians over 0, after :meth:`composite` and over the same bins.

        Eight channels at a time take the place of colour, depths and normal in the records.

        Args:
            features: [N, C]

        Returns:
            [H, W, C]
        """
        grid, extras, width = self._grid, layout.FEATURES, layout.MAX_CHANNELS
        channels, count = (0,) * width, features.shape[1]
        size = layout.BLOCKS * grid.tiles * 16 * (1 + width)
        sweeps = -(-count // width)
        result = np.empty((grid.height, grid.width, width * sweeps), np.float32)
        self._feature_composited = self._arena.take("feature_composited", sweeps * size)
        with _workers() as run:
            for sweep in range(sweeps):
                images = self._feature_images()
                run(
                    sweep_forward.sweep_forward, self._with_features(features, sweep), self._bins, self._dark_view(),
                    grid, extras, channels, (), self._scratch(run, sweep_forward),
                    self._feature_composited[sweep * size : (sweep + 1) * size], _flat_images(images),
                )  # fmt: skip
                result[..., width * sweep : width * (sweep + 1)] = _joined(images)
        return result[..., :count]

    def composite_features_backward(self, features: Array, of_features: Array) -> tuple[Array, Array, Array]:
        """Derivatives of :meth:`composite_features`.

        Args:
            features: As given to it. [N, C]
            of_features: Derivative of the loss with respect to its result. [H, W, C]

        Returns:
            Derivative with respect to the projected centres, the sums of each Gaussian without those of the channels,
            and the derivative with respect to the features. [N, 2], [16 each], [N, C]
        """
        grid, width = self._grid, layout.MAX_CHANNELS
        filled = self._count + -self._count % layout.GROUP
        size = layout.BLOCKS * grid.tiles * 16 * (1 + width)
        entry_sums = self._arena.take("entry_sums", layout.ROW * int(self._bins.starts[-1]))
        part, of_part = self._arena.take("feature_sums", layout.ROW * filled), np.empty((filled, 2), np.float32)
        total, of_means2d = np.zeros((filled, layout.ROW), np.float32), np.zeros((filled, 2), np.float32)
        result = np.empty_like(features)
        with _workers() as run:
            for first in range(0, features.shape[1], width):
                sweep = first // width
                given = self._feature_images()
                _part_into(of_features[..., first : first + width], given)
                projections = self._with_features(features, sweep)
                run(
                    sweep_backward.sweep_backward, projections, self._bins, self._dark_view(), grid, layout.FEATURES,
                    (0,) * width, self._scratch(run, sweep_backward),
                    self._feature_composited[sweep * size : (sweep + 1) * size], _flat_images(given), entry_sums,
                )  # fmt: skip
                run(gather, projections, self._bins, entry_sums, part, of_part.reshape(-1))
                rows = part.reshape(filled, layout.ROW)
                total[:, : layout.SUM_CHANNELS] += rows[:, : layout.SUM_CHANNELS]
                of_means2d += of_part
                columns = min(width, features.shape[1] - first)
                channels = rows[: self._count, layout.SUM_CHANNELS : layout.SUM_CHANNELS + columns]
                result[:, first : first + columns] = channels
        return of_means2d[: self._count], total.reshape(-1), result

    def _with_features(self, features: Array, sweep: int) -> layout.Projections:
        """The projections with a part of the features as channels."""
        width = layout.MAX_CHANNELS
        part = features[:, width * sweep : width * (sweep + 1)]
        records = self._arena.take("feature_records", len(self._projections.records))
        records[:] = self._projections.records
        rows = records.reshape(-1, layout.ROW)[: self._count]
        rows[:, layout.CHANNELS : layout.CHANNELS + width] = 0.0
        rows[:, layout.CHANNELS : layout.CHANNELS + part.shape[1]] = part
        return self._projections._replace(records=records)

    def _dark_view(self) -> Array:
        """The view with a black background."""
        view = self._view.copy()
        view[layout.VIEW_BACKGROUND : layout.VIEW_BACKGROUND + 3] = 0.0
        return view

    def _feature_images(self) -> layout.Images:
        """Images for eight channels."""
        height, width = self._grid.height, self._grid.width
        rgb, normals = (np.zeros((height, width, 3), np.float32) for _ in range(2))
        depth, inverse_depth = (np.zeros((height, width), np.float32) for _ in range(2))
        return layout.Images(rgb, None, depth, inverse_depth, None, normals, None)

    def composite_backward(self, of_images: layout.Images) -> tuple[Array, Array]:
        """Derivatives of :meth:`composite`, any number of times.

        Args:
            of_images: Derivatives of the loss with respect to the images; None where 0.

        Returns:
            Derivative with respect to the projected centres, and the sums of each Gaussian, which are good until the
            next call. [N, 2], [16 each]
        """
        filled = self._count + -self._count % layout.GROUP
        entry_sums = self._arena.take("entry_sums", layout.ROW * int(self._bins.starts[-1]))
        gaussian_sums = self._arena.take("gaussian_sums", layout.ROW * filled)
        of_means2d = _results.take(filled, 2)
        with _workers() as run:
            run(
                sweep_backward.sweep_backward, self._projections, self._bins, self._view, self._grid, self._extras,
                self._channels, self._scratch(run, sweep_backward), self._composited, _flat_images(of_images),
                entry_sums,
            )  # fmt: skip
            run(gather, self._projections, self._bins, entry_sums, gaussian_sums, of_means2d.reshape(-1))
        return of_means2d[: self._count], gaussian_sums

    def project_backward(
        self, gaussians: layout.Parameters, of_means2d: Array | None, gaussian_sums: Array | None
    ) -> tuple[layout.Parameters, Array]:
        """Derivatives of :meth:`project`.

        Args:
            gaussians: Those that were projected.
            of_means2d: Derivative of the loss with respect to the projected centres; None for 0. [N, 2]
            gaussian_sums: What :meth:`composite_backward` gave; None for 0.

        Returns:
            Derivatives with respect to the Gaussians, and to the upper three rows of ``camera_to_world``. [3, 4]
        """
        filled = self._count + -self._count % layout.GROUP
        given = self._arena.take("given_means2d", 2 * filled)
        given[: 2 * self._count] = 0.0 if of_means2d is None else of_means2d.reshape(-1)
        given[2 * self._count :] = 0.0
        if gaussian_sums is None:
            gaussian_sums = np.zeros(layout.ROW * filled, np.float32)
        of_pose = self._arena.take("of_pose", layout.ROW * -(-self._count // layout.PARCEL))
        results = layout.Parameters(*(_results.take(filled, width) for width in (3, 4, 3, 1, 3)))
        with _workers() as run:
            run(
                project_backward, self._count, gaussians, self._tail, self._view, self._extras, self._projections,
                gaussian_sums, given, layout.Parameters(*(result.reshape(-1) for result in results)), of_pose,
            )  # fmt: skip
        columns = of_pose.reshape(-1, layout.ROW)[:, :12].sum(axis=0, dtype=np.float64).reshape(4, 3)
        return layout.Parameters(*(result[: self._count] for result in results)), columns.T

    def _bin(self, run: _Run) -> None:
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
        run(binning.find_pairs, self._projections, self._view, grid, bins.keys, pairs, bins.entry_counts)
        binning.place_entries(grid, pairs, bins)
        run(binning.sort_pairs, grid, pairs, bins)

    def _sorted_keys(self, run: _Run, drawn: int) -> Array:
        """Indices of the Gaussians drawn, nearest first."""
        take = self._arena.take
        keys, moved = take("keys", drawn, np.int64), take("moved", drawn, np.int64)
        if not drawn:
            return keys
        if drawn < _WORTH_SHARING_SORT:
            run = _Run(1)
        counts = self._projections.parcels[::2]
        lowest, highest = np.empty_like(counts), np.empty_like(counts)
        depth_bits = self._projections.depths.view(np.int32)
        run(sorting.collect, depth_bits, self._projections.drawn, np.cumsum(counts) - counts, keys, lowest, highest)
        least = int(lowest.min())
        significant = (int(highest.max()) - least).bit_length()
        passes = -(-significant // sorting.DIGIT_BITS)
        digits = take("digits", run.workers * sorting.DIGITS, np.int32)
        for turn in range(passes):
            width = -(-significant // passes)
            arguments = (run.workers, keys, least, turn * width, (1 << width) - 1, digits)
            run(sorting.count_digits, *arguments)
            sorting.place_digits(run.workers, (1 << width) - 1, digits)
            run(sorting.move_by_digit, *arguments, moved)
            keys, moved = moved, keys
        return keys

    def _scratch(self, run: _Run, sweep: Any) -> layout.Scratch:
        """Memory for all threads of a sweep."""
        numbers = self._arena.take("numbers", run.workers * sweep.NUMBERS)
        return layout.Scratch(numbers, self._arena.take("integers", run.workers * sweep.INTEGERS, np.int32))


class _Run:
    """Runs kernels on a given number of threads."""

    def __init__(self, workers: int) -> None:
        self.workers = workers

    def __call__(self, kernel: Callable[..., Any], *arguments: Any) -> None:
        _crew.run(self.workers, kernel, np.zeros(4, np.int64), *arguments)


@contextmanager
def _workers() -> Iterator[_Run]:
    """Lock the thread pool, as one view uses all cores; with as many threads as torch uses."""
    with _crew.turn:
        yield _Run(torch.get_num_threads())


def _flat_images(images: layout.Images) -> layout.Images:
    return layout.Images(*(np.empty(0, np.float32) if image is None else image.reshape(-1) for image in images))


def _joined(images: layout.Images) -> Array:
    """Eight channels from the images that held them. [H, W, 8]"""
    return np.concatenate(
        [images.rgb, images.depth[..., None], images.inverse_depth[..., None], images.normals], axis=-1
    )


def _part_into(channels: Array, images: layout.Images) -> None:
    """Split up to eight channels into images; the inverse of :func:`_joined`. [H, W, C]"""
    filled = np.zeros((*channels.shape[:2], layout.MAX_CHANNELS), np.float32)
    filled[..., : channels.shape[2]] = channels
    images.rgb[:] = filled[..., :3]
    images.depth[:] = filled[..., 3]
    images.inverse_depth[:] = filled[..., 4]
    images.normals[:] = filled[..., 5:]


def _tail(gaussians: layout.Parameters, count: int) -> layout.Parameters:
    """The Gaussians behind the last full group, filled up with ones that are not drawn."""
    first = count // layout.GROUP * layout.GROUP
    tails = []
    for array, width, filling in zip(gaussians, (3, 4, 3, 1, 3), (0.0, 1.0, 0.0, 0.0, 0.0), strict=True):
        tail = np.full(layout.GROUP * width, filling, np.float32)
        tail[: width * (count - first)] = array[width * first :]
        tails.append(tail)
    return layout.Parameters(*tails)
