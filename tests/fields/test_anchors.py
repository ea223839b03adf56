"""The anchor field: initialisation, decoding, the frustum, and its two kinds of heads."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.scenes import PointCloud
from coliags_plugin.fields.points import neighbour_log_scales, spheres_in_frustum, voxelize
from tests.fields.made import make_field
from tests.scenes import camera_at, wall_scene

COLIAGS = {"name": "anchors", "geometry_head": "imve", "appearance_head": "imia"}
SCAFFOLD = {"name": "anchors", "geometry_head": "plain", "appearance_head": "plain"}


def make(node, seed=0, **options):
    """Field with random offsets and features."""
    field = make_field(**{**node, **options}, seed=seed)
    generator = torch.Generator().manual_seed(1)
    with torch.no_grad():
        field.offsets.uniform_(-1, 1, generator=generator)
        field.features.uniform_(-1, 1, generator=generator)
    return field


@pytest.mark.parametrize(
    ("options", "sizes"),
    [
        (COLIAGS, [(32, 95), (10, 32), (32, 95), (70, 32), (32, 47), (30, 32)]),
        (SCAFFOLD, [(32, 35), (10, 32), (32, 35), (70, 32), (32, 35), (30, 32)]),
        (
            {**SCAFFOLD, "appearance_head": {"name": "plain", "distance": True}},
            [(32, 35), (10, 32), (32, 35), (70, 32), (32, 36), (30, 32)],
        ),
    ],
)
def test_perceptron_sizes_are_the_papers(options, sizes):
    groups = make(options).parameter_groups()
    parameters = [p for name in ("opacity_mlp", "covariance_mlp", "color_mlp") for p in groups[name]]
    assert [tuple(p.shape) for p in parameters if p.ndim == 2] == sizes


def test_spacing_is_the_anchors_own_and_travels_with_the_state():
    """A wall of points merged into voxels of 2: three of the nearest neighbours stand one voxel away."""
    field = make(COLIAGS, voxel_size=2.0)
    assert field.spacing == pytest.approx(2.0, rel=1e-5)
    assert type(field).from_state(field.state_dict(), field.settings).spacing == field.spacing


def test_imve_without_frequencies_decodes_as_the_plain_head():
    first = make(SCAFFOLD, geometry_head={"name": "imve", "frequencies": 0})
    second = make(SCAFFOLD)
    camera = camera_at(0.0, 0.0, 0.0)
    assert torch.equal(first.gaussians(camera).scales, second.gaussians(camera).scales)


def test_decoding_step_by_step():
    """An independent walk through docs/methods.md 3.5, anchor by anchor."""
    field = make(COLIAGS)
    camera = camera_at(1.0, 0.5, 2.0, yaw=0.1)
    drawn = field.gaussians(camera)
    center, axis = camera.center.float(), camera.optical_axis.float()
    expected, sources = [], []
    with torch.no_grad():
        for anchor in drawn.visible_sources.tolist():
            sight = field.anchors[anchor] - center
            distance = sight.norm()
            v = sight / distance
            cosine = (v @ axis).clamp(0, 1)
            gamma = lambda x, n: torch.cat([x] + [f(2**k * x) for k in range(n) for f in (torch.sin, torch.cos)])  # noqa: E731
            geometry = torch.cat([field.features[anchor], gamma(v, 10)])
            opacity = torch.tanh(field.geometry_head.opacity_mlp(geometry))
            shape = field.geometry_head.covariance_mlp(geometry).view(10, 7)
            recorded = torch.cat([field.features[anchor], v, distance[None], gamma(cosine[None], 5)])
            color = torch.sigmoid(field.appearance_head.color_mlp(recorded)).view(10, 3)
            scale = field.scalings[anchor].exp()
            for child in range(10):
                if opacity[child] > 0:
                    sources.append(10 * anchor + child)
                    mean = field.anchors[anchor] + field.offsets[anchor, child] * scale[:3]
                    size = scale[3:] * torch.sigmoid(shape[child, :3])
                    quat = shape[child, 3:] / shape[child, 3:].norm()
                    expected.append(torch.cat([mean, size, quat, opacity[child][None], color[child]]))
    found = torch.cat(
        [drawn.means, drawn.scales, drawn.quats_wxyz, drawn.opacities[:, None], drawn.colors], dim=1
    ).detach()
    torch.testing.assert_close(found, torch.stack(expected), rtol=1e-4, atol=1e-5)
    assert drawn.source_index.tolist() == sources
    torch.testing.assert_close(drawn.means, field.child_positions().reshape(-1, 3)[drawn.source_index])


@pytest.mark.parametrize("head", ["plain", "imve"])
def test_all_children_can_start_with_one_opacity(head):
    field = make_field("anchors", geometry_head={"name": head, "initial_opacity": 0.2}, appearance_head="plain")
    gaussians = field.gaussians(camera_at(0.0, 0.0, 0.0))
    assert len(gaussians) == len(gaussians.visible_sources) * 10 > 0
    torch.testing.assert_close(gaussians.opacities, torch.full_like(gaussians.opacities, 0.2))


@settings(max_examples=20, deadline=None)
@given(size=st.floats(0.3, 5.0), seed=st.integers(0, 1000))
def test_initial_anchors_lie_on_the_grid_once_and_do_not_depend_on_order(size, seed):
    generator = torch.Generator().manual_seed(seed)
    points = torch.rand(200, 3, generator=generator) * 4 - 2
    anchors = voxelize(points, size)
    assert 1 <= len(anchors) <= (4 / size + 2) ** 3
    assert torch.equal(anchors, voxelize(points[torch.randperm(200, generator=generator)], size))
    cells = anchors / size
    torch.testing.assert_close(cells, cells.round(), rtol=0, atol=1e-5)
    assert len(torch.unique(cells.round(), dim=0)) == len(anchors)
    assert torch.cdist(points, anchors).amin(dim=1).max() <= size * math.sqrt(3) / 2 + 1e-5


def test_initial_scales_are_root_mean_square_neighbour_distances():
    points = torch.rand(40, 3, generator=torch.Generator().manual_seed(0))
    distances = np.sort(np.linalg.norm(points[:, None].numpy() - points[None].numpy(), axis=2), axis=1)[:, 1:4]
    expected = np.log(np.sqrt((distances**2).mean(axis=1)))
    np.testing.assert_allclose(neighbour_log_scales(points).numpy(), expected, rtol=1e-5)
    assert all(neighbour_log_scales(points[:count]).isfinite().all() for count in (1, 2, 3))


def test_default_voxel_is_two_pixels_on_the_surface():
    scene = wall_scene()
    field = make_field(**COLIAGS, scene=scene)
    assert float(field.voxel_size) == pytest.approx(2 * scene.pixel_footprint)
    camera = scene.train[0].camera
    size = 20.0 / math.sqrt(camera.fx * camera.fy)
    assert scene.pixel_footprint == pytest.approx(size, rel=0.15)  # the camera comes up to 4 mm nearer
    assert len(field.anchors) < len(scene.points) / 2


def test_useless_voxels_are_warned_of_and_no_points_are_an_input_error(caplog):
    with caplog.at_level("WARNING"):
        make_field(**COLIAGS, voxel_size=0.001)
    assert "merge almost nothing" in caplog.text
    scene = replace(wall_scene(), points=PointCloud(torch.zeros(0, 3)))
    with pytest.raises(InputError, match="no initial points"):
        make_field(**COLIAGS, scene=scene, voxel_size=1.0)


@settings(max_examples=30, deadline=None)
@given(
    x=st.floats(-30, 30), y=st.floats(-30, 30), z=st.floats(-30, 30), radius=st.floats(0.01, 5), yaw=st.floats(-3, 3)
)
def test_spheres_that_touch_the_pyramid_are_kept(x, y, z, radius, yaw):
    camera = camera_at(0.0, 0.0, 0.0, yaw=yaw)
    center = torch.tensor([[x, y, z]], dtype=torch.float64)
    generator = torch.Generator().manual_seed(0)
    directions = torch.nn.functional.normalize(torch.randn(200, 3, generator=generator, dtype=torch.float64), dim=1)
    pixels, depth = camera.project(center + radius * directions)
    touches = ((depth > 0.2) & ((pixels >= 0) & (pixels <= torch.tensor([32.0, 24.0]))).all(dim=1)).any()
    assert not touches or bool(spheres_in_frustum(center, torch.tensor([radius]), camera))


def test_anchors_behind_the_camera_have_cosine_zero():
    field = make(COLIAGS)
    recorded = {}
    head = field.appearance_head
    inputs = head.inputs
    head.inputs = lambda anchors: recorded.setdefault("cosines", anchors.cosines) is None or inputs(anchors)
    with torch.no_grad():
        field.anchors[:, 2] = 0.05  # abeam, some of them behind, but large enough to reach the image
        field.scalings.fill_(3.0)
    field.gaussians(replace(camera_at(0.0, 0.0, 0.1), near_plane=0.0))
    assert recorded["cosines"].min() == 0.0
    assert recorded["cosines"].max() <= 1.0


@pytest.mark.parametrize(
    ("head", "column"),
    [({"name": "imia"}, 32 + 3), ({"name": "imia-glints"}, 32 + 11), ({"name": "plain", "distance": True}, 32 + 3)],
)
def test_hidden_units_start_over_the_distances_that_occur(head, column):
    """Each unit's pre-activation at its own quantile of the distances is what the default start has at distance 0."""
    default = make(COLIAGS, appearance_head={**head, "bias_init": "pytorch"})
    spread = make(COLIAGS, appearance_head=head)
    cameras = [frame.camera for frame in wall_scene().train]
    with torch.no_grad():
        initial = make_field(**{**COLIAGS, "appearance_head": head})
        recorded = [initial.anchors[initial.visible_anchors(camera)] - camera.center for camera in cameras]
    distances = np.sort(np.concatenate([sight.norm(dim=1).numpy() for sight in recorded]))
    kinks = distances[((np.arange(32) + 0.5) / 32 * len(distances)).astype(int)]
    before, after = default.appearance_head.color_mlp[0], spread.appearance_head.color_mlp[0]
    assert torch.equal(before.weight, after.weight)
    on_kink = after.bias + after.weight[:, column] * torch.from_numpy(kinks).float()
    torch.testing.assert_close(on_kink, before.bias, atol=1e-5, rtol=0.0)


def test_a_head_that_does_not_see_the_distance_expects_nothing():
    starts = ("scene_distances", "pytorch")
    plain, other = (make(SCAFFOLD, appearance_head={"name": "plain", "bias_init": start}) for start in starts)
    assert torch.equal(plain.appearance_head.color_mlp[0].bias, other.appearance_head.color_mlp[0].bias)
