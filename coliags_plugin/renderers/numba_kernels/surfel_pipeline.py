"""The stages of rendering surfels."""

from __future__ import annotations

from typing import ClassVar

from coliags_plugin.core.numba_compilation import Array
from coliags_plugin.renderers.numba_kernels import layout, surfel_layout, surfel_sweep_backward, surfel_sweep_forward
from coliags_plugin.renderers.numba_kernels.pipeline import Layer, Pipeline, Runner
from coliags_plugin.renderers.numba_kernels.surfel_projection import project_surfels
from coliags_plugin.renderers.numba_kernels.surfel_projection_backward import gather_surfels, project_surfels_backward


class SurfelPipeline(Pipeline):
    """Rendering of surfels. What layers composite of their own are measures, which differ from pixel to pixel."""

    scales: ClassVar[int] = 2
    constant_images: ClassVar[tuple[str, ...]] = ()
    first_channel: ClassVar[int] = surfel_layout.CHANNELS
    first_channel_sum: ClassVar[int] = surfel_layout.SUM_CHANNELS
    feature_channels: ClassVar[int] = surfel_layout.ROW_CHANNELS
    feature_images: ClassVar[tuple[str, ...]] = ("rgb", "normals")

    _outline_rows: Array
    _remainders: Array

    def _main_layer(self) -> Layer:
        measures = surfel_layout.Measures(*((0,) * (name in self._wanted) for name in surfel_layout.Measures._fields))
        channels = (0,) * (3 + 3 * ("normals" in self._wanted))
        return Layer(self._projections.records, self._view, channels, measures)

    def _feature_layer(self, records: Array, view: Array) -> Layer:
        return Layer(records, view, (0,) * self.feature_channels, surfel_layout.NOTHING)

    def _outlines(self) -> tuple[layout.Projections, tuple[int, ...]]:
        return self._projections._replace(records=self._outline_rows), (0,)

    def _sums_size(self, layer: Layer, rows: int) -> int:
        return (layout.ROW + (len(layer.channels) > surfel_layout.ROW_CHANNELS)) * rows

    def _composited_vectors(self, layer: Layer) -> int:
        measures = layer.own
        of_measures = len(measures.depth) + len(measures.inverse_depth) + 2 * len(measures.distortion)
        return 1 + len(layer.channels) + of_measures

    def _run_project(self, run: Runner, gaussians: layout.Parameters, means2d: Array, radii: Array) -> None:
        self._outline_rows = self._arena.take("outlines", len(self._projections.records))
        self._remainders = self._arena.take("remainders", len(means2d))
        run(
            project_surfels, self._count, gaussians, self._tail, self._view, self._projections, self._outline_rows,
            self._remainders, means2d, radii,
        )  # fmt: skip

    def _run_sweep(self, run: Runner, layer: Layer, composited: Array, images: layout.Images) -> None:
        run(
            surfel_sweep_forward.sweep_surfels, layer.records, self._remainders, self._bins, layer.view, self._grid, layer.channels,
            layer.own, self._scratch(run, surfel_sweep_forward), composited, images,
        )  # fmt: skip

    def _run_sweep_backward(
        self, run: Runner, layer: Layer, composited: Array, of_images: layout.Images, entry_sums: Array
    ) -> None:
        run(
            surfel_sweep_backward.sweep_surfels_backward, layer.records, self._remainders, self._bins, layer.view, self._grid,
            layer.channels, layer.own, self._scratch(run, surfel_sweep_backward), composited, of_images, entry_sums,
        )  # fmt: skip

    def _run_gather(self, run: Runner, layer: Layer, entry_sums: Array, sums: Array, of_means2d: Array) -> None:
        run(
            gather_surfels, layer.records, self._projections.drawn, self._bins, self._view, layer.channels, entry_sums,
            sums, of_means2d,
        )  # fmt: skip

    def _run_project_backward(
        self,
        run: Runner,
        gaussians: layout.Parameters,
        sums: Array,
        given_means2d: Array,
        of_gaussians: layout.Parameters,
        of_pose: Array,
    ) -> None:
        run(
            project_surfels_backward, self._count, gaussians, self._tail, self._view, self._main_layer().channels,
            self._projections.drawn, sums, given_means2d, of_gaussians, of_pose,
        )  # fmt: skip
