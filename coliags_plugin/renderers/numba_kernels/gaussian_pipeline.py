"""The stages of rendering 3D Gaussians."""

from __future__ import annotations

from typing import ClassVar

from coliags_plugin.core.numba_compilation import Array
from coliags_plugin.renderers.numba_kernels import layout, sweep_backward, sweep_forward
from coliags_plugin.renderers.numba_kernels.pipeline import Layer, Pipeline, Runner
from coliags_plugin.renderers.numba_kernels.projection import project
from coliags_plugin.renderers.numba_kernels.projection_backward import gather, project_backward


class GaussianPipeline(Pipeline):
    """Rendering of 3D Gaussians. What layers composite of their own are extras and the median depth."""

    scales: ClassVar[int] = 3
    constant_images: ClassVar[tuple[str, ...]] = ("median",)
    first_channel: ClassVar[int] = layout.CHANNELS
    first_channel_sum: ClassVar[int] = layout.SUM_CHANNELS
    feature_channels: ClassVar[int] = layout.MAX_CHANNELS
    feature_images: ClassVar[tuple[str, ...]] = ("rgb", "depth", "inverse_depth", "normals")

    @property
    def _extras(self) -> layout.Extras:
        wanted = self._wanted
        return layout.Extras("depth" in wanted, "inverse_depth" in wanted, "normals" in wanted)

    def _main_layer(self) -> Layer:
        extras = self._extras
        channels = (0,) * (3 + extras.depth + extras.inverse_depth + 3 * extras.normals)
        own = (extras, (0,) * ("median" in self._wanted))
        return Layer(self._projections.records, self._view, channels, own)

    def _feature_layer(self, records: Array, view: Array) -> Layer:
        return Layer(records, view, (0,) * self.feature_channels, (layout.FEATURES, ()))

    def _outlines(self) -> tuple[layout.Projections, tuple[int, ...]]:
        return self._projections, ()

    def _sums_size(self, layer: Layer, rows: int) -> int:
        return layout.ROW * rows

    def _composited_vectors(self, layer: Layer) -> int:
        return 1 + len(layer.channels)

    def _run_project(self, run: Runner, gaussians: layout.Parameters, means2d: Array, radii: Array) -> None:
        run(
            project, self._count, gaussians, self._tail, self._view, self._extras, self._projections, means2d, radii
        )  # fmt: skip

    def _run_sweep(self, run: Runner, layer: Layer, composited: Array, images: layout.Images) -> None:
        extras, median = layer.own
        run(
            sweep_forward.sweep_forward, self._projections._replace(records=layer.records), self._bins, layer.view,
            self._grid, extras, layer.channels, median, self._scratch(run, sweep_forward), composited, images,
        )  # fmt: skip

    def _run_sweep_backward(
        self, run: Runner, layer: Layer, composited: Array, of_images: layout.Images, entry_sums: Array
    ) -> None:
        run(
            sweep_backward.sweep_backward, self._projections._replace(records=layer.records), self._bins, layer.view,
            self._grid, layer.own[0], layer.channels, self._scratch(run, sweep_backward), composited, of_images,
            entry_sums,
        )  # fmt: skip

    def _run_gather(self, run: Runner, layer: Layer, entry_sums: Array, sums: Array, of_means2d: Array) -> None:
        run(gather, self._projections._replace(records=layer.records), self._bins, entry_sums, sums, of_means2d)

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
            project_backward, self._count, gaussians, self._tail, self._view, self._extras, self._projections, sums,
            given_means2d, of_gaussians, of_pose,
        )  # fmt: skip
