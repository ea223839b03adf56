"""Components that do not fit are refused with one clear error before anything is written; modules around a field."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import nn

from coliags_plugin.config.method_config import load_method
from coliags_plugin.contracts import ViewModule
from coliags_plugin.core.errors import InputError, NothingDrawnError
from coliags_plugin.core.provenance import Provenance
from coliags_plugin.core.scenes import TO_GET_DEPTH, SparseDepth, View
from coliags_plugin.engine.model import Model, _check_data, _check_sampler
from coliags_plugin.fields.heads import MLPAppearanceHead
from coliags_plugin.losses.target import L1Loss
from coliags_plugin.modules.exposure import FrameGain
from coliags_plugin.renderers.splatting import ChosenRenderer
from coliags_plugin.renderers.torch_renderer import TorchRenderer, TorchRendererSettings
from coliags_plugin.renderers.volume_renderer import VolumeRenderer
from tests.engine.test_trainer import MODULES, make_trainer
from tests.renderers.test_torch_renderer import FieldOf, pinhole, random_gaussians
from tests.scenes import wall_scene

LOSSES = ("l1", "d-ssim", "scale-volume")


def start(folder, overrides=(), method="scaffold-gs", scene=None):
    return make_trainer(folder, method, 20, scene, overrides=overrides)


def test_what_was_made_from_held_out_images_is_warned_of(tmp_path, caplog):
    scene, used = wall_scene(), {"depth": ["0004", "0008"]}
    start(tmp_path / "own", scene=scene)
    assert "held-out" not in caplog.text
    start(tmp_path / "other", scene=replace(scene, provenance=Provenance(held_out_used=used)))
    assert f"scene '{scene.name}': its depth comes from images of 2 held-out frames too" in caplog.text


@pytest.mark.parametrize(
    ("method", "overrides", "message"),
    [
        (
            "3dgs",
            ["strategy=anchor-growth"],
            "strategy 'anchor-growth' changes anchors, and field 'gaussians' has gaussians",
        ),
        (
            "3dgs",
            ["losses.d={name: distortion, weight: 1.0}"],
            "distortion, which CpuRenderer does not deliver for this field",
        ),
        ("scaffold-gs", ["strategy=adaptive-density"], "strategy 'adaptive-density' changes gaussians"),
        ("scaffold-gs", ["sampler=pixels"], "sampler 'pixels' with renderer 'cpu', which draws whole images"),
        ("scaffold-gs", ["optimizers.mirrors={lr: 0.1}"], "optimizers names mirrors, which the model does not have"),
        ("scaffold-gs", ["renderer=volume"], "renderer 'volume' draws radiance, the field is made of gaussians3d"),
        (
            "scaffold-gs",
            ["losses.l1.from_step=20000", "losses.d-ssim=null", "losses.scale-volume=null"],
            "no loss term",
        ),
        ("scaffold-gs", [f"losses.{name}.until_step=15000" for name in LOSSES], "no loss term counts at step 11 of 20"),
    ],
)
def test_refused_by_name_before_anything_is_written(tmp_path, method, overrides, message):
    with pytest.raises(InputError) as caught:
        start(tmp_path / "run", overrides, method)
    assert message in str(caught.value)
    assert not (tmp_path / "run").exists()


def test_any_identifier_names_a_module(tmp_path):
    names = ("train", "keys", "type", "field")
    trainer = start(tmp_path / "run", [f"modules.{name}=gain" for name in names])
    assert set(trainer.model.view_modules) == set(names)


@pytest.mark.parametrize(
    ("method", "swap", "groups"),
    [
        ("coliags", "field.appearance_head.name=attenuated", {"attenuation", "lamp_offset"}),
        (
            "coliags",
            "field.appearance_head={name: attenuated, shadows: true}",
            {"attenuation", "lamp_offset", "shadow"},
        ),
        ("coliags-plus", "field.appearance_head.name=plain", {"exposure.gain", "response.slope"}),
        ("coliags-plus", "field.geometry_head=plain", {"poses.rotation", "poses.translation", "warp.displacement"}),
        ("3dgs", "field.name=surfels", {"sh0", "shN"}),
        ("3dgs", "field={name: lit-gaussians, normal_neighbours: 10}", {"albedos", "lamp"}),
        ("reim-nerf", "field.width=32", {"coarse", "fine"}),
    ],
)
def test_a_component_brings_its_learning_rates(tmp_path, method, swap, groups):
    trainer = start(tmp_path / "run", [swap], method)
    rates = trainer.method.config.optimizers
    assert trainer.optimizers.adam.keys() == trainer.model.parameter_groups().keys() >= groups
    assert rates.keys() - trainer.optimizers.adam.keys() <= {"shadow"}  # which is not there without shadows
    parts = [trainer.method.config.field, *trainer.method.config.modules.values()]
    declared = {group: rate["lr"] for part in parts for group, rate in part.rates.items()}
    assert all(rates[group].lr == declared[group.rpartition(".")[2]] for group in groups)


def test_groups_without_default_rates_are_named_with_those_of_similar_ones(tmp_path, monkeypatch):
    monkeypatch.setattr(MLPAppearanceHead, "rates", {})
    with pytest.raises(InputError, match="optimizers lacks the parameter groups color_mlp, for which") as caught:
        start(tmp_path / "run")
    rates = "opacity_mlp: {lr: 0.002, final_lr: 2.0e-05}; covariance_mlp: {lr: 0.004}"
    assert f'by default, {rates}. Set `optimizers."color_mlp"={{lr: ...}}`' in str(caught.value)
    monkeypatch.setattr(FrameGain, "rates", {})
    with pytest.raises(InputError, match=r"parameter groups exposure\.gain, .*, by default, \w+: \{lr: "):
        start(tmp_path / "run", ["modules.exposure=gain", "optimizers.color_mlp={lr: 0.01}"])


def test_a_loss_may_need_any_attribute_of_a_target(monkeypatch):
    monkeypatch.setattr(L1Loss, "needs", frozenset({"mask"}))
    losses, scene = {"l1": L1Loss(L1Loss.Settings(weight=1.0))}, wall_scene()
    with pytest.raises(InputError, match="needs mask, and no training frame"):
        _check_data(scene, losses)
    train = [frame.with_maps(mask=frame.valid) for frame in scene.train]
    _check_data(replace(scene, train=train), losses)


def test_terms_count_between_their_steps(tmp_path):
    trainer = start(tmp_path / "run", ["losses.scale-volume.from_step=15000", "losses.d-ssim.until_step=15000"])
    rows = [trainer.take_step() for _ in range(20)]
    assert [set(row["terms"]) for row in rows[:10]] == [{"l1", "d-ssim"}] * 10
    assert [set(row["terms"]) for row in rows[10:]] == [{"l1", "scale-volume"}] * 10


def test_the_methods_made_for_such_data_are_named(tmp_path, caplog):
    scene, points = wall_scene(), SparseDepth(torch.tensor([[3.5, 2.5]]), torch.tensor([20.0]))
    bare = [frame.with_maps(depth=None) for frame in scene.train]
    sparse = [replace(frame, sparse_depth=points) for frame in bare]
    for train, does in ((bare, "does nothing"), (sparse, "is of single points only"), (scene.train, None)):
        caplog.clear()
        start(tmp_path / "run", method="coliags-plus", scene=replace(scene, train=train))
        assert (f"loss term 'depth' {does}" in caplog.text, TO_GET_DEPTH in caplog.text) == (does is not None,) * 2
        if does is not None:
            with pytest.raises(InputError, match=TO_GET_DEPTH):
                start(tmp_path / "run", method="scaffold-gs-depth", scene=replace(scene, train=train))
    estimated = [frame.with_maps(depth_confidence=torch.ones_like(frame.depth)) for frame in scene.train]
    for method, warned in (("coliags", True), ("coliags-plus", False), ("scaffold-gs", False)):
        caplog.clear()
        start(tmp_path / "run", method=method, scene=replace(scene, train=estimated))
        assert ("coliags-plus is made for such scenes" in caplog.text) == warned
    start(tmp_path / "run", method="coliags", scene=scene)
    assert "estimated" not in caplog.text


def test_a_checkpoint_of_other_components_is_refused(tmp_path, monkeypatch):
    trainer = start(tmp_path / "run", MODULES)
    assert trainer.provenance()["untrained_views"].keys() == {"exposure", "poses"}
    trainer.start()
    trainer.take_step()
    trainer.save()
    with pytest.raises(InputError, match=r"other settings of .*modules"):
        start(tmp_path / "run").resume()
    fewer = replace(wall_scene(), train=wall_scene().train[:3])
    with pytest.raises(InputError, match="module 'exposure' does not fit"):
        start(tmp_path / "run", MODULES, scene=fewer).resume()
    later = start(tmp_path / "run", MODULES)
    monkeypatch.setattr(type(later.strategy), "counters", (*later.strategy.counters, "born"))
    with pytest.raises(InputError, match="lacks a counter of the strategy: 'born'"):
        later.resume()


def test_modules_of_whole_images_are_refused_with_batches_of_pixels(monkeypatch):
    config = load_method("scaffold-gs", ["modules.exposure=gain", "sampler=pixels"]).config
    monkeypatch.setattr(FrameGain, "whole_image", True)
    chosen = ChosenRenderer("volume", VolumeRenderer(VolumeRenderer.Settings()), "")
    with pytest.raises(InputError, match="module 'exposure' needs whole images, and sampler 'pixels'"):
        _check_sampler(config, chosen, {})


#: For a scene of a thousandth of the size; numba compiles kernels of surfels for long.
CHANGES = {"scaffold-gs": ["field.voxel_size=0.002"], "2dgs": ["renderer=torch"]}


@pytest.mark.parametrize("method", ["scaffold-gs", "3dgs", "2dgs"])
def test_metres_are_refused_and_on_purpose_train_and_see_an_image(tmp_path, method):
    scene = wall_scene().scaled(1e-3)
    with pytest.raises(InputError, match=r"in view are at most 0\.0\d+ from the cameras, and nothing nearer than"):
        start(tmp_path / "run", method=method, scene=scene)
    assert not (tmp_path / "run").exists()
    trainer = start(tmp_path / "run", ["near_plane=0.0001", *CHANGES.get(method, [])], method, scene)
    assert trainer.method.config.near_plane == 0.0001
    trainer.start()
    row = trainer.take_step()
    output = trainer.render_step().output
    assert row["gaussians"] > 100 and output.alpha.mean() > 0.3


@pytest.mark.parametrize("method", ["scaffold-gs", "3dgs", "2dgs"])
def test_a_run_that_sees_nothing_stops_after_a_few_steps(tmp_path, method):
    trainer = start(tmp_path / "run", CHANGES["2dgs"] if method == "2dgs" else [], method)
    trainer.start()
    for _ in range(2):
        trainer.take_step()
    trainer.model.near_plane = 50.0  # beyond the wall
    with pytest.raises(NothingDrawnError, match=r"in the last 10 views, until step 12: .* near_plane 0.* may lie"):
        trainer.train()


def test_points_behind_all_cameras_are_refused(tmp_path):
    scene = wall_scene()
    behind = replace(scene.points, positions=scene.points.positions * torch.tensor([1.0, 1.0, -1.0]))
    assert torch.isnan(torch.tensor(replace(scene, points=behind).pixel_footprint))
    with pytest.raises(InputError, match=r"none of the .* initial points is in view of the training cameras"):
        start(tmp_path / "run", scene=replace(scene, points=behind))
    assert not (tmp_path / "run").exists()


class Shift(ViewModule):
    """Moves the camera along x and multiplies the colours."""

    untrained_views = "all views alike"

    def __init__(self, step, factor, wants=()):
        super().__init__(None, None)
        self.step, self.factor, self.asked = step, factor, []
        self.weight = nn.Parameter(torch.ones(()))
        self._wants = frozenset(wants)

    @property
    def wants(self):
        return self._wants

    def parameter_groups(self):
        return {"weight": [self.weight]}

    def adjust_camera(self, camera, view):
        self.asked.append((camera.center[0].item(), view))
        shift = torch.zeros(4, 4)
        shift[0, 3] = self.step
        return replace(camera, camera_to_world=camera.camera_to_world + shift)

    def shade(self, output, view):
        return replace(output, rgb=output.rgb * self.factor)


def make_model(**modules):
    field = FieldOf(random_gaussians(40, 0))
    return Model(field, TorchRenderer(TorchRendererSettings()), modules)


def test_modules_act_in_their_order_on_camera_and_output():
    first, second = Shift(1.0, 2.0), Shift(0.5, 3.0, wants=("normals",))
    model, camera, view = make_model(a=first, b=second), pinhole(24, 20, 30.0, 30.0), View("0003", 3.0, True)
    output = model.render(camera, ("depth_expected",), view)
    start = camera.center[0].item()
    assert first.asked == [(start, view)] and second.asked == [(start + 1.0, view)]
    assert output.camera.center[0].item() == pytest.approx(start + 1.5)
    moved = replace(camera, camera_to_world=output.camera.camera_to_world)
    plain = make_model().render(moved, ("depth_expected",))
    torch.testing.assert_close(output.rgb, 6.0 * plain.rgb)
    torch.testing.assert_close(output["depth_expected"], plain["depth_expected"])
    assert set(output.maps) == {"depth_expected", "normals"}
    groups = model.parameter_groups()
    assert groups["a.weight"][0] is first.weight and groups["b.weight"][0] is second.weight


def test_outputs_that_nobody_delivers_are_refused():
    with pytest.raises(InputError, match="needed by protocol 'x': albedo"):
        make_model().check_outputs(("rgb", "albedo"), "protocol 'x'")
    with pytest.raises(InputError, match="needed by module 'lamp': albedo"):
        make_model(lamp=Shift(0.0, 1.0, wants=("albedo",))).check_outputs(("rgb",), "the losses")
