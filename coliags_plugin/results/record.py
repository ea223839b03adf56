"""Record of one evaluated run: the content of a results file.

A results file is one JSON object. It holds the raw value of every metric of every frame, and hashes of what was
compared, so that tables and statistics can be made from it alone, without the run folder.
"""

from __future__ import annotations

from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, model_validator
from typing_extensions import Self

from coliags_plugin.core.errors import InputError, did_you_mean
from coliags_plugin.reporting.model import Column, Value, value_text
from coliags_plugin.reporting.numbers import Direction
from coliags_plugin.reporting.terminal import DisplayTable

#: Of the schema below; incremented whenever a reader of the older version would misread a newer file.
VERSION = 1
#: The split's own test set.
MAIN_SET = "test"
#: Share of transparent pixels above which a warning is due.
MANY_TRANSPARENT = 0.01
#: Of metrics over the pixels that a training frame sees.
SEEN_SUFFIX = "_seen"
#: Of folders of evaluations against another scene's true depth, behind the name of the protocol.
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
    """Data of a run.

    Attributes:
        name: Of the scene.
        fingerprint: Hash of its files.
        split: Name of the split.
        train: Names of the training frames.
        size: Width and height of the evaluated images, px.
    """

    name: str
    fingerprint: str
    split: str
    train: tuple[str, ...]
    size: tuple[int, int]


class MetricRecord(_Part):
    """What a metric's values mean."""

    unit: str
    direction: Direction


class ProfileRecord(_Part):
    """Errors of a test set by a property of the pixel: distance to the camera, or angle to the optical axis.

    Attributes:
        unit: Of the edges: ``mm`` or ``degrees``.
        edges: Of the bins, ascending. [B + 1]
        pixels: Pixels with known depth in each bin. [B]
        rgb_mse: Mean squared colour error of those pixels, colours in [0, 1]; None where there are none, or where a
            rendered one is not finite. [B]
        depth_mse: Mean squared depth error of those pixels, mm^2; None likewise. [B]
    """

    unit: str
    edges: tuple[float, ...]
    pixels: tuple[int, ...]
    rgb_mse: tuple[float | None, ...]
    depth_mse: tuple[float | None, ...]

    @model_validator(mode="after")
    def _one_number_per_bin(self) -> Self:
        for name in ("pixels", "rgb_mse", "depth_mse"):
            count, bins = len(getattr(self, name)), len(self.edges) - 1
            if count != bins:
                raise ValueError(f"{name} has {count} numbers for {bins} bins")
        return self


class SetRecord(_Part):
    """Evaluation of one test set.

    Attributes:
        frames: Names, in video order. [F]
        values: Raw values by metric, None where a frame has none. [F] each
        reasons: Why values are missing, by metric.
        predictions_sha256: Hash of the images and depths as rendered.
        truth_sha256: Hash of those that they were compared with.
        profiles: By property: ``distance``, ``angle``; empty without true depth.
        transparent: Share of the pixels within the masks whose alpha is below 0.5, so that their depth means little;
            None where it was not measured.
    """

    frames: tuple[str, ...]
    values: dict[str, tuple[float | None, ...]]
    reasons: dict[str, str] = {}
    predictions_sha256: str
    truth_sha256: str
    profiles: dict[str, ProfileRecord] = {}
    transparent: float | None = None

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
        """What is to be said of transparent pixels; empty where there are hardly any."""
        if self.transparent is None or self.transparent <= MANY_TRANSPARENT:
            return ""
        return (
            f"{100.0 * self.transparent:.1f} % of the pixels have alpha below 0.5: their depth, hatched, means little"
        )

    def mean(self, metric: str) -> float | None:
        """Mean over the frames that have a metric; None where none has."""
        known = [value for value in self.values.get(metric, ()) if value is not None]
        return sum(known) / len(known) if known else None


class CostRecord(_Part):
    """What a run cost; comparable between runs on one device only. None: not measured.

    Attributes:
        device: Name of the processor or GPU it was trained on.
        threads: CPU threads it was given.
        train_seconds: Time of training, all resumptions together, without reading data and evaluation. Steps that a
            kill made necessary twice count once.
        processor_seconds: CPU time of the same, all threads together.
        peak_memory_mib: Largest resident memory of the training process, or allocated memory of the GPU.
        render_fps: Views of the test sets rendered in a second, at their size: 1 / the median time of a view, the
            first one apart.
        render_device: Name of the processor or GPU that rendered them.
        render_threads: CPU threads that rendering was given.
        gaussians: Mean number of Gaussians drawn in a test view; None for radiance fields.
        checkpoint_bytes: Size of the last checkpoint.
        seconds_to_psnr: Training seconds after which the logged PSNR, smoothed, first reached a mark in dB.
    """

    device: str
    threads: int | None = None
    train_seconds: float | None = None
    processor_seconds: float | None = None
    peak_memory_mib: float | None = None
    render_fps: float | None = None
    render_device: str | None = None
    render_threads: int | None = None
    gaussians: float | None = None
    checkpoint_bytes: int | None = None
    seconds_to_psnr: dict[str, float | None] = {}


class Result(_Part):
    """One run, evaluated under one protocol.

    Attributes:
        format: Marks the file.
        version: Of the schema.
        key: Hash of everything that determines the result; see :mod:`coliags_plugin.results.hashing`.
        metrics: Metrics by name, in the protocol's order; then those over seen pixels, ``<name>_seen``.
        metrics_sha256: Hash of the raw values of all test sets.
        steps: Training steps taken.
        seed: Of all random generators of the run.
        config: The resolved method config.
        sets: Test sets by name; ``test`` is the split's own.
        cost: What the run cost.
        software: Versions of package, Python and libraries.
        provenance: Further provenance of the run.
    """

    format: Format = FORMAT
    version: int = VERSION
    key: str
    method: str
    scene: SceneRecord
    protocol: ProtocolRecord
    seed: int
    steps: int
    metrics: dict[str, MetricRecord]
    sets: dict[str, SetRecord]
    metrics_sha256: str
    cost: CostRecord
    config: dict[str, Any]
    software: dict[str, Any]
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
        """Mean of a metric over the frames of a test set that have it; None where none has.

        Args:
            metric: Its name.
            set_name: Name of the test set; None: the main one.

        Raises:
            InputError: There is no such metric or test set.
        """
        chosen = self.main_set if set_name is None else set_name
        for kind, name, known in (("metric", metric, self.metrics), ("test set", chosen, self.sets)):
            if name not in known:
                raise InputError(
                    f"no {kind} '{name}' in a result of protocol {self.protocol.name}",
                    f"one of {', '.join(known)}",
                    did_you_mean(name, known),
                )
        return self.sets[chosen].mean(metric)

    @property
    def evaluation_name(self) -> str:
        """Name of its folder among the evaluations of a run."""
        return self.protocol.name + (TRUTH_SUFFIX if "truth" in self.provenance else "")

    @property
    def title(self) -> str:
        """What was evaluated and how, in one line."""
        truth = self.provenance.get("truth")
        trained_on = f" (trained on {truth['trained_on']['name']})" if truth else ""
        return (
            f"{self.method} on {self.scene.name}{trained_on}, seed {self.seed}, {self.steps} steps, "
            f"protocol {self.protocol.name} v{self.protocol.version}"
        )

    def table(self) -> DisplayTable:
        """Means of the metrics that a test set has, over every test set, with the reasons of those that are missing."""
        rows: list[dict[str, Value]] = [
            {"metric": name, "unit": metric.unit, **{key: part.mean(name) for key, part in self.sets.items()}}
            for name, metric in self.metrics.items()
            if any(part.mean(name) is not None for part in self.sets.values())
        ]
        reasons = {name: reason for part in self.sets.values() for name, reason in part.reasons.items()}
        without = {each: [name for name in reasons if reasons[name] == each] for each in reasons.values()}
        warnings = {name: part.transparency_warning for name, part in self.sets.items()}
        sets = [Column(name, f"{name} ({len(part.frames)} frames)") for name, part in self.sets.items()]
        return DisplayTable(
            self.title,
            [Column("metric"), Column("unit"), *sets],
            rows,
            [
                *(f"{self._not_shown(names)}: {reason}" for reason, names in without.items()),
                *(f"warning, {name}: {text}" for name, text in warnings.items() if text),
            ],
        )

    def _not_shown(self, names: list[str]) -> str:
        """Names of metrics that lack values, saying so if no set has any."""
        empty = all(part.mean(name) is None for name in names for part in self.sets.values())
        return f"not shown: {', '.join(names)}" if empty else ", ".join(names)

    def __repr__(self) -> str:
        """The title with the means of the main test set."""
        own = {name: metric.unit for name, metric in self.metrics.items() if not name.endswith(SEEN_SUFFIX)}
        known = [f"{name} {value_text(mean)} {own[name]}" for name in own if (mean := self.mean(name)) is not None]
        return f"{self.title}: {', '.join(text.strip() for text in known) or 'no values'}"

    def __str__(self) -> str:
        """The table."""
        return str(self.table())

    def _repr_html_(self) -> str:
        """The table, for notebooks."""
        return self.table()._repr_html_()
