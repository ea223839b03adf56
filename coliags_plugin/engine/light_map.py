"""The light that a run has learned: its law and gains, beside a phantom's true ones."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from coliags_plugin.contracts import GainModule, GaussianField
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.files import write_json
from coliags_plugin.core.scenes import Scene
from coliags_plugin.engine.trained import TrainedRun
from coliags_plugin.engine.true_light import TrueLight, find_true_light
from coliags_plugin.outputs.charts import Series, line_chart, style_classes
from coliags_plugin.outputs.page import fact_list, write_page

#: Largest angle to the optical axis that is shown, degrees, and number of points of a curve.
_MAX_ANGLE, _POINTS = 60.0, 61
_CHANNELS = ("red", "green", "blue")
_TRUTH_STYLE = 7


@dataclass(frozen=True)
class LightMap:
    """Curves and numbers of the light of a run.

    Attributes:
        distances: On the optical axis, scene units. [P]
        angles: To the optical axis at ``reference``, degrees. [P]
        by_distance: Factor on encoded colours relative to the axis at ``reference``; None without a law. [P, C]
        by_angle: The same over the angle. [P, C]
        true_by_distance, true_by_angle: Of a phantom's direct light; None of other scenes. [P]
        times: Indices of the training frames, in order; empty without gains.
        gains: Encoded, with a geometric mean of 1. [F, C]
        true_gains: Of a phantom, likewise. [F, 3]
        numbers: What was learned, and how far it is from the truth.
    """

    distances: Float[Tensor, "P"]
    angles: Float[Tensor, "P"]
    by_distance: Float[Tensor, "P C"] | None
    by_angle: Float[Tensor, "P C"] | None
    true_by_distance: Float[Tensor, "P"] | None
    true_by_angle: Float[Tensor, "P"] | None
    times: Sequence[float]
    gains: Float[Tensor, "F C"] | None
    true_gains: Float[Tensor, "F 3"] | None
    numbers: dict[str, Any]


@torch.no_grad()
def light_map(trained: TrainedRun) -> LightMap:
    """The law and the gains of a run, beside those of a phantom.

    Raises:
        InputError: The method has learned neither.
    """
    model, scene = trained.model, trained.scene
    gain = next((part for part in model.view_modules.values() if isinstance(part, GainModule)), None)
    field = model.field if isinstance(model.field, GaussianField) else None
    depths = scene.depths_in_view().double()
    low, middle, high = (float(depths.quantile(share)) for share in (0.02, 0.5, 0.98))
    distances = torch.linspace(low, high, _POINTS, dtype=torch.float64)
    angles = torch.linspace(0.0, _MAX_ANGLE, _POINTS, dtype=torch.float64)
    radians = angles.deg2rad()
    axis = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    around = middle * torch.stack([radians.sin(), torch.zeros_like(radians), radians.cos()], dim=1)
    rays = (distances[:, None] * axis, around, middle * axis[None])
    learned = None if field is None else _relative(field.attenuation, rays, trained.device)
    if learned is None and gain is None:
        raise InputError(
            f"a light map of method '{trained.method}', which has learned neither a law of attenuation nor gains",
            "a method with appearance head 'attenuated' or module 'gain', such as coliags-plus",
        )
    truth = find_true_light(Path(scene.provenance.get("path", "")))
    true = None if truth is None else _relative(truth.attenuation, rays, torch.device("cpu"))
    gains = None if gain is None else _centred(gain.log_gains().cpu().double()).exp()
    true_gains = None if truth is None or gains is None else _true_gains(truth, scene)
    numbers: dict[str, Any] = {"learned": model.learned, "reference_distance": middle, "unit": scene.length_unit}
    if truth is not None:
        numbers["truth"] = {
            "distance_exponent": truth.distance_exponent,
            "cosine_exponent": _cosine_exponent(truth, middle),
            "lamp_offset": list(truth.offset),
        }
    if gains is not None and true_gains is not None:
        errors = (gains.log() - true_gains.log()).expand(-1, 3)
        numbers["gain_error_rms"] = errors.square().mean(0).sqrt().tolist()
    by_distance, by_angle = learned or (None, None)
    true_by_distance, true_by_angle = true or (None, None)
    return LightMap(
        distances=distances,
        angles=angles,
        by_distance=by_distance,
        by_angle=by_angle,
        true_by_distance=true_by_distance,
        true_by_angle=true_by_angle,
        times=() if gain is None else gain.times,
        gains=gains,
        true_gains=true_gains,
        numbers=numbers,
    )


def write_light_map(trained: TrainedRun, folder: Path) -> None:
    """Write ``light.json``, and ``light.html`` with charts of the law and the gains, into a folder.

    Raises:
        InputError: See :func:`light_map`; or the files cannot be written.
    """
    found = light_map(trained)
    unit = trained.scene.length_unit
    middle = found.numbers["reference_distance"]
    curves = {"distances": found.distances, "angles": found.angles, "by_distance": found.by_distance}
    curves |= {"by_angle": found.by_angle, "true_by_distance": found.true_by_distance}
    curves |= {"true_by_angle": found.true_by_angle, "gains": found.gains, "true_gains": found.true_gains}
    plain = {name: None if values is None else values.tolist() for name, values in curves.items()}
    write_json(folder / "light.json", found.numbers | {"times": list(found.times), "curves": plain})
    sections = []
    if found.by_distance is not None and found.by_angle is not None:
        for x, learned, true, label in (
            (found.distances, found.by_distance, found.true_by_distance, f"distance on the optical axis, {unit}"),
            (found.angles, found.by_angle, found.true_by_angle, f"angle to the axis at {middle:.3g} {unit}, degrees"),
        ):
            truth = None if true is None else true[:, None]
            sections.append(_chart("Attenuation", x, learned, truth, label, "factor on encoded colours"))
    if found.gains is not None:
        order = torch.tensor(found.times, dtype=torch.float64).argsort()
        true_gains = None if found.true_gains is None else found.true_gains[order]
        times = torch.tensor(found.times, dtype=torch.float64)[order]
        sections.append(_chart("Gain", times, found.gains[order], true_gains, "frame", "gain on encoded colours"))
    facts = {"method": trained.method, "scene": trained.scene.name, "step": str(trained.step), **_facts(found.numbers)}
    header = f"<h1>Light of {trained.method} on {trained.scene.name}</h1>{fact_list(facts)}"
    write_page(folder / "light.html", "Light", header, sections)


def _relative(
    law: Any, rays: tuple[Tensor, Tensor, Tensor], device: torch.device
) -> tuple[Float[Tensor, "P C"], Float[Tensor, "P C"]] | None:
    """A law along two curves, relative to its value at a third point; None where there is no law."""
    values = [law(points.float().to(device)) for points in rays]
    if values[0] is None:
        return None
    along, around, at = (part.cpu().double() for part in values)
    return along / at, around / at


def _centred(logs: Float[Tensor, "F C"]) -> Float[Tensor, "F C"]:
    return logs - logs.mean(0)


def _true_gains(truth: TrueLight, scene: Scene) -> Float[Tensor, "F 3"] | None:
    if any(frame.index not in truth.gains for frame in scene.train):
        return None
    linear = torch.tensor([truth.gains[frame.index] for frame in scene.train], dtype=torch.float64)
    return _centred(linear.log() / truth.gamma).exp()


def _cosine_exponent(truth: TrueLight, distance: float) -> float:
    """Slope of the true log attenuation over log cos theta, 0 to 45 degrees from the axis at one distance."""
    theta = torch.linspace(0.0, math.pi / 4, 46, dtype=torch.float64)
    points = distance * torch.stack([theta.sin(), torch.zeros_like(theta), theta.cos()], dim=1)
    logs, cosines = truth.attenuation(points).log(), theta.cos().log()
    # What the distance to a lamp off the lens changes belongs to the distance's exponent.
    lamp = (points - points.new_tensor(truth.offset)).norm(dim=1).log()
    logs = logs - truth.distance_exponent * lamp
    return float(((logs - logs[0]) * cosines).sum() / cosines.square().sum())


def _facts(numbers: dict[str, Any]) -> dict[str, str]:
    law, true = numbers["learned"].get("field", {}), numbers.get("truth", {})
    facts = {}
    for name in ("distance_exponent", "cosine_exponent", "lamp_offset"):
        if name in law:
            beside = f" (true: {_numbers(true[name])})" if name in true else ""
            facts[name.replace("_", " ")] = _numbers(law[name]) + beside
    if "gain_error_rms" in numbers:
        facts["gain error, rms"] = ", ".join(f"{value:.1%}" for value in numbers["gain_error_rms"])
    return facts


def _numbers(values: Any) -> str:
    return ", ".join(f"{value:.3g}" for value in (values if isinstance(values, list) else [values]))


def _chart(
    title: str,
    x: Float[Tensor, "P"],
    learned: Float[Tensor, "P C"],
    true: Float[Tensor, "P K"] | None,
    x_label: str,
    y_label: str,
) -> str:
    """A section with one chart: the learned channels, and the true ones."""
    lines = []
    for values, kind in ((learned, "learned"), (true, "true")):
        if values is None:
            continue
        names = _CHANNELS if values.shape[1] == len(_CHANNELS) else ("all channels",)
        for channel, (column, name) in enumerate(zip(values.T.tolist(), names, strict=True)):
            style = channel if kind == "learned" else _TRUTH_STYLE - channel
            lines.append(Series(f"{kind}, {name}", style, x.tolist(), column))
    keys = "".join(f'<span class="{style_classes(line.style)}">&#9632; {line.name}</span> ' for line in lines)
    return f"<section><h2>{title} over {x_label}</h2><p>{keys}</p>{line_chart(lines, x_label, y_label)}</section>"
