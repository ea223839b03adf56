"""Parts of baking, against closed forms; runs to files of Gaussians and back."""

from __future__ import annotations

import json
import logging
import math
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

import coliags_plugin as cp
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.gaussians import Gaussians, rotation_matrices
from coliags_plugin.core.lamps import FlattenedLight, LightOfCamera
from coliags_plugin.core.ply import read_vertices, write_ply
from coliags_plugin.core.scenes import Frame
from coliags_plugin.engine.held_light import flattened_light, mean_camera, render_held
from coliags_plugin.engine.model import Model
from coliags_plugin.engine.rendering import render_view
from coliags_plugin.export.baking import distillation, exporting
from coliags_plugin.export.baking.baking import GaussianAverages, SeenColors, bake, blending_weights, fit_harmonics
from coliags_plugin.export.baking.distillation import beside
from coliags_plugin.export.baking.exporting import measure
from coliags_plugin.export.splats.cloud import cloud_of_field, field_of_cloud
from coliags_plugin.export.splats.formats import read_splats, write_splats
from coliags_plugin.fields.spherical_harmonics import basis, colors
from coliags_plugin.modules.exposure import CameraResponse, FrameGain
from coliags_plugin.renderers.torch_renderer import TorchRenderer, TorchRendererSettings
from tests.commands import refused, run
from tests.export.splats.clouds import random_cloud
from tests.scenes import camera_at


def random(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed))


def some_gaussians(count: int) -> Gaussians:
    """Random Gaussians within 10 mm of the origin."""
    index, drawn = torch.arange(count), torch.rand(count, 10, generator=torch.Generator().manual_seed(0))
    means, scales, opacities, colors = drawn.split((3, 3, 1, 3), dim=1)
    turns = random(count, 4)
    return Gaussians(
        20.0 * means - 10.0, turns, 0.1 + 0.9 * scales, 0.05 + 0.95 * opacities[:, 0], colors, index, index
    )


def test_harmonics_reproduce_colours_of_their_own_kind():
    true = 0.1 * random(5, 16, 3)
    views = []
    for seed in range(60):
        directions = torch.nn.functional.normalize(random(5, 3, seed=seed + 1), dim=1)
        rgb = (basis(directions, 3)[..., None] * true).sum(1) + 0.5
        views.append(SeenColors(torch.tensor([2, 3, 5, 8, 9]), torch.rand(5) + 0.5, directions, rgb))
    slots = torch.tensor([2, 5, 9])
    fitted = fit_harmonics(views, slots, torch.full((3, 3), 0.3), 3)
    directions = torch.nn.functional.normalize(random(3, 3, seed=99), dim=1)
    expected = colors(true[[0, 2, 4]], directions, 3)
    torch.testing.assert_close(colors(fitted, directions, 3), expected, atol=0.05, rtol=0)
    # The ridge costs little where views abound.
    assert (fitted - true[[0, 2, 4]]).norm() < 0.2 * true[[0, 2, 4]].norm()


def test_one_view_gives_its_colour_and_none_the_mean():
    direction = torch.tensor([[0.0, 0.6, 0.8]])
    view = SeenColors(torch.tensor([4]), torch.ones(1), direction, torch.tensor([[0.9, 0.2, 0.1]]))
    fitted = fit_harmonics([view], torch.tensor([4, 7]), torch.tensor([[0.9, 0.2, 0.1], [0.1, 0.7, 0.4]]), 3)
    torch.testing.assert_close(colors(fitted[:1], direction, 3), torch.tensor([[0.9, 0.2, 0.1]]), atol=1e-4, rtol=0)
    torch.testing.assert_close(colors(fitted[1:], direction, 3), torch.tensor([[0.1, 0.7, 0.4]]), atol=1e-6, rtol=0)
    torch.testing.assert_close(fitted[1, 1:], torch.zeros(15, 3))


def test_blending_weights_add_up_to_alpha():
    gaussians, camera = some_gaussians(12), camera_at(0.0, 0.0, -15.0)
    renderer = TorchRenderer(TorchRendererSettings())
    weights = blending_weights(renderer, gaussians, camera)
    alpha = renderer.draw(gaussians, camera, ("rgb", "alpha")).alpha
    assert float(weights.sum()) == pytest.approx(float(alpha.sum()), rel=1e-5)
    assert float(weights.min()) >= 0.0


def test_averages_of_the_same_gaussians_are_these():
    gaussians = some_gaussians(12)
    averages, camera = GaussianAverages(12, 1, 3, torch.device("cpu")), camera_at(0, 0, 0)
    for flip in (1.0, -1.0, 2.5):  # a quaternion and its negative are the same rotation
        averages.add(replace(gaussians, quats_wxyz=flip * gaussians.quats_wxyz), torch.rand(12) + 0.1, camera)
    field = field_of_cloud(averages.cloud(averages.visible(), torch.zeros(12, 16, 3)))
    assert int(field.degree) == 3
    torch.testing.assert_close(field.means, gaussians.means)
    torch.testing.assert_close(field.scales.exp(), gaussians.scales)
    torch.testing.assert_close(field.opacities.sigmoid(), gaussians.opacities)
    torch.testing.assert_close(averages.mean_colors(averages.visible()), gaussians.colors)
    expected = rotation_matrices(gaussians.quats_wxyz)
    torch.testing.assert_close(rotation_matrices(field.quats), expected, atol=1e-5, rtol=0)


def test_a_child_that_is_absent_from_a_view_counts_as_transparent():
    gaussians = some_gaussians(2)
    both = replace(gaussians, opacities=torch.tensor([0.8, 0.6]))
    first = Gaussians(*(value[:1] for value in (both.means, both.quats_wxyz, both.scales, both.opacities, both.colors)),
                      source_index=torch.tensor([0]), visible_sources=torch.tensor([0]))  # fmt: skip
    averages = GaussianAverages(1, 2, 3, torch.device("cpu"))
    averages.add(both, torch.tensor([3.0, 1.0]), camera_at(0, 0, 0))
    averages.add(first, torch.tensor([4.0]), camera_at(0, 0, 0))
    field = field_of_cloud(averages.cloud(averages.visible(), torch.zeros(2, 1, 3)))
    # Both views show 4 pixels of the anchor; the second child is in the first view only.
    torch.testing.assert_close(field.opacities.sigmoid(), torch.tensor([0.8, 0.3]))
    torch.testing.assert_close(field.means, both.means)


def test_the_heaviest_gaussians_are_kept():
    averages = GaussianAverages(6, 1, 3, torch.device("cpu"))
    averages.add(some_gaussians(6), torch.zeros(6), camera_at(0, 0, 0))
    with pytest.raises(InputError, match="visible"):
        averages.visible()
    averages.add(some_gaussians(6), torch.tensor([3.0, 10.0, 0.0, 1.0, 5.0, 1.0]), camera_at(0, 0, 0))
    assert averages.heaviest(3).tolist() == [0, 1, 4]
    assert averages.heaviest(9).tolist() == [0, 1, 3, 4, 5]  # one fills no pixel
    assert averages.heaviest(9, 0.75).tolist() == [1, 4]  # 15 of 20 pixels
    assert averages.heaviest(1, 0.75).tolist() == [1]


def test_the_mean_camera_is_between_the_cameras():
    mean = mean_camera([camera_at(0.0, 1.0, 2.0, yaw=0.3), camera_at(4.0, 1.0, 0.0, yaw=-0.1)])
    torch.testing.assert_close(mean.center, torch.tensor([2.0, 1.0, 1.0], dtype=torch.float64))
    expected = camera_at(0, 0, 0, yaw=0.1).camera_to_world[:3, :3]
    torch.testing.assert_close(mean.camera_to_world[:3, :3], expected)
    third = mean_camera([camera_at(0.0, 0.0, 0.0), camera_at(4.0, 0.0, 8.0)], (0.75, 0.25))
    torch.testing.assert_close(third.center, torch.tensor([1.0, 0.0, 2.0], dtype=torch.float64))


def test_cameras_beside_a_path_are_near_it():
    generator = torch.Generator().manual_seed(0)
    path = [camera_at(float(x), 0.0, 0.0) for x in range(9)]
    places = torch.stack([camera.center for _ in range(40) for camera in beside(path, generator)])
    assert 0.25 < float(places[:, 1:].std()) < 0.35  # the steps are 1 mm
    between = places[:, 0] - torch.arange(8).repeat(40)  # one in each step
    assert float(between.mean()) == pytest.approx(0.5, abs=0.1)
    assert float(between.min()) > -1.5 and float(between.max()) < 2.5
    (alone,) = beside(path[:1], generator)
    torch.testing.assert_close(alone.center, path[0].center)
    assert alone.camera_to_world.dtype == path[0].camera_to_world.dtype


def test_held_lights():
    points = torch.tensor([[3.0, 0.0, 4.0], [0.0, 0.0, -2.0]])
    normals = torch.tensor([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    lamp = LightOfCamera(camera_at(0.0, 0.0, 0.0))
    distances, cosines = lamp.incidence(points)
    torch.testing.assert_close(distances, torch.tensor([5.0, 2.0]))
    torch.testing.assert_close(cosines, torch.tensor([0.8, 0.0]))  # nothing shines backwards
    torch.testing.assert_close(lamp.towards(points, normals)[0], torch.tensor([-0.6, 0.0, -0.8]))
    flat = FlattenedLight(30.0, math.cos(0.5))
    distances, cosines = flat.incidence(points)
    assert distances.tolist() == [30.0, 30.0]
    torch.testing.assert_close(cosines, torch.full((2,), math.cos(0.5)))
    assert torch.equal(flat.towards(points, normals), normals)


@pytest.fixture
def few_steps(monkeypatch):
    monkeypatch.setattr(distillation, "STEPS", 3)
    monkeypatch.setattr(distillation, "_MUCH", 0.0)


def test_an_imported_export_renders_what_the_run_renders(run_of, wall, tmp_path):
    trained = run_of("3dgs")
    (exported,) = trained.export(tmp_path / "wall.ply")
    again = cp.import_splats(exported.file, wall, tmp_path / "imported")
    assert again.method == "3dgs" and again.step == 0
    name = trained.frame_names()[0]
    ours, theirs = trained.render(name), again.render(name)
    assert np.abs(ours.rgb.astype(int) - theirs.rgb).max() <= 1
    np.testing.assert_allclose(theirs.depth, ours.depth, atol=1e-3)
    record = json.loads((tmp_path / "wall.ply.json").read_text())
    assert record["baking"] is None and record["unit"] == "mm" and record["run"]["method"] == "3dgs"
    assert record["gaussians"] == len(read_splats(exported.file))
    measured, psnr = record["measured"]["test"], trained.evaluate().mean("psnr")
    assert measured["run"]["psnr"] == pytest.approx(psnr, abs=1e-6)
    for part in ("recorded", "in_light"):
        assert measured[part] == pytest.approx(measured["run"], rel=1e-3)
    assert again.evaluate().mean("psnr") == pytest.approx(psnr, abs=1e-3)
    assert again.load().provenance["imported"]["gaussians"] == record["gaussians"]


def test_anchors_are_baked(anchors, wall, tmp_path, few_steps, capsys):
    trained = anchors
    file = tmp_path / "wall.spz"
    assert run("export", trained.path, "--format", "spz", "--output", file, "--light", "flattened") == 0
    printed = capsys.readouterr().out
    record = json.loads((tmp_path / "wall.spz.json").read_text())
    assert str(file) in printed
    measured, lines = record["measured"]["test"], printed.splitlines()
    said = (
        f"{measured['recorded']['psnr']:.2f} dB on 2 held-out frames (test), the run {measured['run']['psnr']:.2f} dB"
    )
    assert lines[1] == f"in a viewer, against the recorded frames: {said}"
    assert lines[2].startswith("in the baked light, flattened (the same everywhere): ")
    assert f"{measured['in_light']['psnr']:.2f} dB on 2 held-out" in lines[2]
    assert record["baking"]["light"]["name"] == "flattened" and record["baking"]["steps"] == 3
    assert 0.9 < record["baking"]["light"]["cosine"] <= 1.0
    assert measured["psnr_between"] > 20
    assert record["sh_degree"] == 3 and record["gaussians"] == len(read_splats(file))
    assert run("import", file, "--data", wall, "--output", tmp_path / "imported") == 0
    imported = cp.load_run(tmp_path / "imported")
    assert imported.render(imported.frame_names()[0]).rgb.std() > 5
    evaluated = imported.evaluate()
    assert {name: evaluated.mean(name) for name in measured["recorded"]} == pytest.approx(
        measured["recorded"], rel=1e-3
    )


@pytest.mark.parametrize(
    ("recorded", "light", "warned"),
    [
        (31.7, "mean", None),
        (
            23.7,
            "mean",
            r"8\.9 dB\), as the lamp .* is baked; `coliags view RUN` .*light=recorded",
        ),
        (31.5, "recorded", r"1\.1 dB\), as frames have no gains; `coliags view RUN` shows the run itself$"),
    ],
)
def test_another_brightness_than_the_videos_is_warned_of(caplog, recorded, light, warned):
    measured = {"test": {"in_light": {"psnr": 32.6}, "recorded": {"psnr": recorded}}, "none": {"in_light": {}}}
    measured["none"]["recorded"] = {}
    exported = exporting.Exported(Path("a.ply"), Path("a.ply.json"), {"measured": measured})
    exporting._warn_of_light(exported, light)
    assert [bool(re.search(warned or "", message)) for message in caplog.messages] == [True] * (warned is not None)


def test_several_formats_are_of_one_baking(anchors, tmp_path, few_steps):
    exported = anchors.export(tmp_path / "wall.any", formats=["ply", "spz"], measure=False)
    assert [part.file.name for part in exported] == ["wall.ply", "wall.spz"]
    first, second = (read_splats(part.file) for part in exported)
    assert len(first) == len(second) and "dB" not in exported[0].text
    np.testing.assert_allclose(first.means, second.means, atol=2e-4)


def test_distillation_comes_nearer_to_the_frames(anchors, monkeypatch):
    """The run was hardly trained, and is no better than its averages; frames in its own light are the frames."""
    trained = anchors.load()
    frame = trained.scene.train[0]
    light = LightOfCamera(frame.camera)
    baked = field_of_cloud(bake(trained, light)[0])
    camera = frame.camera.to(dtype=torch.float32)

    def error() -> float:
        with torch.no_grad():
            shown = trained.model.renderer.draw(baked.gaussians(camera), camera, ("rgb", "alpha")).rgb
        return float((shown - frame.rgb).square().mean())

    assert not distillation.needs_distillation(baked, trained, light)
    before = error()
    assert distillation.distil(baked, trained, light, seconds=0.0) == 0
    monkeypatch.setattr(distillation, "STEPS", 40)
    assert distillation.distil(baked, trained, light, seconds=600.0) == 40
    assert error() < 0.9 * before
    with torch.no_grad():
        baked.sh0 += 1.0
    assert distillation.needs_distillation(baked, trained, light)


def test_a_fit_of_so_many_steps_is_the_same_again(anchors):
    trained = anchors.load()
    first, second = (field_of_cloud(bake(trained, None)[0]) for _ in range(2))
    assert [distillation.distil(field, trained, None, math.inf, 5) for field in (first, second)] == [5, 5]
    for name, values in first.state_dict().items():
        assert torch.equal(values, second.state_dict()[name])


@pytest.mark.thorough
def test_distilled_colours_fall_with_the_distance_to_the_lamp(run_of, monkeypatch):
    """Renderings of the run are the frames: colours that are the same from everywhere cannot follow them."""
    trained = run_of("pr-endo").load()
    frames = trained.scene.train
    for index, frame in enumerate(frames):
        rgb = render_view(trained, frame, ("rgb", "alpha")).rgb
        image = (255.0 * rgb.detach()).round().to(torch.uint8)
        frames[index] = Frame.of(name=frame.name, index=frame.index, camera=frame.camera, image=image)
    monkeypatch.setattr(distillation, "STEPS", 60)
    between, clouds = [], []
    for attenuated in (False, True):
        field = field_of_cloud(bake(trained, None, degree=0, attenuated=attenuated)[0])
        distillation.distil(field, trained, None, seconds=600.0)
        clouds.append(cloud_of_field(field))
        between.append(measure(trained, clouds[-1], None)["test"]["psnr_between"])
    assert between[1] > between[0] + 3.0
    assert clouds[0].attenuation is None and np.median(clouds[1].attenuation[:, 1]) > 0.0


def test_a_view_starts_where_it_is_shown_best_of_the_far_half(run_of, monkeypatch):
    """Neither at a wall before the lens, shown best of all, nor where the run shows as little as the Gaussians."""
    trained = run_of("3dgs").load()
    cloud = cloud_of_field(trained.model.field)
    shown = distillation._compared(field_of_cloud(cloud), trained, None, trained.scene.train)
    assert shown[:, 2].diff().lt(0.0).all(), "cameras come nearer to the wall"
    rows = {"bad in both": [0.5, 0.5, 40.0], "best": [0.01, 0.002, 30.0], "far": [0.01, 0.01, 50.0]}
    rows |= {"contact": [1e-4, 1e-4, 4.0], "near": [1e-3, 1e-3, 9.0]}
    monkeypatch.setattr(distillation, "_compared", lambda *_: torch.tensor([*rows.values()]))
    assert distillation.best_frame(field_of_cloud(cloud), trained, None) == [*rows].index("best")


def test_surfels_are_exported_thin_and_come_back_as_surfels(run_of, wall, tmp_path):
    trained = run_of("2dgs")
    record = trained.export(tmp_path / "wall.ply", seconds=0.0)[0].record
    assert record["measured"]["test"]["psnr_between"] > 25
    thinnest = read_splats(tmp_path / "wall.ply").scales.min(axis=1)
    assert thinnest.min() > 0
    # A file of 2DGS has two scales: its import is a run of surfels.
    field = trained.load().model.field
    scales = field.scales.detach().numpy()
    columns = read_vertices(tmp_path / "wall.ply")
    del columns["scale_2"]
    write_ply(tmp_path / "discs.ply", columns)
    again = cp.import_splats(tmp_path / "discs.ply", wall, tmp_path / "discs")
    assert again.method == "2dgs"
    np.testing.assert_allclose(again.load().model.field.scales.detach().numpy(), scales, atol=1e-5)


def test_surfels_alone_of_explicit_gaussians_are_fitted(run_of, few_steps):
    assert bake(run_of("2dgs").load(), None)[1]["steps"] == 3
    assert bake(run_of("3dgs").load(), None)[1] == {}


@pytest.mark.parametrize(
    "method",
    [
        *("coliags", "pr-endo", "3dgs"),
        *(pytest.param(name, marks=pytest.mark.thorough) for name in ("coliags-plus", "scaffold-gs-distance")),
        pytest.param("scaffold-gs", marks=pytest.mark.thorough),
    ],
)
def test_fields_that_know_a_lamp_look_different_under_another(run_of, method):
    trained = run_of(method).load()
    field, camera = trained.model.field, trained.scene.train[2].camera
    assert field.knows_lamp == (method not in ("scaffold-gs", "3dgs"))
    with torch.no_grad():
        near, far = (field.gaussians(camera, FlattenedLight(length, 1.0)).colors for length in (10.0, 60.0))
    assert torch.equal(near, far) != field.knows_lamp


@pytest.mark.parametrize("method", ["coliags", "pr-endo"])
def test_the_lamp_of_the_camera_itself_changes_nothing(run_of, method):
    trained = run_of(method).load()
    camera = trained.scene.train[2].camera
    camera = replace(camera, camera_to_world=camera.camera_to_world.float())
    with torch.no_grad():
        moving = trained.model.field.gaussians(camera)
        fixed = trained.model.field.gaussians(camera, LightOfCamera(camera))
    assert torch.equal(moving.means, fixed.means) and torch.equal(moving.opacities, fixed.opacities)
    torch.testing.assert_close(fixed.colors, moving.colors, atol=1e-5, rtol=1e-4)


def test_a_held_view_has_the_response_of_a_camera_and_no_gain_of_a_frame(run_of):
    trained = run_of("3dgs").load()
    model, scene = trained.model, trained.scene
    gain, response = FrameGain(FrameGain.Settings(), scene), CameraResponse(CameraResponse.Settings(knee=0.1), scene)
    with torch.no_grad():
        gain.log_gain.copy_(random(*gain.log_gain.shape))
        response.log_slope.fill_(-0.5)
        both = Model(model.field, model.renderer, {"gain": gain, "response": response}, model.near_plane)
        camera = replace(scene.train[1].camera, camera_to_world=scene.train[1].camera.camera_to_world.float())
        bare, shaded = (render_held(each, camera, None, ("rgb",)).rgb for each in (model, both))
    torch.testing.assert_close(shaded, response.curve(bare))
    assert (bare - shaded).max() > 0.05


def test_flattened_light_is_even_over_a_wall(run_of):
    """Gaussians of one albedo and one normal look the same everywhere, however far they are."""
    field = run_of("pr-endo").load().model.field
    light = FlattenedLight(20.0, 1.0)
    cameras = [frame.camera for frame in run_of("pr-endo").load().scene.train]
    with torch.no_grad():
        near, far = (
            field.gaussians(replace(camera, camera_to_world=camera.camera_to_world.float()), light)
            for camera in (cameras[0], cameras[-1])
        )
    common = set(near.source_index.tolist()) & set(far.source_index.tolist())
    rows = [torch.tensor([g.source_index.tolist().index(slot) for slot in sorted(common)]) for g in (near, far)]
    difference = (near.colors[rows[0]] - far.colors[rows[1]]).abs()
    assert float(difference.max()) < 0.05  # the mirrored part alone depends on the view


def test_flattened_light_is_the_median_of_what_cameras_see(run_of):
    trained = run_of("3dgs").load()
    light = flattened_light(trained.model, [frame.camera for frame in trained.scene.train])
    assert 15.0 < light.distance < 22.0 and 0.8 < light.cosine < 1.0


def test_exports_that_cannot_be(run_of, anchors, tmp_path, capsys, few_steps):
    trained = run_of("3dgs")
    (tmp_path / "there.ply").write_text("mine")
    assert "already exists" in refused(capsys, "export", trained.path, "--output", tmp_path / "there.ply")
    assert (tmp_path / "there.ply").read_text() == "mine"
    with pytest.raises(InputError, match="no format 'sog'"):
        trained.export(tmp_path / "a.sog", formats="sog")
    with pytest.raises(InputError, match="no light 'men'"):
        anchors.export(tmp_path / "a.ply", light="men")
    with pytest.raises(InputError, match="relit"):
        run_of("pr-endo").relight(power=2.0).export(tmp_path / "a.ply")
    radiance = run_of("reim-nerf-small", "field.width=8")
    assert "has no Gaussians" in refused(capsys, "export", radiance.path, "--output", tmp_path / "a.ply")
    assert "not a run folder" in refused(capsys, "export", tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["there.ply"]


def test_imports_that_cannot_be(wall, tmp_path, capsys):
    good, output = tmp_path / "good.ply", tmp_path / "run"
    write_splats(good, random_cloud(5), "ply")
    assert "no reader" in refused(capsys, "import", tmp_path / "a.glb", "--data", wall, "--output", output)
    assert "cannot read" in refused(capsys, "import", tmp_path / "a.ply", "--data", wall, "--output", output)
    refused(capsys, "import", good, "--data", tmp_path / "nowhere", "--output", output)
    assert not output.exists()
    output.mkdir()
    (output / "mine.txt").write_text("mine")
    assert "already exists" in refused(capsys, "import", good, "--data", wall, "--output", output)
    assert "not a run folder" in refused(capsys, "import", good, "--data", wall, "--output", output, "--overwrite")
    assert (output / "mine.txt").read_text() == "mine"


@pytest.mark.parametrize(
    "change",
    [
        lambda cloud: {"means": cloud.means - np.float32(5000)},
        lambda cloud: {"means": cloud.means / 1000, "scales": cloud.scales / 1000},
        lambda cloud: {"opacities": np.full_like(cloud.opacities, 1e-6)},
    ],
)
def test_a_file_of_another_world_is_imported_with_a_warning(wall, tmp_path, caplog, change):
    cloud = random_cloud(200)
    write_splats(tmp_path / "far.ply", replace(cloud, **change(cloud)), "ply")
    with caplog.at_level(logging.WARNING):
        cp.import_splats(tmp_path / "far.ply", wall, tmp_path / "run")
    assert re.search("2 of 2 views of it show nothing.*world frame and unit", caplog.text)
