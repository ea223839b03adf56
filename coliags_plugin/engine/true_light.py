"""The true light of a phantom, as encoded colours see it."""

from __future__ import annotations

import csv
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.json_files import read_json
from coliags_plugin.lighting.beams import SpreadLaw, beam
from coliags_plugin.lighting.tone_curve import encode


@dataclass(frozen=True)
class TrueLight:
    """Lamp, vignetting, camera response and gains of a phantom.

    Attributes:
        offset: Of the lamp in camera axes, mm.
        axis: Unit direction of the beam in camera axes.
        spread_law, spread: Angular fall-off of the beam (docs/phantom.md 2).
        vignetting: Exponent of cos theta at the lens, in linear light.
        gamma, knee: Of the camera's response; a soft shoulder bends what is above the knee, in linear light.
        gains: Red, green and blue gain in linear light by the frame's index in the video.
    """

    offset: tuple[float, float, float]
    axis: tuple[float, float, float]
    spread_law: SpreadLaw
    spread: float
    vignetting: float
    gamma: float
    knee: float
    gains: Mapping[int, tuple[float, float, float]]

    @property
    def distance_exponent(self) -> float:
        """Of encoded colours over the distance to the lamp: -2 / gamma."""
        return -2.0 / self.gamma

    def response(self, colors: Float[Tensor, "P"]) -> Float[Tensor, "P"]:
        """Pixel values of encoded colours that had no shoulder: the identity below the shoulder. [P]"""
        return torch.from_numpy(encode(colors.numpy() ** self.gamma, self.gamma, self.knee))

    def attenuation(self, points: Float[Tensor, "N 3"]) -> Float[Tensor, "N"]:
        """Factor of the lamp's direct light on encoded colours, up to a constant. [N]

        Args:
            points: In camera axes, mm. [N, 3]
        """
        sight = points - points.new_tensor(self.offset)
        distances = sight.norm(dim=1)
        psi = sight @ points.new_tensor(self.axis) / distances
        emitted = torch.from_numpy(beam(psi.numpy(), self.spread_law, self.spread))
        theta = (points[:, 2] / points.norm(dim=1)).clamp_min(0.0)
        linear = emitted * theta.pow(self.vignetting) / distances.square()
        return linear.pow(1.0 / self.gamma)


def find_true_light(scene: Path) -> TrueLight | None:
    """The light of the phantom in a folder; None where it is no phantom.

    Args:
        scene: The folder of a scene.

    Raises:
        InputError: Its truth is damaged.
    """
    file = scene / "truth" / "light.json"
    if not file.is_file():
        return None
    try:
        record: dict[str, Any] = read_json(file, "the light of a phantom")
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
