"""Forward pass of compositing, tile by tile and block by block, front to back.

A pixel's colour, alpha and other channels stay in registers while the rows of a chunk are composited. The formulas are
those of ``docs/rendering.md``, sections "Compositing" and "Surfels"; of surfels the ray of every pixel is intersected
with every disc, so depths differ from pixel to pixel.
"""

from __future__ import annotations

from collections.abc import Callable

from coliags_plugin.core.numba_kernels import lanes as vec
from coliags_plugin.core.numba_kernels.compilation import inline, kernel, part
from coliags_plugin.core.numba_kernels.threads import pieces
from coliags_plugin.renderers.numba_kernels import layout, tiles

# Of the reciprocal depths 1/z of a pixel's surfels: the first, and the sums of differences to it and of their squares.
_NEAREST = tiles.FURTHER
_DIFFERENCE = tiles.FURTHER + 16
_SQUARE = tiles.FURTHER + 32

_composited_vectors = inline(tiles.composited_vectors)


def sweeping(fetch: Callable[..., None], sweep_block: Callable[..., int], row: int) -> Callable[..., None]:
    """Compile the kernel that composites all tiles.

    It writes ``bins.reached``, the images that are not empty and, for the backward sweep, ``composited``: vectors by tile
    and block, see ``tiles.composited_vectors``.

    ``fetch`` is as :func:`fetch_gaussians`, and a fetched row has ``row`` numbers; ``sweep_block`` composites the first
    ``count`` rows listed into one block and returns whether any pixel has transmittance left.
    """

    @kernel
    def sweep(counters, projections, bins, view, grid, outputs, scratch, composited, images):
        rows, state, blocks = tiles.of_thread(counters, scratch)
        for place in pieces(counters, 0, grid.tiles):
            tile = bins.order[place]
            bins.reached[tile] = sweep_tile(tile, projections, bins, view, grid, outputs, rows, state, blocks)
            _finish_tile(tile, outputs, view, state, composited)
            tiles.copy_pixels(tile, grid, state, images, True)

    @part
    def sweep_tile(tile, projections, bins, view, grid, outputs, rows, state, blocks):
        """Leave the pixels of a tile in ``state``; return the entry after the last one swept."""
        corner_x, corner_y, across, down = tiles.tile_corner(tile, grid)
        listed = blocks[tiles.CHUNK :]
        counts = listed[layout.BLOCKS * tiles.CHUNK :]
        alive = 0
        for block in range(layout.BLOCKS):
            at, pixels = tiles.STATE * block, tiles.inside(block, across, down)
            vec.store(state, at + tiles.TRANSMITTANCE, vec.select(pixels, 1.0, 0.0))
            for vector in range(tiles.ALPHA, tiles.STATE, 16):
                vec.store(state, at + vector, 0.0)
            if vec.bits(pixels):
                alive |= 1 << block
        first, last = bins.starts[tile], bins.starts[tile + 1]
        while first < last and alive:
            end = min(first + tiles.CHUNK, last)
            fetch(first, end, alive, corner_x, corner_y, projections, view, bins.cells, rows, blocks)
            tiles.list_by_block(end - first, row, blocks, listed, counts)
            for block in range(layout.BLOCKS):
                count = counts[block]
                if count and not sweep_block(block, count, listed[tiles.CHUNK * block :], rows, outputs, view, state):
                    alive &= ~(1 << block)
            first = end
        return first

    return sweep


@part
def _finish_tile(tile, outputs, view, state, composited):
    """Store the blocks' sums in ``composited``; then add the background, divide depth by alpha, and find the distortion."""
    size = 16 * _composited_vectors(outputs)
    background = vec.broadcast_all(view, layout.VIEW_BACKGROUND, (0, 0, 0))
    for block in range(layout.BLOCKS):
        at, target = tiles.STATE * block, size * (layout.BLOCKS * tile + block)
        alpha = vec.load(state, at + tiles.ALPHA)
        covered = vec.greater(alpha, 0.0)
        sums = vec.load_all(state, at + tiles.CHANNELS, outputs.channels) + vec.load_all(
            state, at + tiles.NORMALS, outputs.normals
        )
        sums = sums + vec.load_all(state, at + tiles.DEPTH, outputs.depth)
        vec.store(composited, target, alpha)
        vec.store_all(composited, target + 16, sums + vec.load_all(state, at + tiles.INVERSE, outputs.inverse_depth))
        if len(outputs.channels) > 3 or len(outputs.depth) > 0:
            expected = vec.div(vec.load(state, at + tiles.DEPTH), alpha)
            vec.store(state, at + tiles.EXPECTED, vec.select(covered, expected, 0.0))
        if len(outputs.distortion) > 0:
            difference = vec.load(state, at + _DIFFERENCE)
            mean = vec.select(covered, vec.div(difference, alpha), 0.0)
            squares = vec.larger(vec.fma(vec.neg(difference), mean, vec.load(state, at + _SQUARE)), 0.0)
            vec.store(composited, target + size - 32, vec.add(vec.load(state, at + _NEAREST), mean))
            vec.store(composited, target + size - 16, squares)
            distortion = vec.mul(vec.broadcast(view, layout.VIEW_DISTORTION), vec.mul(alpha, squares))
            vec.store(state, at + tiles.DISTORTION, distortion)
        color = vec.load_all(state, at + tiles.CHANNELS, (0, 0, 0))
        vec.store_all(state, at + tiles.CHANNELS, vec.fma(vec.sub(1.0, alpha), background, color))


@part
def _sweep_gaussians(block, count, listed, rows, outputs, view, state):
    """Composite 3D Gaussians into one block: see :func:`sweeping`."""
    x, y = tiles.block_pixels(block, view)
    log2_alpha_min, alpha_max, transmittance_min = vec.broadcast_all(view, layout.VIEW_LOG2_ALPHA_MIN, (0, 0, 0))
    at, channels = tiles.STATE * block, outputs.channels
    transmittance, alpha_sum = vec.load(state, at + tiles.TRANSMITTANCE), vec.load(state, at + tiles.ALPHA)
    sums, medians = (
        vec.load_all(state, at + tiles.CHANNELS, channels),
        vec.load_all(state, at + tiles.MEDIAN, outputs.median),
    )
    running = 1
    for place in range(count):
        row = listed[place]
        e = vec.fma(vec.broadcast(rows, row + layout.U_XX), x, vec.broadcast(rows, row + tiles.OFFSET_E))
        f = vec.fma(vec.broadcast(rows, row + layout.U_YY), y, vec.broadcast(rows, row + tiles.OFFSET_F))
        f = vec.fma(vec.broadcast(rows, row + layout.U_YX), x, f)
        log2_alpha = vec.fma(vec.neg(e), e, vec.fma(vec.neg(f), f, vec.broadcast(rows, row + layout.LOG2_OPACITY)))
        alpha = vec.smaller(vec.exp2(log2_alpha), alpha_max)
        alpha = vec.select(vec.at_least(log2_alpha, log2_alpha_min), alpha, 0.0)
        drawn, behind, weight = _blend(alpha, transmittance, transmittance_min)
        alpha_sum = vec.add(alpha_sum, weight)
        sums = vec.fma(weight, vec.broadcast_all(rows, row + layout.CHANNELS, channels), sums)
        if len(outputs.median) > 0:
            crosses = _crosses_half(drawn, transmittance, behind)
            medians = vec.select(crosses, vec.broadcast_all(rows, row + tiles.MEDIAN_DEPTH, outputs.median), medians)
        # Once zero it stays zero, so compositing does not resume.
        transmittance = vec.select(drawn, behind, 0.0)
        running = vec.bits(drawn)
        if not running:
            break
    vec.store(state, at + tiles.TRANSMITTANCE, transmittance)
    vec.store(state, at + tiles.ALPHA, alpha_sum)
    vec.store_all(state, at + tiles.CHANNELS, sums)
    vec.store_all(state, at + tiles.MEDIAN, medians)
    return running


@part
def _sweep_surfels(block, count, listed, rows, outputs, view, state):
    """Composite surfels into one block: see :func:`sweeping`."""
    x, y = tiles.scaled_pixels(block, view)
    log2_alpha_min, alpha_max, transmittance_min = vec.broadcast_all(view, layout.VIEW_LOG2_ALPHA_MIN, (0, 0, 0))
    at = tiles.STATE * block
    transmittance, alpha_sum = vec.load(state, at + tiles.TRANSMITTANCE), vec.load(state, at + tiles.ALPHA)
    colors = vec.load_all(state, at + tiles.CHANNELS, outputs.channels)
    normals = vec.load_all(state, at + tiles.NORMALS, outputs.normals)
    depths = vec.load_all(state, at + tiles.DEPTH, outputs.depth)
    inverse_depths = vec.load_all(state, at + tiles.INVERSE, outputs.inverse_depth)
    medians = vec.load_all(state, at + tiles.MEDIAN, outputs.median)
    nearest = vec.load_all(state, at + _NEAREST, outputs.distortion)
    differences = vec.load_all(state, at + _DIFFERENCE, outputs.distortion)
    squares = vec.load_all(state, at + _SQUARE, outputs.distortion)
    running = 1
    for place in range(count):
        row = listed[place]
        d_x, d_y, q, inverse_q, e, f, hit = tiles.intersect(rows, row, x, y)
        squared = vec.smaller(vec.fma(e, e, vec.mul(f, f)), vec.fma(d_x, d_x, vec.mul(d_y, d_y)))
        log2_alpha = vec.sub(vec.broadcast(rows, row + layout.SURFEL_LOG2_OPACITY), squared)
        alpha = vec.smaller(vec.exp2(log2_alpha), alpha_max)
        alpha = vec.select(vec.both(hit, vec.at_least(log2_alpha, log2_alpha_min)), alpha, 0.0)
        drawn, behind, weight = _blend(alpha, transmittance, transmittance_min)
        column = row + layout.SURFEL_CHANNELS
        colors = vec.fma(weight, vec.broadcast_all(rows, column, outputs.channels), colors)
        normals = vec.fma(weight, vec.broadcast_all(rows, column + 3, outputs.normals), normals)
        z = vec.mul(vec.broadcast(rows, row + layout.SURFEL_DEPTH), inverse_q)
        depths = vec.fma(weight, z, depths)
        inverse_z = vec.mul(vec.broadcast(rows, row + tiles.INVERSE_DEPTH), q)
        inverse_depths = vec.fma(weight, inverse_z, inverse_depths)
        if len(outputs.median) > 0:
            medians = vec.select(_crosses_half(drawn, transmittance, behind), z, medians)
        if len(outputs.distortion) > 0:
            # Squares of differences to a depth among them lose little where 1/z hardly differs; those of 1/z would.
            nearest = vec.select(vec.greater(alpha_sum, 0.0), nearest, inverse_z)
            moved = vec.sub(inverse_z, nearest)
            of_weight = vec.mul(weight, moved)
            differences, squares = vec.add(differences, of_weight), vec.fma(of_weight, moved, squares)
        alpha_sum = vec.add(alpha_sum, weight)
        # Once zero it stays zero, so compositing does not resume.
        transmittance = vec.select(drawn, behind, 0.0)
        running = vec.bits(drawn)
        if not running:
            break
    vec.store(state, at + tiles.TRANSMITTANCE, transmittance)
    vec.store(state, at + tiles.ALPHA, alpha_sum)
    vec.store_all(state, at + tiles.CHANNELS, colors)
    vec.store_all(state, at + tiles.NORMALS, normals)
    vec.store_all(state, at + tiles.DEPTH, depths)
    vec.store_all(state, at + tiles.INVERSE, inverse_depths)
    vec.store_all(state, at + tiles.MEDIAN, medians)
    vec.store_all(state, at + _NEAREST, nearest)
    vec.store_all(state, at + _DIFFERENCE, differences)
    vec.store_all(state, at + _SQUARE, squares)
    return running


@inline
def _blend(alpha, transmittance, transmittance_min):
    """Mask of the pixels that are drawn, transmittance behind, and weights."""
    behind = vec.mul(transmittance, vec.sub(1.0, alpha))
    drawn = vec.at_least(behind, transmittance_min)
    return drawn, behind, vec.select(drawn, vec.mul(alpha, transmittance), 0.0)


@inline
def _crosses_half(drawn, transmittance, behind):
    """Mask of the pixels whose transmittance falls to one half or less."""
    return vec.both(vec.both(drawn, vec.greater(transmittance, 0.5)), vec.at_most(behind, 0.5))


sweep = sweeping(tiles.fetch_gaussians, _sweep_gaussians, layout.ROW)
sweep_surfels = sweeping(tiles.fetch_surfels, _sweep_surfels, tiles.FETCHED_SURFEL)
