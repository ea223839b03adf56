"""The anchor field: initialisation, decoding, frustum, heads, glints of facets, the law of attenuation, and shadows."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from coliags_plugin.contracts import SeenAnchors
from coliags_plugin.core.components import make_component
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.lamps import FlattenedLight, LightOfCamera
from coliags_plugin.core.photometry import fit_light
from coliags_plugin.core.scenes import TO_GET_DEPTH, PointCloud
from coliags_plugin.core.shadows import lit_shares
from coliags_plugin.fields.attenuation import MAX_OFFSET, AttenuatedAppearanceHead
from coliags_plugin.fields.heads import MAX_TILT, WIDTHS, GlintAppearanceHead, tangent_components
from coliags_plugin.fields.mlp import embedded_inputs
from coliags_plugin.fields.points import neighbour_log_scales, spheres_in_frustum, voxelize
from tests.fields.made import make_field
from tests.scenes import camera_at, plate_scene, wall_scene

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
    with pytest.raises(InputError, match=f"no initial points.*{TO_GET_DEPTH}"):
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


# Glints of facets


def make_head(name: str = "imia-glints") -> Any:
    head = make_component("appearance_heads", name)
    return head.target(head.settings, 4, 2, torch.Generator().manual_seed(0))


def unit(*vectors: tuple[float, float, float]) -> torch.Tensor:
    return torch.nn.functional.normalize(torch.tensor(vectors), dim=1)


def seen(directions: torch.Tensor, normals: torch.Tensor) -> SeenAnchors:
    """Anchors of one feature, 7 mm in front of the lens."""
    count = len(directions)
    return SeenAnchors(torch.ones(count, 4), directions, torch.full((count, 1), 7.0), torch.ones(count, 1), normals)


def embedded(head: GlintAppearanceHead, directions: torch.Tensor, normals: torch.Tensor) -> torch.Tensor:
    return embedded_inputs(head.networks(seen(directions, normals)))


@settings(deadline=None)
@given(st.lists(st.floats(-1.0, 1.0), min_size=6, max_size=6))
def test_the_components_along_a_wall_have_the_sine_of_the_angle_as_their_length(numbers):
    pair = torch.tensor(numbers, dtype=torch.float64).view(2, 1, 3)
    normal, direction = (torch.nn.functional.normalize(vector, dim=1) for vector in pair)
    along = tangent_components(direction, normal)
    expected = torch.linalg.cross(direction, normal).norm(dim=1)
    if normal.norm() > 0.5:
        torch.testing.assert_close(along.norm(dim=1), expected, atol=1e-12, rtol=0.0)


def test_axes_of_normals_along_z_of_either_sign():
    directions, normals = unit((0.6, 0.0, 0.8), (0.6, 0.0, 0.8)), unit((0, 0, 1.0), (0, 0, -1.0))
    torch.testing.assert_close(tangent_components(directions, normals), torch.tensor([[0.6, 0.0], [0.6, 0.0]]))


def test_a_facet_without_tilt_glints_where_it_is_seen_along_the_normal():
    """Lobes are 1 there, on either side of the wall, and 1/e at the sine of their widths."""
    head, normal = make_head(), unit((0.0, 0.0, 1.0))
    lobes = slice(5, 5 + len(WIDTHS))
    torch.testing.assert_close(embedded(head, unit((0.0, 0.0, -3.0)), normal)[:, lobes], torch.ones(1, len(WIDTHS)))
    for index, width in enumerate(WIDTHS):
        aside = torch.tensor([[width, 0.0, math.sqrt(1.0 - width**2)]])
        torch.testing.assert_close(embedded(head, aside, normal)[0, 5 + index].item(), math.exp(-1.0))
    assert embedded(head, unit((0.0, 0.0, 1.0)), normal).shape == (1, head.color_mlp[0].in_features - 4)
    assert embedded(head, unit((0.0, 0.0, 1.0)), normal)[0, 5 + len(WIDTHS)] == 7.0


def test_a_tilted_facet_glints_beside_the_normal():
    head, normal = make_head(), unit((0.0, 0.0, 1.0))
    with torch.no_grad():
        head.tilt_layer.bias.copy_(torch.atanh(torch.tensor([0.3, -0.1]) / MAX_TILT))
    facing = torch.tensor([[0.3, -0.1, math.sqrt(0.9)]])
    torch.testing.assert_close(embedded(head, facing, normal)[:, 5 : 5 + len(WIDTHS)], torch.ones(1, len(WIDTHS)))
    beside = embedded(head, normal, normal)[0, 5 : 5 + len(WIDTHS)]
    beside.sum().backward()
    assert beside[0].item() < 1e-4 and head.tilt_layer.bias.grad.all()  # it can be learned


@pytest.mark.parametrize(
    "appearance",
    [
        *("imia-glints", {"name": "attenuated", "head": "imia-glints"}),
        {"name": "attenuated", "head": "plain", "incidence_exponent": 0.3},
    ],
)
def test_a_field_keeps_the_normals_of_the_wall_for_heads_that_see_them(appearance):
    field = make_field("anchors", geometry_head="plain", appearance_head=appearance)
    torch.testing.assert_close(field.normals[:, 2].abs(), torch.ones(len(field.anchors)))
    assert torch.equal(type(field).from_state(field.state_dict(), field.settings).normals, field.normals)
    gaussians = field.gaussians(camera_at(0.5, 0.0, 1.0))
    assert gaussians.colors.isfinite().all()
    gaussians.colors.sum().backward()
    gradients = [value.grad for value in field.appearance_head.parameters() if value.grad is not None]
    assert all(gradient.isfinite().all() for gradient in gradients)
    without = make_field("anchors", geometry_head="plain", appearance_head="plain")
    assert without.normals is None and "normals" not in without.state_dict()


# The law of attenuation: closed forms, and that other heads are left as they are


make_anchors = partial(make_field, "anchors", geometry_head="plain")


def make_attenuated(**options) -> AttenuatedAppearanceHead:
    head = make_component("appearance_heads", {"name": "attenuated", "head": "plain", "channels": 1, **options})
    return head.target(head.settings, 4, 2, torch.Generator().manual_seed(0))


def turned_camera():
    return camera_at(1.0, 2.0, 3.0, yaw=0.4).to("cpu", torch.float32)


def test_the_factor_is_the_law_about_the_median_distance():
    exponents = [[-0.8, 1.5], [-0.5, 0.0], [-1.0, 2.0]]  # of each channel
    head = make_attenuated(channels=3)
    head.prepare(wall_scene(), torch.tensor([10.0, 20.0, 70.0]))
    with torch.no_grad():
        head.exponents.copy_(torch.tensor(exponents))
    distances, cosines = torch.tensor([20.0, 40.0, 10.0]), torch.tensor([1.0, 0.9, 0.5])
    expected = [
        [share**far * cosine**aside for far, aside in exponents] for share, cosine in ((1, 1), (2, 0.9), (0.5, 0.5))
    ]
    torch.testing.assert_close(head.law(distances, cosines), torch.tensor(expected))


def test_distance_and_angle_are_those_at_the_lamp():
    """A lamp 3 mm behind the lens and 4 mm above it, in a camera that is turned and moved."""
    head, camera = make_attenuated(cosine_exponent=1.0), turned_camera()
    with torch.no_grad():
        head.lamp_offset.copy_(MAX_OFFSET * torch.atanh(torch.tensor([0.0, -4.0, -3.0]) / MAX_OFFSET))
    torch.testing.assert_close(head.offset, torch.tensor([0.0, -4.0, -3.0]))
    local = torch.tensor([[0.0, 0.0, 9.0], [3.0, -4.0, 9.0]])  # the second is 3 mm beside the lamp's axis
    points = camera.center + local @ camera.camera_to_world[:3, :3].T
    lit = head.apply_light(torch.full((2, 3), 0.5), points, None, camera, None)
    expected = [length**-0.9 * 12 / length for length in (math.hypot(4, 12), math.hypot(3, 12))]
    torch.testing.assert_close(lit[:, 0], 0.5 * torch.tensor(expected))


def test_a_held_light_takes_the_place_of_the_lamp():
    head = make_attenuated(cosine_exponent=2.0)
    lit = head.apply_light(torch.ones(3, 3), torch.rand(3, 3), None, camera_at(0, 0, 0), FlattenedLight(4.0, 0.5))
    torch.testing.assert_close(lit, torch.full((3, 3), 4.0**-0.9 * 0.25))


def test_incidence_counts_on_either_side_of_the_wall_and_not_under_a_flattened_light():
    head, camera = make_attenuated(distance_exponent=0.0, cosine_exponent=0.0, incidence_exponent=0.5), turned_camera()
    local = torch.tensor([[0.0, 0.0, 10.0], [3.0, 0.0, 4.0], [0.0, 0.0, 7.0]])
    normals = torch.tensor([[0.6, 0.0, 0.8], [-1.0, 0.0, 0.0], [1.0, 0.0, 0.0]])  # the last at a right angle
    axes = camera.camera_to_world[:3, :3]
    points, turned = camera.center + local @ axes.T, normals @ axes.T
    lit = head.apply_light(torch.ones(3, 3), points, turned, camera, None)
    torch.testing.assert_close(lit[:, 0], torch.tensor([0.8, 0.6, 0.1]).sqrt())
    torch.testing.assert_close(lit, head.apply_light(torch.ones(3, 3), points, -turned, camera, None))
    flattened = head.apply_light(torch.ones(3, 3), points, turned, camera, FlattenedLight(4.0, 0.5))
    torch.testing.assert_close(flattened, torch.ones(3, 3))
    beside = head.apply_light(torch.ones(3, 3), points, turned, camera_at(0, 0, 0), LightOfCamera(camera))
    torch.testing.assert_close(beside, lit)


def test_the_lamp_stays_within_its_bounds_and_nothing_overflows():
    head = make_attenuated()
    with torch.no_grad():
        head.lamp_offset.fill_(1e6)
    assert head.offset.abs().max() <= MAX_OFFSET
    points = torch.tensor([[MAX_OFFSET, MAX_OFFSET, MAX_OFFSET], [0.0, 0.0, 0.0], [0.0, 0.0, -5.0]])
    lit = head.apply_light(torch.ones(3, 3), points, None, camera_at(0, 0, 0).to("cpu", torch.float32), None)
    lit.sum().backward()
    assert lit.isfinite().all() and head.exponents.grad.isfinite().all() and head.lamp_offset.grad.isfinite().all()


@pytest.mark.parametrize("inner", ["plain", "imia"])
def test_exponents_of_zero_are_the_head_alone(inner):
    options = {"distance_exponent": 0.0, "cosine_exponent": 0.0}
    plain, lit = (
        make_anchors(appearance_head=inner),
        make_anchors(appearance_head={"name": "attenuated", "head": inner, **options}),
    )
    camera = camera_at(0.5, 0.0, 1.0)
    first, second = plain.gaussians(camera), lit.gaussians(camera)
    torch.testing.assert_close(first.colors, second.colors, rtol=2e-7, atol=0.0)  # the kernel's power of 0 is 1 + 7e-8
    assert torch.equal(first.means, second.means)
    assert plain.learned == {}
    assert lit.learned["distance_exponent"] == [0.0] * 3 and lit.learned["lamp_offset"] == [0.0, 0.0, 0.0]


def test_colors_do_not_move_gaussians():
    field = make_anchors(appearance_head={"name": "attenuated", "head": "plain"})
    field.gaussians(camera_at(0.0, 0.0, 0.0)).colors.sum().backward()
    assert not field.offsets.grad.any() and field.appearance_head.exponents.grad.abs().max() > 0


# Shadows of lamps beside the lens


LAMPS = torch.tensor([[-2.0, 0.3, 0.0, 0.75], [1.5, 1.0, 0.0, 0.25], [0.0, 0.0, 0.0, 0.0]])


def make_shadowed(lamps=LAMPS, **options):
    """Opaque anchors on a plate and the wall behind it, under lamps beside the lens."""
    appearance = {"name": "attenuated", "head": "plain", **options}
    geometry = {"name": "plain", "initial_opacity": 0.9}
    scene = plate_scene((0.0, 0.0, 0.0), 0.0, frames=3)
    field = make_field("anchors", scene, geometry_head=geometry, appearance_head=appearance, voxel_size=0.3)
    if options.get("shadows"):
        field.appearance_head.lamps.copy_(lamps)
        field.appearance_head.shadow.requires_grad_()
    return field


def test_colors_lack_the_share_of_the_lamps_that_are_in_shadow():
    field, without, camera = make_shadowed(shadows=True), make_shadowed(), camera_at(0.0, 0.0, 0.0, 64, 48)
    with torch.no_grad():
        field.appearance_head.shadow.copy_(torch.tensor([0.2, 0.5, 0.8]).logit())
    drawn, lit = field.gaussians(camera), without.gaussians(camera)
    sizes = drawn.scales.median(dim=1).values
    shares = [lit_shares(drawn.means, drawn.opacities, sizes, camera, lamp[:3]) for lamp in LAMPS]
    dark = 1.0 - 0.75 * shares[0] - 0.25 * shares[1]
    assert (dark == 0.0).any() and (dark == 0.25).any() and (dark == 0.75).any()
    expected = lit.colors * (1.0 - dark[:, None] * torch.tensor([0.2, 0.5, 0.8]))
    torch.testing.assert_close(drawn.colors, expected)

    drawn.colors.sum().backward()
    slopes = -torch.tensor([0.16, 0.25, 0.16]) * (dark[:, None] * lit.colors).sum(0)  # of sigmoids
    torch.testing.assert_close(field.appearance_head.shadow.grad, slopes)
    bias = field.appearance_head.head.color_mlp[2].bias.grad
    expected.sum().backward()
    torch.testing.assert_close(bias, without.appearance_head.head.color_mlp[2].bias.grad)
    assert not field.offsets.grad.any(), "shadows do not move what casts them"


def test_without_lamps_colors_are_those_without_shadows_to_the_bit():
    field, without, camera = make_shadowed(torch.zeros(3, 4), shadows=True), make_shadowed(), camera_at(0.0, 0.0, 0.0)
    drawn = field.gaussians(camera)
    assert field.appearance_head.shadows(drawn.means, drawn.opacities, drawn.scales, camera) is None
    assert torch.equal(drawn.colors, without.gaussians(camera).colors)


def test_a_held_light_casts_no_such_shadows():
    camera = camera_at(0.0, 0.0, 0.0)
    for light in (LightOfCamera(camera), FlattenedLight(12.0, 0.9)):
        colors = [make_shadowed(shadows=shadows).gaussians(camera, light).colors for shadows in (True, False)]
        assert torch.equal(*colors)


def test_lamps_of_shadows_are_in_the_state_and_the_record():
    field = make_shadowed(shadows=True)
    restored = type(field).from_state(field.state_dict(), field.settings)
    assert torch.equal(restored.appearance_head.lamps, LAMPS)
    camera = camera_at(0.0, 0.0, 0.0)
    assert torch.equal(restored.gaussians(camera).colors, field.gaussians(camera).colors)
    assert restored.learned["lamps"] == LAMPS.tolist()
    assert restored.learned["shadow"] == pytest.approx([1.0 / (1.0 + math.exp(0.5))] * 3)
    assert field.parameter_groups()["shadow"] == [field.appearance_head.shadow]
    without = make_shadowed()
    assert not {"lamps", "shadow"} & {*without.learned, *without.parameter_groups()}
    assert not any(name.endswith((".lamps", ".shadow")) for name in without.state_dict())


def test_lamps_that_points_tell_of_are_kept():
    scene = plate_scene((-1.6, 0.0, 0.0), 0.4, frames=8)
    appearance = {"name": "attenuated", "head": "plain", "initial": "points", "shadows": True}
    head = make_field("anchors", scene, geometry_head="plain", appearance_head=appearance).appearance_head
    assert torch.equal(head.lamps[:1], fit_light(scene).lamps)
    assert head.lamps[0, 0] < -1.0 and not head.lamps[1:].any() and head.shadow.requires_grad
