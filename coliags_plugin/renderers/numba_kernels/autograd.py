"""The kernels as two differentiable functions: Gaussians -> records, records -> images."""

from __future__ import annotations

import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import numba
import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from coliags_plugin.renderers.numba_kernels import layout, sweep_backward, sweep_forward
from coliags_plugin.renderers.numba_kernels.binning import bin_gaussians
from coliags_plugin.renderers.numba_kernels.buffers import Arena, ArenaPool
from coliags_plugin.renderers.numba_kernels.projection import PARCEL, project
from coliags_plugin.renderers.numba_kernels.projection_backward import gather, project_backward
from coliags_plugin.renderers.numba_kernels.sorting import DIGITS
from coliags_plugin.renderers.numba_kernels.tiles import CHUNK

Array = npt.NDArray[Any]

#: One view at a time: the machine's cores are all taken by one, and not every threading layer of numba bears two.
_turn = threading.Lock()
_arenas = ArenaPool()
_NOTHING = np.empty(0, np.float32)
#: Pieces of work per thread where pieces differ in cost.
_PIECES = 8


class UnusableGaussianError(Exception):
    """A Gaussian that cannot be projected; which and why is for the caller to find out."""


@dataclass(frozen=True)
class Wanted:
    """What to composite besides colour and alpha.

    Attributes:
        depth, inverse_depth, normals: Channels.
        expected: Also depth over alpha; needs ``depth``.
        median: Also the median depth.
    """

    depth: bool = False
    inverse_depth: bool = False
    normals: bool = False
    expected: bool = False
    median: bool = False

    @property
    def channels(self) -> tuple[int, ...]:
        """A tuple as long as there are channels, colour among them: kernels are compiled for its length."""
        return (0,) * (3 + self.depth + self.inverse_depth + 3 * self.normals)


@dataclass(eq=False)
class View:
    """One camera's view of N Gaussians, and what the stages leave for one another.

    Attributes:
        table: Camera and options, see ``layout``.
        cuts: log2(alpha_min), alpha_max, transmittance_min.
        background: RGB.
        width, height: Pixels.
        wanted: What to composite.
    """

    table: Array
    cuts: Array
    background: Array
    width: int
    height: int
    wanted: Wanted
    count: int = 0
    tails: list[Array] = field(default_factory=list)
    kept: dict[str, Array] = field(default_factory=dict)
    arena: Arena = field(init=False)

    def __post_init__(self) -> None:
        self.arena = _arenas.lend(self)

    @property
    def columns(self) -> int:
        """Tiles side by side."""
        return -(-self.width // layout.TILE)

    @property
    def tiles(self) -> int:
        """All tiles."""
        return self.columns * -(-self.height // layout.TILE)

    @property
    def filled(self) -> int:
        """Gaussians when the last group of sixteen is filled up."""
        return -(-self.count // 16) * 16

    @property
    def parcels(self) -> int:
        """Parcels of Gaussians."""
        return -(-self.count // PARCEL)

    def keep(self, name: str, size: int, dtype: npt.DTypeLike = np.float32) -> Array:
        """A buffer that later stages find in ``kept``."""
        array = self.kept[name] = self.arena.take(name, size, dtype)
        return array


def render(
    means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor, colors: Tensor, pose: Tensor, view: View
) -> tuple[Tensor, Tensor, dict[str, Tensor]]:
    """Render one view; differentiable, once, in all tensors.

    Args:
        means, quats, scales, opacities, colors: Float32 on the CPU, checked for shape.
        pose: camera_to_world; its values are those in ``view.table``.
        view: A fresh one.

    Returns:
        means2d, which holds its gradient after ``backward``; radii; and the images by their names in
        :data:`coliags_plugin.gaussians.OUTPUTS`.

    Raises:
        UnusableGaussianError: A Gaussian is not finite, has no direction or a negative scale.
    """
    means2d, records, radii = _Project.apply(means, quats, scales, opacities, colors, pose, view)  # type: ignore[no-untyped-call]
    if means2d.requires_grad:
        means2d.retain_grad()
    names = (
        "rgb",
        "alpha",
        "depth_accumulated",
        "inverse_depth_accumulated",
        "depth_expected",
        "normals",
        "depth_median",
    )
    images = _Composite.apply(means2d, records, view)  # type: ignore[no-untyped-call]
    return means2d, radii, {name: image for name, image in zip(names, images, strict=True) if image is not None}


class _Project(torch.autograd.Function):
    """Gaussians -> projected centres, records, radii.

    What comes back for ``records`` are the sums that ``layout`` describes, not derivatives of its columns: they lead to
    the derivatives of the Gaussians by a shorter way, on which nothing cancels.
    """

    @staticmethod
    def forward(
        ctx: Any,
        means: Tensor,
        quats: Tensor,
        scales: Tensor,
        opacities: Tensor,
        colors: Tensor,
        pose: Tensor,
        view: View,
    ) -> tuple[Tensor, Tensor, Tensor]:
        with _workers() as workers:
            view.count = len(means)
            flat = [_flat(tensor) for tensor in (means, quats, scales, opacities, colors)]
            view.tails = _tails(flat, view.count)
            records = view.keep("records", view.filled * layout.ROW)
            means2d = np.empty((view.filled, 2), np.float32)
            radii = np.empty(view.filled, np.float32)
            drawn = view.keep("drawn", view.filled // 16, np.int64)
            parcels = view.keep("parcels", 2 * view.parcels, np.int64)
            depths = view.keep("depths", view.filled)
            bounds = view.keep("bounds", 4 * view.filled)
            wanted = view.wanted
            project(
                workers, _counters(), view.count, *flat, *view.tails, view.table, wanted.depth, wanted.inverse_depth,
                wanted.normals, records, means2d.reshape(-1), depths, radii, bounds, drawn, parcels,
            )  # fmt: skip
            if view.count and parcels[::2].min() < 0:
                raise UnusableGaussianError
        ctx.save_for_backward(means, quats, scales, opacities)
        ctx.view = view
        ctx.set_materialize_grads(False)
        outputs = [torch.from_numpy(array) for array in (means2d[: view.count], records, radii[: view.count])]
        ctx.mark_non_differentiable(outputs[2])
        return outputs[0], outputs[1], outputs[2]

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, of_means2d: Tensor | None, sums: Tensor | None, of_radii: None) -> tuple[Tensor | None, ...]:
        view: View = ctx.view
        means, quats, scales, opacities = ctx.saved_tensors
        with _workers() as workers:
            filled, wanted = view.filled, view.wanted
            given = view.arena.take("given_means2d", 2 * filled)
            given[2 * view.count :] = 0.0
            given[: 2 * view.count] = 0.0 if of_means2d is None else _flat(of_means2d)
            if sums is None:
                gaussian_sums = np.zeros(filled * layout.ROW, np.float32)
            else:
                gaussian_sums = _flat(sums)
            gradients = [np.empty((filled, width), np.float32) for width in (3, 4, 3, 1, 3)]
            of_pose = view.arena.take("of_pose", layout.ROW * view.parcels)
            flat = [_flat(tensor) for tensor in (means, quats, scales, opacities)]
            project_backward(
                workers, _counters(), view.count, *flat, *view.tails[:4], view.table, wanted.depth,
                wanted.inverse_depth, wanted.normals, view.kept["records"], view.kept["drawn"], gaussian_sums, given,
                *(gradient.reshape(-1) for gradient in gradients), of_pose,
            )  # fmt: skip
            pose = np.zeros((4, 4))
            columns = of_pose.reshape(-1, layout.ROW)[:, :12].sum(axis=0, dtype=np.float64).reshape(4, 3)
            pose[:3, :] = columns.T
        means_, quats_, scales_, opacities_, colors_ = (torch.from_numpy(array[: view.count]) for array in gradients)
        return means_, quats_, scales_, opacities_[:, 0], colors_, torch.from_numpy(pose.astype(np.float32)), None


class _Composite(torch.autograd.Function):
    """Projected centres and records -> images. The centres' values are in the records, too."""

    @staticmethod
    def forward(ctx: Any, means2d: Tensor, records: Tensor, view: View) -> tuple[Tensor | None, ...]:
        wanted, kept = view.wanted, view.kept
        images = [
            torch.empty(view.height, view.width, *more) if flag else None
            for flag, more in (
                (True, (3,)),
                (True, ()),
                (wanted.depth, ()),
                (wanted.inverse_depth, ()),
                (wanted.expected, ()),
                (wanted.normals, (3,)),
                (wanted.median, ()),
            )
        ]
        with _workers() as workers:
            _bin(view, workers)
            composited = view.keep("composited", layout.TILE**2 * view.tiles * (1 + len(wanted.channels)))
            sweep_forward.sweep_forward(
                workers, _counters(), kept["records"], kept["depths"], kept["cells"], kept["starts"], kept["order"],
                view.keep("reached", view.tiles, np.int64), wanted.channels, (0,) * wanted.median, view.cuts,
                view.background, view.width, view.height, view.arena.take("scratch", workers * sweep_forward.SCRATCH),
                view.arena.take("lists", workers * sweep_forward.LISTS, np.int32), composited, *map(_flat, images),
            )  # fmt: skip
        ctx.view = view
        ctx.set_materialize_grads(False)
        if images[6] is not None:
            ctx.mark_non_differentiable(images[6])
        return tuple(images)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *given: Tensor | None) -> tuple[Tensor | None, ...]:
        view: View = ctx.view
        wanted, kept = view.wanted, view.kept
        if all(gradient is None for gradient in given):
            return None, None, None
        counters = _counters()
        with _workers() as workers:
            entry_sums = view.arena.take("entry_sums", layout.ROW * int(kept["starts"][-1]))
            sweep_backward.sweep_backward(
                workers, counters, kept["records"], kept["depths"], kept["cells"], kept["starts"], kept["order"],
                kept["reached"], wanted.channels, view.cuts, view.background, view.width, view.height,
                view.arena.take("scratch", workers * sweep_backward.SCRATCH),
                view.arena.take("lists", workers * CHUNK, np.int32), kept["composited"], wanted.depth,
                wanted.inverse_depth, *map(_flat, given[:6]), entry_sums,
            )  # fmt: skip
            gaussian_sums = view.arena.take("gaussian_sums", layout.ROW * view.filled)
            of_means2d = np.empty((view.filled, 2), np.float32)
            gather(
                workers, counters, kept["keys"], kept["records"], kept["drawn"], kept["stretch_entries"],
                kept["entry_counts"], entry_sums, gaussian_sums, of_means2d.reshape(-1),
            )  # fmt: skip
        return torch.from_numpy(of_means2d[: view.count]), torch.from_numpy(gaussian_sums), None


def _bin(view: View, workers: int) -> None:
    """List each tile's Gaussians; leaves ``cells``, ``starts``, ``order`` and the ``entry_...`` in ``kept``."""
    arena, kept = view.arena, view.kept
    drawn, pairs = (int(total) for total in kept["parcels"].reshape(-1, 2).sum(axis=0))
    starts = view.keep("starts", view.tiles + 1, np.int64)
    order = view.keep("order", view.tiles, np.int64)
    stretches = workers * _PIECES if workers > 1 else 1
    keys = view.keep("keys", drawn, np.int64)
    stretch_entries = view.keep("stretch_entries", stretches + 1, np.int64)
    entry_counts = view.keep("entry_counts", drawn, np.int32)
    cells = view.keep("cells", layout.CELL * pairs, np.int32)
    if not drawn:
        starts[:] = stretch_entries[:] = 0
        order[:] = np.arange(view.tiles)
        return
    bin_gaussians(
        workers, stretches, _counters(), kept["records"], kept["depths"].view(np.int32), kept["bounds"], kept["drawn"],
        kept["parcels"], float(view.cuts[0]), view.columns, view.tiles, keys, arena.take("moved", drawn, np.int64),
        arena.take("ranges", 2 * view.parcels, np.int64), arena.take("digits", workers * DIGITS, np.int32),
        *(arena.take(name, pairs, np.int32) for name in ("pair_gaussian", "pair_tile", "pair_blocks")),
        arena.take("tile_counts", stretches * view.tiles, np.int32),
        arena.take("stretch_pairs", 2 * stretches, np.int64), stretch_entries, entry_counts, cells, starts, order,
    )  # fmt: skip


@contextmanager
def _workers() -> Iterator[int]:
    """Wait for the turn, and give the number of threads to use: torch's."""
    workers = max(1, min(torch.get_num_threads(), numba.config.NUMBA_NUM_THREADS))
    with _turn:
        before = numba.get_num_threads()
        numba.set_num_threads(workers)
        try:
            yield workers
        finally:
            numba.set_num_threads(before)


def _counters() -> Array:
    return np.zeros(4, np.int64)


def _flat(tensor: Tensor | None) -> Array:
    """A tensor's numbers one after the other; none for None."""
    return _NOTHING if tensor is None else tensor.detach().contiguous().numpy().reshape(-1)


def _tails(flat: Sequence[Array], count: int) -> list[Array]:
    """The Gaussians behind the last full group of sixteen, filled up with ones that are not drawn."""
    first = count // 16 * 16
    tails = []
    for array, width, filling in zip(flat, (3, 4, 3, 1, 3), (0.0, 1.0, 0.0, 0.0, 0.0), strict=True):
        tail = np.full(16 * width, filling, np.float32)
        tail[: width * (count - first)] = array[width * first :]
        tails.append(tail)
    return tails
