"""Small sound components, and copies of them each of which breaks the contract in one way."""

from __future__ import annotations

import itertools
import random
from dataclasses import replace
from pathlib import Path
from runpy import run_path

import torch
from pydantic import BaseModel, ConfigDict, field_validator
from torch import nn

from coliags_plugin.contracts import (
    Draw,
    Loss,
    LossSettings,
    Protocol,
    RadianceField,
    RadianceSamples,
    Sampler,
    Strategy,
    ViewModule,
)
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.settings import Settings
from coliags_plugin.core.tensors import masked_mean
from coliags_plugin.engine.samplers import FrameSampler
from coliags_plugin.renderers.cpu_renderer import CpuRenderer
from coliags_plugin.renderers.volume_renderer import VolumeRenderer

EXAMPLE = Path(__file__).parents[2] / "docs" / "example_package" / "coliags_round" / "field.py"
RoundGaussians = run_path(str(EXAMPLE))["RoundGaussians"]


class Balls(RoundGaussians):
    """The example's field of round Gaussians, at some of the initial points, with a buffer that has rows."""

    class Settings(Settings):
        """One option."""

        size: float = 2.0

    elements = "balls"

    def __init__(self, settings, count):
        super().__init__(settings, count)
        self.register_buffer("ages", torch.zeros(count))

    @property
    def element_count(self):
        return len(self.means)

    @classmethod
    def from_scene(cls, scene, settings, generator):
        points = replace(scene.points, positions=scene.points.positions[::25], colors=None)
        return super().from_scene(replace(scene, points=points), settings, generator)


class Fog(RadianceField):
    """One density and one colour everywhere in front of a plane, and others behind it."""

    Settings = Settings

    def __init__(self):
        super().__init__()
        self.near = nn.Parameter(torch.tensor([-4.0, 0.0, 0.0, 0.0]))
        self.far = nn.Parameter(torch.zeros(4))

    @classmethod
    def from_scene(cls, scene, settings, generator):
        return cls()

    @classmethod
    def from_state(cls, state, settings):
        field = cls()
        field.load_state_dict(state)
        return field

    def query(self, positions, directions, camera, generator=None):
        behind = (positions - camera.center.to(positions)).norm(dim=-1, keepdim=True) > 25.0
        values = torch.where(behind, self.far, self.near)
        return RadianceSamples(nn.functional.softplus(values[..., 0]), values[..., 1:].sigmoid())

    def parameter_groups(self):
        return {"near": [self.near], "far": [self.far]}


class Colour(Loss):
    """Mean absolute difference of colours."""

    Settings = LossSettings

    def __call__(self, step):
        return masked_mean((step.output.rgb - step.target.rgb).abs(), step.target.mask)


class Division(Strategy):
    """Doubles the first rows every few steps, and counts the steps of every row."""

    class Settings(Settings):
        """One interval."""

        every: int = 100_000
        born: int = 3

    serves = frozenset({"balls"})
    counters = ("steps",)

    def __init__(self, settings, generator, schedule, extent):
        super().__init__(settings, generator, schedule, extent)
        self.steps = torch.zeros(0)
        self.every = schedule.interval(settings.every)

    def plan(self):
        return f"every {self.every} steps"

    @torch.no_grad()
    def after_backward(self, step, rows):
        field, born = step.model.field, self.settings.born
        if len(self.steps) == 0:
            self.steps = torch.zeros(len(field.means))
        self.steps += 1
        if step.step % self.every:
            return {}
        self.add(field, rows, born)
        return {"grown": born}

    def add(self, field, rows, born):
        moved = {"means": field.means[:born] + 1.0, "sizes": field.log_sizes[:born], "logits": field.logits[:born]}
        rows.add_rows(moved)
        field.ages = torch.cat([field.ages, torch.zeros(born)])
        self.steps = torch.cat([self.steps, torch.zeros(born)])


# Broken ones: what breaks is in the name.


def changed(base, **attributes):
    return type(base.__name__, (base,), {"__module__": __name__, **attributes})


class DoublesItsSize(Balls):
    class Settings(Settings):
        size: float = 2.0

        @field_validator("size")
        @classmethod
        def _double(cls, size):
            return 2.0 * size


class LooseSettings(BaseModel):
    model_config = ConfigDict(extra="allow", frozen=True)
    weight: float
    from_step: int = 0
    until_step: int | None = None

    def active(self, step, schedule):
        return True

    def weight_at(self, step, steps):
        return self.weight


class HasAnUngroupedParameter(Balls):
    def __init__(self, settings, count):
        super().__init__(settings, count)
        self.forgotten = nn.Parameter(torch.zeros(3))


AcceptsAnyOption = changed(Colour, Settings=LooseSettings)
CrashesWhenMade = changed(Balls, from_scene=lambda scene, settings, generator: 1 / 0)
SharesAParameter = changed(
    Balls, parameter_groups=lambda self: {**Balls.parameter_groups(self), "logits": [self.logits, self.means]}
)


def loss(change):
    """The loss with its value, at a step, changed by a function."""
    return changed(Colour, __call__=lambda self, step: change(Colour.__call__(self, step), step))


Maximised = loss(lambda value, step: -value)
DiffersFromRunToRun = loss(lambda value, step: value * random.uniform(0.9, 1.1))
TakesGlobalRandomNumbers = loss(lambda value, step: value * (0.9 + 0.2 * torch.rand(())))
AssumesDepth = loss(lambda value, step: value + 0.0 * step.target.depth.nanmean())
CountsMaskedPixels = loss(lambda value, step: (step.output.rgb - step.target.rgb).abs().mean())


def balls(change, **attributes):
    """The field with its Gaussians changed by a function."""
    return changed(Balls, gaussians=lambda self, camera, **chance: change(Balls.gaussians(self, camera)), **attributes)


HasADetachedGroup = balls(lambda gaussians: replace(gaussians, means=gaussians.means.detach()))
RendersWithChance = balls(lambda gaussians: replace(gaussians, means=gaussians.means + 0.01 * torch.randn(3)))
CrashesInALibrary = balls(lambda gaussians: torch.cat([gaussians.means, torch.zeros(2, 2)]))
NaNFeature = balls(
    lambda gaussians: replace(gaussians, features={"albedo": torch.full((len(gaussians.means), 1), torch.nan)}),
    feature_channels=frozenset({"albedo"}),
)


def renderer(render, base=CpuRenderer, **attributes):
    """A renderer that, but in training, calls a function with the method of its base and the arguments of that."""

    class Altered(base):
        def render(self, field, camera, wants=("rgb", "alpha"), pixels=None, generator=None):
            if generator is not None:
                return super().render(field, camera, wants, pixels, generator)
            return render(super().render, field, camera, wants, pixels)

    return changed(Altered, **attributes)


def spoiling(name, spoil):
    """A renderer one of whose maps is spoilt, where it is there, or left out: by None."""

    def render(draw, *request):
        output = draw(*request)
        maps = {key: spoil(values) if key == name else values for key, values in output.maps.items()}
        return replace(output, maps={key: values for key, values in maps.items() if values is not None})

    return renderer(render)


def without_expected_depth(draw, field, camera, wants, pixels):
    if "depth_expected" in wants:
        raise InputError("depth_expected", "another output")
    return draw(field, camera, wants, pixels)


def swapped(draw, field, camera, wants, pixels):
    output = draw(field, camera, wants, pixels)
    return output if pixels is None else replace(output, rgb=output.rgb.flip(0) + 0.01)


def spoilt_alpha(draw, *request):
    output = draw(*request)
    return replace(output, alpha=1.5 * output.alpha)


#: Names of all outputs.
NAMES = {name: name for name in CpuRenderer.outputs}

LacksNormals = spoiling("normals", lambda values: None)
DepthInMetres = spoiling("depth_median", lambda values: values / 1000.0)
FlatNormals = spoiling("normals", lambda values: values[..., 0])
AlphaAboveOne = renderer(spoilt_alpha)
FixedSize = renderer(lambda draw, field, camera, *rest: draw(field, replace(camera, width=40, height=32), *rest))
IgnoresUnknownOutputs = renderer(
    lambda draw, field, camera, wants, pixels: draw(field, camera, [name for name in wants if name in NAMES])
)
CrashesForUnknownOutputs = renderer(
    lambda draw, field, camera, wants, pixels: draw(field, camera, [NAMES[name] for name in wants])
)
IgnoresPixels = renderer(lambda draw, field, camera, wants, pixels: draw(field, camera, wants))
SwapsPixels = renderer(swapped, VolumeRenderer)
HasNoExpectedDepth = renderer(without_expected_depth, outputs=CpuRenderer.outputs - {"depth_expected"})


class CrashesForFreeCameras(ViewModule):
    Settings = Settings
    untrained_views = "as all"

    def parameter_groups(self):
        return {}

    def adjust_camera(self, camera, view):
        _ = view.name
        return camera


class ForgetsABuffer(Balls):
    glow = 0.0

    def before_step(self, step, schedule):
        self.glow = 0.01 * step

    def gaussians(self, camera, light=None, generator=None):
        plain = super().gaussians(camera)
        return replace(plain, colors=(plain.colors + self.glow).clamp_max(1.0))


class ReadsWhatIsThere(Balls):
    @classmethod
    def from_state(cls, state, settings):
        field = cls(settings, len(next(iter(state.values()))))
        field.load_state_dict(state, strict=False)
        return field


class ForgetsItsPlace(FrameSampler):
    def __init__(self, settings, sizes, generator):
        super().__init__(settings, sizes, generator)
        self.turns = itertools.count()

    def next(self):
        return [Draw(next(self.turns) % min(7, len(self.sizes)))]


class CrashesAlone(Sampler):
    """Needs two frames."""

    Settings = Settings
    whole_images = True

    def next(self):
        pairs = len(self.sizes) // 2
        if not self.queue:
            self.queue = torch.randint(2 * pairs, (4,), generator=self.generator).tolist()
        return [Draw(self.queue.pop())]


class ForgetsAGroup(Division):
    def add(self, field, rows, born):
        super().add(field, rows, born)
        rows.keep_rows(["logits"], torch.arange(len(field.logits)) < len(field.logits) - 1)


def forgetting(attribute, of_field):
    """A strategy that leaves an attribute of the field, or its own, as it was before rows came."""

    def add(self, field, rows, born):
        owner = field if of_field else self
        before = getattr(owner, attribute)
        Division.add(self, field, rows, born)
        setattr(owner, attribute, before)

    return changed(Division, add=add)


ForgetsTheBuffer, ForgetsTheCounter = forgetting("ages", of_field=True), forgetting("steps", of_field=False)


class GoesPastAdam(Division):
    def add(self, field, rows, born):
        field.means = nn.Parameter(torch.cat([field.means, field.means[:born]]))
        field.log_sizes = nn.Parameter(torch.cat([field.log_sizes, field.log_sizes[:born]]))
        field.logits = nn.Parameter(torch.cat([field.logits, field.logits[:born]]))


class ForgetsAfterAnEvent(Division):
    """Remembers the last event in an attribute that is no counter."""

    born_last = 0

    def add(self, field, rows, born):
        super().add(field, rows, born + self.born_last)
        self.born_last = born


class WantsAlbedo(Protocol):
    name, version, description = "wants-albedo", 1, "a broken one"
    wants = frozenset({"albedo"})
    metrics = {}  # noqa: RUF012

    def compare(self, output, frame):
        raise NotImplementedError
