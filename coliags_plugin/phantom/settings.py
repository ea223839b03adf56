"""Settings of phantoms and the two presets of light and motion."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import AfterValidator, Field, field_validator, model_validator
from typing_extensions import Self

from coliags_plugin.config.yaml_tree import tuples
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.registry import phantom_layouts
from coliags_plugin.core.settings import Settings, validated

if TYPE_CHECKING:
    from coliags_plugin.geometry.lenses.endoscopes import Endoscope

#: A colour matrix that changes nothing.
SAME_COLORS = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))

GainMode = Literal["auto", "fixed"]
#: Of a lamp: exp(-spread (1 - cos psi)), Modrzejewski 2020, or cos^spread psi.
SpreadLaw = Literal["exponential", "cosine"]


def _near_lens(offset: tuple[float, float, float]) -> tuple[float, float, float]:
    # The camera keeps 6 mm from the wall, so a lamp within 5 mm of it never enters the wall.
    if not math.hypot(*offset) <= 5.0:
        raise ValueError(f"the lamp is {math.hypot(*offset):.3g} mm from the lens; it must be within 5 mm")
    return offset


_Triple = tuple[float, float, float]
_Albedo = Annotated[float, Field(ge=0.02, le=0.9)]
_Error = Annotated[float, Field(ge=0.0, le=5.0)]
_Offset = Annotated[_Triple, AfterValidator(_near_lens)]


@dataclass(frozen=True)
class Preset:
    """Lamp and lens, defaults of settings left at None (see :class:`PhantomSettings`), and motion parameters.

    The default is ``c3vd``, which is fair: its fall-off towards the rim adds up to the cos^1.25 that a free fit of real
    C3VD pixels gave, its look direction stays near C3VD's median of 7 degrees, and its exposure is automatic
    (docs/phantom.md 3, 4).
    """

    light_offset: tuple[float, float, float] = (0.0, 0.0, -3.6)
    spread_law: SpreadLaw = "exponential"
    spread: float = 0.75  # how narrow the beam is
    vignetting: float = 0.5  # exponent of the lens's cos theta fall-off
    tilt: float = 0.6  # lamp axis against optical axis, downwards, degrees; measured 0.64 on one endoscope
    gain: GainMode = "auto"
    white_balance_drift: float = 0.02
    turn: tuple[float, float, float] = (5.5, 4.5, 3.0)  # largest yaw, pitch and roll of the wobble, degrees
    scan: float = 28.0  # largest rotation away from the lumen of the rotation trajectory, degrees
    wobble: tuple[float, float] = (1.5, 3.0)  # smallest and largest lateral excursion from the centre line, mm
    approaches: int = 0  # how often the camera comes close to the wall
    closest: float = 9.0  # camera-to-wall distance of an approach, mm


#: ``strong`` is the stress case (docs/phantom.md 4): the lamp at the lens, cos^1.5 spread under cos^2.5 vignetting, a
#: fixed exposure, large rotations and two approaches to 9 mm.
PRESETS: dict[str, Preset] = {
    "c3vd": Preset(),
    "strong": Preset(
        light_offset=(0.0, 0.0, 0.0),
        spread_law="cosine",
        spread=1.5,
        vignetting=2.5,
        tilt=0.0,
        gain="fixed",
        white_balance_drift=0.0,
        turn=(16.0, 14.0, 12.0),
        scan=34.0,
        wobble=(1.5, 3.5),
        approaches=2,
    ),
}


#: Settings of the preset ``in-vivo`` where none are given.
IN_VIVO: dict[str, Any] = {
    "trajectory": "examination",
    "frames": 240,
    "width": 384,
    "height": 384,
    "rotation_views": 0,
    "light": "c3vd",
    "light_offset": (0.0, 0.0, -1.5),
    "interreflection": 0.1,
    "roughness": 0.17,
    "albedo": (0.74, 0.265, 0.125),
    "gain_lag": 0.5,
    "gain_span": 40.0,
    "turns": 5,
    "contacts": 1,
    "wave": 2.0,
    "breathing": 1.0,
    "shutter": 0.3,
    "softness": 1.0,
    "fluid": 3.0,
    "bubbles": 60,
    "fold_spacing": 11.0,
    "texture": 0.4,
    "polyps": 1,
}


class PhantomSettings(Settings):
    """Settings of a phantom: colon, endoscope, light, motion and folder layout.

    Ranges cover published values of colons and endoscopes (docs/phantom.md 1, 2, 3). Light offset, gain and drift of
    the white balance that are None take the values of the preset named by ``light``.
    """

    seed: int = Field(0, ge=0)  # seed of all random numbers of the phantom
    layout: str = "c3vd"  # files and folders to write; docs/phantom.md 5 lists the layouts
    # Defaults of other settings. in-vivo: a phantom that looks like the video of a patient.
    preset: Literal["in-vivo"] | None = None
    # pullback: withdrawal along the lumen. rotation: the camera mostly rotates in place. inspection: a withdrawal that
    # approaches three spots of the wall. examination: back and forth, with fast turns.
    trajectory: Literal["pullback", "rotation", "inspection", "examination"] = "pullback"
    frames: int = Field(120, ge=9, le=2000)  # frames of the sequence; every 8th is a test frame
    width: int | None = Field(None, ge=16, le=4096)  # image width, pixels. None: the layout's own
    height: int | None = Field(None, ge=16, le=4096)  # image height, pixels. None: the layout's own
    # Number of test views at positions of the path, rotated by 15 to 30 degrees; none in layouts that do not support
    # them.
    rotation_views: int = Field(12, ge=0, le=500)
    supersampling: int = Field(2, ge=1, le=4)  # colour samples per pixel side; depth is never averaged

    light: Literal["c3vd", "strong"] = "c3vd"  # preset of light and motion; see PRESETS
    # A real endoscope, endomapper-01 to endomapper-18: its lens in place of the layout's, and its beam in place of that
    # of ``light`` and the vignetting (docs/phantom.md 3.3).
    endoscope: str | None = None
    # auto: exposure follows the image with a lag. fixed: one exposure for the whole sequence.
    gain: GainMode | None = None
    # Lamp in camera axes (x right, y down, z forward), mm, at most 5 mm from the lens. A fitted real endoscope: (-0.06,
    # -1.14, -3.61).
    light_offset: _Offset | None = None
    # Lamps in place of the one at light_offset, in its unit and limits; each has the beam, shadows and glints of its
    # own.
    lamps: tuple[_Offset, ...] = Field((), max_length=8)
    # Relative light of each of the lamps, 0 to 1 after division by their sum; none: equal.
    lamp_shares: tuple[float, ...] = ()
    interreflection: float = Field(1.0, ge=0.0, le=1.0)  # scale of indirect light; 1 is the solved radiosity, 0 none
    specular: float = Field(1.0, ge=0.0, le=1.0)  # scale of the mucus film's Fresnel reflection
    # Standard deviation of the slopes of a diffuse wall, degrees (Oren-Nayar); 0 is Lambert's.
    diffuse_roughness: float = Field(0.0, ge=0.0, le=60.0)
    roughness: float = Field(0.3, ge=0.15, le=0.7)  # GGX roughness of the mucus film, whose alpha is its square
    albedo: tuple[_Albedo, _Albedo, _Albedo] = (0.78, 0.29, 0.22)  # mean of the mucosa, linear RGB (docs/phantom.md 1)

    # Mean of the encoded image that the exposure aims at; C3VD has .19 to .59 (docs/phantom.md 3).
    target_grey: float = Field(0.45, ge=0.1, le=0.8)
    # What the exposure goes by. mean: target_grey in all of the image. centre: the same, mostly in its middle. peak:
    # all but the brightest 2 % of the image stays below grey level 230.
    metering: Literal["mean", "centre", "peak"] = "mean"
    # Steps in which the automatic gain moves, EV (factors of 2); 0: smoothly.
    gain_steps: float = Field(0.0, ge=0.0, le=2.0)
    # Exposure of rotation views. metered: what automatic exposure settles at. frame: that of the frame at their
    # position, as if the camera turned faster than its exposure.
    rotation_exposure: Literal["metered", "frame"] = "metered"
    gain_lag: float = Field(2.0, ge=0.0, le=100.0)  # time constant of the automatic exposure, frames; 0 follows at once
    # Largest over smallest automatic gain, linear; C3VD's cecum_t1_a spans 3.
    gain_span: float = Field(3.0, ge=1.0, le=100.0)
    # Standard deviation of the slow drift of log red/green and blue/green gain.
    white_balance_drift: float | None = Field(None, ge=0.0, le=0.2)
    gamma: float = Field(2.2, ge=1.0, le=3.0)  # camera response: pixel = linear^(1/gamma)
    # Share of a smoothstep in the tone curve, after gamma: contrast; 0 is none.
    s_curve: float = Field(0.0, ge=0.0, le=0.9)
    # Red, green and blue of the camera, in rows, from those of the light; rows sum to 1, off-diagonals are -0.3 to 0.3.
    color_matrix: tuple[_Triple, _Triple, _Triple] = SAME_COLORS
    sharpening: float = Field(0.0, ge=0.0, le=3.0)  # amount of the video processor's unsharp mask; 0 is none
    sharpening_radius: float = Field(1.0, ge=0.3, le=5.0)  # standard deviation of its Gaussian, pixels
    # Quality of a JPEG through which images go before they are stored; None: none.
    compression: int | None = Field(None, ge=1, le=100)
    # Standard deviation of shot and read noise at mid grey, grey levels of 255.
    noise: float = Field(1.5, ge=0.0, le=8.0)

    # Standard deviation of a slow drift of given poses, in each axis, mm and degrees; training frames jitter by a
    # fifth of it besides.
    pose_noise: tuple[_Error, _Error] = (0.0, 0.0)
    # Relative standard deviation of the given depth of training frames, smooth over the image; depth also bleeds over
    # edges. 0: exact.
    depth_noise: float = Field(0.0, ge=0.0, le=0.5)

    polyps: int = Field(4, ge=0, le=20)  # sessile polyps, 3 to 10 mm wide
    path_length: float = Field(50.0, ge=0.0, le=60.0)  # length of the pullback, mm; C3VD's median is 47
    frame_rate: float = Field(15.0, ge=1.0, le=120.0)  # frames per second, for all that moves in time
    turns: int = Field(4, ge=0, le=50)  # fast turns of an examination, 30 to 50 degrees within 0.35 s
    contacts: int = Field(1, ge=0, le=20)  # how often the lens touches the wall in an examination
    wave: float = Field(0.0, ge=0.0, le=4.0)  # amplitude of the peristaltic wave of the wall's radius, mm; 0 is none
    breathing: float = Field(0.0, ge=0.0, le=4.0)  # amplitude with which breathing bends the centre line, mm; 0 is none
    shutter: float = Field(0.0, ge=0.0, le=1.0)  # share of the frame interval that is exposed: motion blur; 0 is none
    softness: float = Field(0.0, ge=0.0, le=4.0)  # standard deviation of the lens's blur, pixels; 0 is none
    fluid: float = Field(0.0, ge=0.0, le=8.0)  # depth of a pool of fluid, mm; 0 is none
    bubbles: int = Field(0, ge=0, le=1000)  # number of bubbles that drift along the wall, in clusters
    tool: bool = False  # whether a tool moves in and out of the working channel
    washes: int = Field(0, ge=0, le=20)  # how often a wash leaves drops on the lens for 1.2 s
    fold_spacing: float = Field(25.0, ge=8.0, le=40.0)  # mean distance of folds along the colon, mm
    texture: float = Field(1.0, ge=0.0, le=1.0)  # contrast of the mucosa's colours and fine relief
    mesh_spacing: float = Field(0.42, ge=0.2, le=4.0)  # distance of mesh vertices, mm
    texture_spacing: float = Field(0.1, ge=0.05, le=2.0)  # size of a texel of the mucosa, mm

    @model_validator(mode="before")
    @classmethod
    def _presets_where_not_given(cls, options: Any) -> Any:
        if not isinstance(options, dict):
            return options
        options = {**IN_VIVO, **options} if options.get("preset") == "in-vivo" else options
        light = PRESETS.get(str(options.get("light", "c3vd")))
        missing = [name for name in ("light_offset", "gain", "white_balance_drift") if options.get(name) is None]
        return options if light is None else {**options, **{name: getattr(light, name) for name in missing}}

    @field_validator("layout")
    @classmethod
    def _layout_is_known(cls, name: str) -> str:
        if name not in phantom_layouts:
            raise ValueError(f"unknown layout; known are {', '.join(phantom_layouts)}")
        return name

    @field_validator("endoscope")
    @classmethod
    def _endoscope_is_known(cls, name: str | None) -> str | None:
        try:
            _endoscope(name)
        except InputError as error:
            raise ValueError(str(error)) from error
        return name

    @field_validator("lamp_shares")
    @classmethod
    def _shares_are_light(cls, shares: tuple[float, ...]) -> tuple[float, ...]:
        if shares and not (min(shares) >= 0.0 and 0.0 < sum(shares) < math.inf):
            raise ValueError(f"shares {shares}; must be 0 or more, and one of them more")
        return shares

    @field_validator("color_matrix")
    @classmethod
    def _grey_stays_grey(cls, matrix: tuple[_Triple, _Triple, _Triple]) -> tuple[_Triple, _Triple, _Triple]:
        for number, row in enumerate(matrix):
            if not abs(sum(row) - 1.0) <= 1e-6:
                raise ValueError(f"row {row} sums to {sum(row):.6g}; must be 1, so that grey stays grey")
            if not all(abs(value) <= 0.3 for column, value in enumerate(row) if column != number):
                raise ValueError(f"row {row} has an off-diagonal beyond 0.3")
        return matrix

    @model_validator(mode="after")
    def _a_share_for_each_lamp(self) -> Self:
        if self.lamp_shares and len(self.lamp_shares) != len(self.lamps):
            raise ValueError(f"{len(self.lamp_shares)} lamp_shares of {len(self.lamps)} lamps; must be one of each")
        return self

    @property
    def moves(self) -> bool:
        """Return whether the wall moves."""
        return self.wave > 0.0 or self.breathing > 0.0

    @property
    def covers(self) -> bool:
        """Return whether anything but the wall is in view."""
        return bool(self.fluid or self.bubbles or self.tool or self.washes)

    @property
    def real_endoscope(self) -> Endoscope | None:
        """The endoscope whose lens and beam the phantom has; None: those of layout and preset."""
        return _endoscope(self.endoscope)

    @property
    def light_preset(self) -> Preset:
        """The preset of light and motion, with the beam of the real endoscope if there is one."""
        preset, real = PRESETS[self.light], self.real_endoscope
        # The power was fitted to images, so that it holds the lens's vignetting.
        return replace(preset, spread_law="cosine", spread=real.power, vignetting=0.0) if real else preset


def _endoscope(name: str | None) -> Endoscope | None:
    from coliags_plugin.geometry.lenses.endoscopes import endoscope  # with numpy, which --help does without

    return None if name is None else endoscope(name)


def phantom_settings(options: Mapping[str, Any]) -> PhantomSettings:
    """Validate plain options; an error names the first that is unknown, of the wrong type or out of range."""
    plain: dict[str, Any] = {name: tuples(value) for name, value in options.items()}
    return validated(PhantomSettings, plain, "phantom setting", "the page Options of the documentation lists all")
