"""Record of one evaluated run: the content of a results file.

A results file is one JSON object. It holds the raw value of every metric of every frame, and hashes of what was
compared, so that tables and statistics can be made from it alone, without the run folder.
"""

from __future__ import annotations

from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, model_validator
from typing_extensions import Self

from coliags_plugin.core.errors import check_name
from coliags_plugin.reporting.model import Column, Value, value_text
from coliags_plugin.reporting.numbers import Direction
from coliags_plugin.reporting.text_formats import DisplayTable

#: Version of the schema below; incremented whenever a reader of the older version would misread a newer file.
VERSION = 1
#: The split's own test set.
MAIN_SET = "test"
#: Share of transparent pixels above which a warning is due.
MANY_TRANSPARENT = 0.01
#: Suffix of metrics over the pixels that a training frame sees.
SEEN_SUFFIX = "_seen"
#: Metrics of views whose poses were refined on their own, held-out images, by their names without a suffix; suffixes of
#: those, and of those with each rendered colour multiplied by its best factor, too (docs/protocols.md).
REFINED_METRICS, REFINED_SUFFIXES = ("psnr", "ssim"), ("_pose_refined", "_pose_color_refined")
#: Suffix of folders of evaluations against another scene's true depth, behind the name of the protocol.
TRUTH_SUFFIX = "-truth"

Format = Literal["coliags-result"]

#: Marks a results file.
FORMAT: Format = "coliags-result"


class _Part(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class ProtocolRecord(_Part):
    """Evaluation protocol: results whose name or version differ are not comparable."""

    name: str
    version: int
    description: str = ""


class SceneRecord(_Part):
    """Data of a run."""

    name: str
    fingerprint: str  # hash of its files
    split: str  # its name
    train: tuple[str, ...]  # names of the training frames
    size: tuple[int, int]  # width and height of the evaluated images, px


class MetricRecord(_Part):
    """Unit and direction of a metric."""

    unit: str
    direction: Direction


class ProfileRecord(_Part):
    """Errors of a test set by a property of the pixel: distance to the camera, or angle to the optical axis.

    Errors of a bin are None where it has no pixels, or where a rendered one is not finite.
    """

    unit: str  # of the edges: mm, units (an unknown one) or degrees
    edges: tuple[float, ...]  # of the bins, ascending. [B + 1]
    pixels: tuple[int, ...]  # with known depth in each bin. [B]
    rgb_mse: tuple[float | None, ...]  # mean squared colour error of those pixels, colours in [0, 1]. [B]
    depth_mse: tuple[float | None, ...]  # mean squared depth error of those pixels, scene units. [B]

    @model_validator(mode="after")
    def _one_number_per_bin(self) -> Self:
        for name in ("pixels", "rgb_mse", "depth_mse"):
            count, bins = len(getattr(self, name)), len(self.edges) - 1
            if count != bins:
                raise ValueError(f"{name} has {count} numbers for {bins} bins")
        return self


class SetRecord(_Part):
    """Evaluation of one test set."""

    frames: tuple[str, ...]  # names, in video order. [F]
    values: dict[str, tuple[float | None, ...]]  # raw values by metric, None where a frame has none. [F] each
    reasons: dict[str, str] = {}  # why values are missing, by metric
    predictions_sha256: str  # hash of the images and depths as rendered
    truth_sha256: str  # hash of those that they were compared with
    profiles: dict[str, ProfileRecord] = {}  # by property: distance, angle; empty without true depth
    transparent: float | None = None  # share of the pixels within the masks with alpha below 0.5; None: not measured
    blank: int = 0  # number of views that show nothing: their mean alpha within the masks is below 0.001

    @model_validator(mode="after")
    def _one_value_per_frame(self) -> Self:
        if len(set(self.frames)) != len(self.frames):
            raise ValueError("a frame is listed twice")
        for name, values in self.values.items():
            if len(values) != len(self.frames):
                raise ValueError(f"metric '{name}' has {len(values)} values for {len(self.frames)} frames")
        return self

    @property
    def transparency_warning(self) -> str:
        """Warning of views that show nothing, or else of transparent pixels; empty where there are hardly any."""
        if self.blank:
            return (
                f"{self.blank} of {len(self.frames)} views show nothing, their mean alpha is below 0.001: what was "
                "reconstructed may be in another world or unit than their poses, nearer than near_plane, or not in view"
            )
        if self.transparent is None or self.transparent <= MANY_TRANSPARENT:
            return ""
        return (
            f"{100.0 * self.transparent:.1f} % of the pixels have alpha below 0.5: their depth, hatched, means little"
        )

    def mean(self, metric: str) -> float | None:
        """Mean over the frames that have a metric; None where none has."""
        values = [value for value in self.values.get(metric, ()) if value is not None]
        return sum(values) / len(values) if values else None


class CostRecord(_Part):
    """Costs of a run; comparable between runs on one device only. None: not measured.

    Times of training are of all resumptions together, without reading data and evaluation. Steps that a kill made
    necessary twice count once.
    """

    device: str  # name of the processor or GPU it was trained on
    threads: int | None = None  # CPU threads it was given
    train_seconds: float | None = None
    processor_seconds: float | None = None  # CPU time of training, all threads together
    peak_memory_mib: float | None = None  # resident memory of the training process, or allocated memory of the GPU
    render_fps: float | None = None  # 1 / the median time of a test view at its size, the first one apart
    render_device: str | None = None  # name of the processor or GPU that rendered the test views
    render_threads: int | None = None  # CPU threads that rendering was given
    gaussians: float | None = None  # mean number drawn in a test view; None for radiance fields
    checkpoint_bytes: int | None = None  # size of the last checkpoint
    seconds_to_psnr: dict[str, float | None] = {}  # training time until the logged PSNR, smoothed, reached a mark, dB

    @property
    def checkpoint_mib(self) -> float | None:
        """Size of the last checkpoint, MiB."""
        return None if self.checkpoint_bytes is None else self.checkpoint_bytes / 2**20


class Result(_Part):
    """One run, evaluated under one protocol."""

    format: Format = FORMAT
    version: int = VERSION  # of the schema
    key: str  # hash of everything that determines the result, see results.hashing
    method: str
    scene: SceneRecord
    protocol: ProtocolRecord
    seed: int  # of all random generators of the run
    steps: int  # training steps taken
    metrics: dict[str, MetricRecord]  # in the protocol's order; then <name>_seen and <name>_pose_refined
    sets: dict[str, SetRecord]  # by name; ``test`` is the split's own
    metrics_sha256: str  # hash of the raw values of all test sets
    cost: CostRecord
    config: dict[str, Any]  # the resolved method config
    software: dict[str, Any]  # versions of package, Python and libraries
    provenance: dict[str, Any] = {}

    @model_validator(mode="after")
    def _known_metrics(self) -> Self:
        if not self.sets:
            raise ValueError("there is no test set")
        for name, part in self.sets.items():
            unknown = sorted(part.values.keys() - self.metrics.keys())
            if unknown:
                raise ValueError(f"set '{name}' has values of {unknown[0]}, which `metrics` does not describe")
        return self

    @property
    def main_set(self) -> str:
        """Name of the split's own test set; of the first one where it has none."""
        return MAIN_SET if MAIN_SET in self.sets else next(iter(self.sets))

    def mean(self, metric: str, set_name: str | None = None) -> float | None:
        """Mean of a metric over the frames of a test set, the main one by default, that have it; None where none has.

        Raises:
            InputError: There is no such metric or test set.
        """
        chosen = self.main_set if set_name is None else set_name
        check_name("metric", metric, self.metrics)
        check_name("test set", chosen, self.sets)
        return self.sets[chosen].mean(metric)

    @property
    def evaluation_name(self) -> str:
        """Name of its folder among the evaluations of a run."""
        return self.protocol.name + (TRUTH_SUFFIX if "truth" in self.provenance else "")

    @property
    def title(self) -> str:
        """Run and protocol in one line."""
        truth = self.provenance.get("truth")
        trained_on = f" (trained on {truth['trained_on']['name']})" if truth else ""
        return (
            f"{self.method} on {self.scene.name}{trained_on}, seed {self.seed}, {self.steps} steps, "
            f"protocol {self.protocol.name} v{self.protocol.version}"
        )

    def summary(self) -> dict[str, Any]:
        """Content of ``metrics.json``: means per test set, of the main set also at the top, with their reasons."""
        main = self.sets[self.main_set]
        over_seen_pixels = {f"{name}{SEEN_SUFFIX}" for name in self.metrics}
        reasons: dict[str, str] = {}
        for part in reversed(self.sets.values()):
            reasons |= part.reasons
        return {
            "protocol": self.protocol.model_dump(),
            "method": self.method,
            "scene": self.scene.name,
            "step": self.steps,
            "untrained_views": self.provenance.get("untrained_views", {}),
            **{name: self.provenance[name] for name in ("held_out_used", "learned") if name in self.provenance},
            **{name: main.mean(name) for name in self.metrics if name not in over_seen_pixels},
            "reasons": reasons,
            "directions": {name: metric.direction for name, metric in self.metrics.items()},
            "units": {name: metric.unit for name, metric in self.metrics.items()},
            "sets": {
                name: {"frames": len(part.frames), **{metric: part.mean(metric) for metric in self.metrics}}
                for name, part in self.sets.items()
            },
            "software": self.software,
        }

    def table(self) -> DisplayTable:
        """Means of the metrics that a test set has, over every test set, with the reasons of those that are missing."""
        rows: list[dict[str, Value]] = [
            {"metric": name, "unit": metric.unit, **{key: part.mean(name) for key, part in self.sets.items()}}
            for name, metric in self.metrics.items()
            if any(part.mean(name) is not None for part in self.sets.values())
        ]
        reasons = {name: reason for record in self.sets.values() for name, reason in record.reasons.items()}
        notes = []
        for reason in dict.fromkeys(reasons.values()):
            names = [name for name, other in reasons.items() if other == reason]
            is_empty = not {row["metric"] for row in rows} & {*names}
            notes.append(f"{'not shown: ' if is_empty else ''}{', '.join(names)}: {reason}")
        warnings = {name: record.transparency_warning for name, record in self.sets.items()}
        notes += [f"warning, {name}: {text}" for name, text in warnings.items() if text]
        sets = [Column(name, f"{name} ({len(record.frames)} frames)") for name, record in self.sets.items()]
        return DisplayTable(self.title, [Column("metric"), Column("unit"), *sets], rows, notes)

    def __repr__(self) -> str:
        """The title with the means of the main test set."""
        units = {name: metric.unit for name, metric in self.metrics.items() if not name.endswith(SEEN_SUFFIX)}
        means = {name: mean for name in units if (mean := self.mean(name)) is not None}
        texts = (f"{name} {value_text(mean)} {units[name]}".strip() for name, mean in means.items())
        return f"{self.title}: {', '.join(texts) or 'no values'}"

    def __str__(self) -> str:
        """The table."""
        return str(self.table())

    def _repr_html_(self) -> str:
        """The table, for notebooks."""
        return self.table()._repr_html_()
