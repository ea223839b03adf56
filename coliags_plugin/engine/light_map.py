"""The light that a run has learned: its law, gains and camera response, beside a phantom's true ones."""

from __future__ import annotations

import csv
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from coliags_plugin.contracts import GainModule, LampAware, ResponseModule
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.files import write_json
from coliags_plugin.core.json_files import JsonObject, read_json
from coliags_plugin.core.scenes import Scene
from coliags_plugin.engine.trained import TrainedRun
from coliags_plugin.lighting.beams import SpreadLaw, beam
from coliags_plugin.lighting.tone_curve import encode
from coliags_plugin.reporting.html_page import write_html
from coliags_plugin.reporting.model import Fact, Figures, Page, Section
from coliags_plugin.results.light import LIGHT_FILE, light_charts, light_facts

#: Largest angle to the optical axis that is shown, degrees, and number of points of a curve.
_MAX_ANGLE, _POINTS = 60.0, 61
#: Largest colour before the response curve that is shown.
_MAX_COLOR = 1.5


@dataclass(frozen=True)
class TrueLight:
    """Lamp, vignetting, camera response and gains of a phantom."""

    offset: tuple[float, float, float]  # of the lamp in camera axes, mm
    axis: tuple[float, float, float]  # unit direction of the beam in camera axes
    spread_law: SpreadLaw  # angular fall-off of the beam (docs/phantom.md 2)
    spread: float
    vignetting: float  # exponent of cos theta at the lens, in linear light
    gamma: float  # of the camera's response
    knee: float  # a soft shoulder of the response bends what is above it, in linear light
    gains: Mapping[int, tuple[float, float, float]]  # red, green, blue in linear light, by the frame's index

    @property
    def distance_exponent(self) -> float:
        """Of encoded colours over the distance to the lamp: -2 / gamma."""
        return -2.0 / self.gamma

    def response(self, colors: Float[Tensor, "P"]) -> Float[Tensor, "P"]:
        """Pixel values of encoded colours that had no shoulder: the identity below the shoulder. [P]"""
        return torch.from_numpy(encode(colors.numpy() ** self.gamma, self.gamma, self.knee))

    def attenuation(self, points: Float[Tensor, "N 3"]) -> Float[Tensor, "N"]:
        """Factor of the lamp's direct light on encoded colours at points in camera axes, mm, up to a constant. [N]"""
        sight = points - points.new_tensor(self.offset)
        distances = sight.norm(dim=1)
        psi = sight @ points.new_tensor(self.axis) / distances
        emitted = torch.from_numpy(beam(psi.numpy(), self.spread_law, self.spread))
        theta = (points[:, 2] / points.norm(dim=1)).clamp_min(0.0)
        linear = emitted * theta.pow(self.vignetting) / distances.square()
        return linear.pow(1.0 / self.gamma)


def find_true_light(scene: Path) -> TrueLight | None:
    """The light of the phantom in a folder; None where it is no phantom, or has a light that no such law describes."""
    file = scene / "truth" / "light.json"
    if not file.is_file():
        return None
    try:
        record: dict[str, Any] = read_json(file, "the light of a phantom")
        if record.keys() & {"lamps", "s_curve", "color_matrix"}:
            return None
        lamp = record["lamp"]
        with (file.parent / "gain.csv").open(newline="", encoding="utf-8") as rows:
            gains = {
                int(row["frame"]): (float(row["gain_r"]), float(row["gain_g"]), float(row["gain_b"]))
                for row in csv.DictReader(rows)
            }
        return TrueLight(
            offset=tuple(lamp["offset"]),
            axis=tuple(lamp["axis"]),
            spread_law=lamp["spread_law"],
            spread=float(lamp["spread"]),
            vignetting=float(record["vignetting"]),
            gamma=float(record["gamma"]),
            knee=float(record["shoulder_knee"]),
            gains=gains,
        )
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(f"{file}: {error!r}", "the light of a phantom, with gain.csv beside it") from error


@torch.no_grad()
def light_map(trained: TrainedRun) -> JsonObject | None:
    """Light that a run has learned, beside a phantom's; None where it has learned none, or no points are in view.

    What was learned, how far it is from the truth, and ``curves``: of factors on encoded colours, relative to the
    optical axis at ``reference_distance``, over scene units on the axis and over degrees at that distance; of encoded
    gains with a geometric mean of 1 at ``times``, the indices of the training frames; and of the pixel values of
    ``colors``. Each curve is None where nothing was learned, or where the scene is no phantom.
    """
    model, scene = trained.model, trained.scene
    parts = model.view_modules.values()
    gain = next((part for part in parts if isinstance(part, GainModule)), None)
    curve = next((part for part in parts if isinstance(part, ResponseModule)), None)
    field = model.field if isinstance(model.field, LampAware) else None
    depths = scene.depths_in_view().double().cpu().numpy()
    if len(depths) == 0:
        return None
    low, middle, high = np.quantile(depths, (0.02, 0.5, 0.98)).tolist()
    distances = torch.linspace(low, high, _POINTS, dtype=torch.float64)
    angles = torch.linspace(0.0, _MAX_ANGLE, _POINTS, dtype=torch.float64)
    radians = angles.deg2rad()
    axis = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    around = middle * torch.stack([radians.sin(), torch.zeros_like(radians), radians.cos()], dim=1)
    rays = (distances[:, None] * axis, around, middle * axis[None])
    learned = None if field is None else _relative(field.attenuation, rays, trained.device, model.scale)
    if learned is None and gain is None and curve is None:
        return None
    truth = None if scene.folder is None else find_true_light(scene.folder)
    true = None if truth is None else _relative(truth.attenuation, rays, torch.device("cpu"))
    gains = None if gain is None else _centred(gain.log_gains().cpu().double()).exp()
    true_gains = None if truth is None or gains is None else _true_gains(truth, scene)
    colors = torch.linspace(0.0, _MAX_COLOR, _POINTS, dtype=torch.float64)
    numbers: JsonObject = {"learned": model.learned, "reference_distance": middle, "unit": scene.length_unit}
    if truth is not None:
        numbers["truth"] = {
            "distance_exponent": truth.distance_exponent,
            "cosine_exponent": _cosine_exponent(truth, middle),
            "incidence_exponent": 1.0 / truth.gamma,
            "lamp_offset": list(truth.offset),
        }
    if gains is not None and true_gains is not None:
        errors = (gains.log() - true_gains.log()).expand(-1, 3)
        numbers["gain_error_rms"] = errors.square().mean(0).sqrt().tolist()
    by_distance, by_angle = learned or (None, None)
    true_by_distance, true_by_angle = true or (None, None)
    curves = {
        "distances": distances,
        "angles": angles,
        "by_distance": by_distance,
        "by_angle": by_angle,
        "true_by_distance": true_by_distance,
        "true_by_angle": true_by_angle,
        "gains": gains,
        "true_gains": true_gains,
        "colors": colors,
        "response": None if curve is None else curve.curve(colors.float().to(trained.device)).cpu().double(),
        "true_response": None if truth is None or curve is None else truth.response(colors),
    }
    plain = {name: None if values is None else values.tolist() for name, values in curves.items()}
    return numbers | {"times": [] if gain is None else list(gain.times), "curves": plain}


def write_light_map(trained: TrainedRun, folder: Path) -> None:
    """Write ``light.json``, and ``light.html`` with charts of law, gains and response, into a folder."""
    record = light_map(trained)
    if record is None:
        raise InputError(
            f"a light map of method '{trained.method}', which has learned no law of attenuation, gains or "
            "response curve, or has no points in view",
            "a method with appearance head 'attenuated', or with module 'gain' or 'response', such as coliags-plus, "
            "and initial points",
        )
    write_json(folder / LIGHT_FILE, record)
    facts = [Fact("method", trained.method), Fact("scene", trained.scene.name), Fact("step", trained.step)]
    charts = Section("Curves", [Figures(light_charts(record))])
    title = f"Light of {trained.method} on {trained.scene.name}"
    write_html(Page(title, [charts], [*facts, *light_facts(record)]), folder / "light.html")


def _relative(
    law: Any, rays: tuple[Tensor, Tensor, Tensor], device: torch.device, scale: float = 1.0
) -> tuple[Float[Tensor, "P C"], Float[Tensor, "P C"]] | None:
    """Attenuation over distance and over angle, relative to the axis at the median distance; None without a law."""
    values = [law(scale * points.float().to(device)) for points in rays]
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
    """Slope of the true log attenuation over log cos psi at the lamp, 0 to 45 degrees from the axis at one distance."""
    theta = torch.linspace(0.0, math.pi / 4, 46, dtype=torch.float64)
    points = distance * torch.stack([theta.sin(), torch.zeros_like(theta), theta.cos()], dim=1)
    rays = points - points.new_tensor(truth.offset)
    lengths = rays.norm(dim=1)
    # What the distance to a lamp off the lens changes belongs to the distance's exponent.
    logs = truth.attenuation(points).log() - truth.distance_exponent * lengths.log()
    cosines = (rays[:, 2] / lengths).log()
    logs, cosines = logs - logs[0], cosines - cosines[0]
    return float((logs * cosines).sum() / cosines.square().sum())
