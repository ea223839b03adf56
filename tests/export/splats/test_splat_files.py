"""Files of Gaussians, as this package and other programs read them; and their frame and unit, those of meshes too."""

from __future__ import annotations

import gzip
import logging
import re
import struct
from dataclasses import replace
from pathlib import Path

import gsply
import numpy as np
import pytest
import torch
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.ply import read_vertices, write_ply
from coliags_plugin.export.splats import formats
from coliags_plugin.export.splats.cloud import THICKNESS_SHARE, SplatCloud
from coliags_plugin.export.splats.formats import READERS, WRITERS, read_splats, write_splats
from coliags_plugin.fields import spherical_harmonics
from coliags_plugin.geometry.meshes.mesh import TriangleMesh, write_mesh
from tests.export.splats.clouds import covariances, random_cloud, read_glb

DOCUMENTATION = Path(__file__).parents[3] / "docs/export.md"


def written(tmp_path, cloud: SplatCloud, name: str):
    path = tmp_path / f"cloud.{name}"
    write_splats(path, cloud, name)
    return path


@settings(max_examples=40, deadline=None)
@given(
    count=st.integers(1, 40),
    degree=st.integers(0, 3),
    exponent=st.floats(-20, 12),
    opacity=st.floats(0, 1, width=32),
    seed=st.integers(0, 999),
)
def test_ply_round_trip(tmp_path_factory, count, degree, exponent, opacity, seed):
    cloud = random_cloud(count, degree, seed=seed)
    cloud = replace(
        cloud, scales=cloud.scales * np.float32(np.exp(exponent)), opacities=np.full_like(cloud.opacities, opacity)
    )
    again = read_splats(written(tmp_path_factory.mktemp("ply"), cloud, "ply"))
    assert again.degree == degree
    np.testing.assert_array_equal(again.means, cloud.means)
    np.testing.assert_array_equal(again.harmonics, cloud.harmonics)
    np.testing.assert_allclose(again.quats_wxyz, cloud.quats_wxyz, atol=2e-7)
    np.testing.assert_allclose(again.scales, cloud.scales, rtol=2e-5)
    np.testing.assert_allclose(again.opacities, cloud.opacities, atol=2e-6)


def test_attributes_of_ply_stand_in_the_order_of_3dgs(tmp_path):
    cloud = random_cloud(3)
    data = written(tmp_path, cloud, "ply").read_bytes()
    header, _, body = data.partition(b"end_header\n")
    names = [line.split()[-1] for line in header.decode().splitlines() if line.startswith("property")]
    rest = [f"f_rest_{index}" for index in range(45)]
    scales, rotations = [f"scale_{index}" for index in range(3)], [f"rot_{index}" for index in range(4)]
    assert names == [*"xyz", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", *rest, "opacity", *scales, *rotations]
    rows = np.frombuffer(body, "<f4").reshape(3, 62)
    # Channel by channel: the 15 coefficients of red come first.
    np.testing.assert_array_equal(rows[:, 9:24], cloud.harmonics[:, 1:, 0])
    np.testing.assert_array_equal(rows[:, 3:6], 0.0)
    opacity = cloud.opacities.astype(np.float64)
    np.testing.assert_allclose(rows[:, 54], np.log(opacity / (1 - opacity)), rtol=1e-5)
    np.testing.assert_allclose(rows[:, 55:58], np.log(cloud.scales), rtol=1e-5, atol=1e-6)


def test_surfels_get_a_third_scale_that_is_finite_and_files_without_it_or_normals_are_read(tmp_path):
    cloud = random_cloud(scales=2)
    for name in ("ply", "spz"):
        again = read_splats(written(tmp_path, cloud, name))
        assert again.scales.shape == (50, 3)
    thinnest = np.sort(read_splats(tmp_path / "cloud.ply").scales, axis=1)[:, 0]
    np.testing.assert_allclose(thinnest, THICKNESS_SHARE * cloud.scales.min(axis=1), rtol=1e-4)
    columns = read_vertices(tmp_path / "cloud.ply")
    for name in ("scale_2", "nx", "ny", "nz"):
        del columns[name]
    write_ply(tmp_path / "surfels.ply", columns)
    np.testing.assert_allclose(read_splats(tmp_path / "surfels.ply").scales, cloud.scales, rtol=1e-5)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_spz_round_trip_to_its_quantisation(tmp_path, degree):
    cloud = random_cloud(300, degree)
    again = read_splats(written(tmp_path, cloud, "spz"))
    assert again.degree == degree
    np.testing.assert_allclose(again.means, cloud.means, atol=0.5 / 4096 + 1e-5)
    np.testing.assert_allclose(np.log(again.scales), np.log(cloud.scales), atol=0.5 / 16 + 1e-5)
    np.testing.assert_allclose(again.opacities, cloud.opacities, atol=0.5 / 255 + 1e-5)
    np.testing.assert_allclose(again.harmonics[:, 0], cloud.harmonics[:, 0], atol=0.5 / (255 * 0.15) + 1e-5)
    np.testing.assert_allclose(again.harmonics[:, 1:], cloud.harmonics[:, 1:], atol=0.5 / 128 + 1e-5)
    aligned = np.abs((again.quats_wxyz * cloud.quats_wxyz).sum(axis=1))
    assert np.degrees(2 * np.arccos(np.minimum(aligned, 1.0))).max() < 0.3


def test_spz_is_turned_to_its_own_axes(tmp_path):
    """y up and z backwards: positions, covariances and colours seen along turned directions."""
    cloud = random_cloud(40)
    path = written(tmp_path, cloud, "spz")
    assert struct.unpack("<II", gzip.decompress(path.read_bytes())[:8]) == (0x5053474E, 3)
    np.testing.assert_allclose(gsply.read_spz(path).means, cloud.means * [1, -1, -1], atol=2e-4)
    turned, turn = formats._half_turn(cloud), np.diag([1.0, -1.0, -1.0])
    np.testing.assert_allclose(covariances(turned), turn @ covariances(cloud) @ turn, atol=1e-5)
    directions = torch.nn.functional.normalize(torch.randn(40, 3, generator=torch.Generator().manual_seed(1)), dim=1)
    shown = [
        spherical_harmonics.colors(torch.from_numpy(part.harmonics), along, 3)
        for part, along in ((cloud, directions), (turned, directions * torch.tensor([1.0, -1.0, -1.0])))
    ]
    torch.testing.assert_close(*shown)


def test_spz_of_far_gaussians_is_coarser_and_says_when_it_cannot(tmp_path):
    cloud = random_cloud(10)
    far = replace(cloud, means=cloud.means + np.float32(3000.0))
    again = read_splats(written(tmp_path, far, "spz"))
    np.testing.assert_allclose(again.means, far.means, atol=0.5 / 2048 + 1e-4)
    with pytest.raises(InputError, match="SPZ's range"):
        write_splats(tmp_path / "far.spz", replace(cloud, means=cloud.means + np.float32(1e9)), "spz")


def test_glb_follows_the_extension(tmp_path):
    cloud = random_cloud(7, 2)
    document, values, extension = read_glb(written(tmp_path, cloud, "glb"))
    primitive = document["meshes"][0]["primitives"][0]
    assert primitive["mode"] == 0 and document["extensionsUsed"] == ["KHR_gaussian_splatting"]
    assert extension == {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}
    np.testing.assert_array_equal(values["POSITION"], cloud.means)
    # COLOR_0 is linear light: encoded by the curve of sRGB, colours again.
    light = values["COLOR_0"][:, :3]
    srgb = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    np.testing.assert_allclose(srgb, np.clip(0.5 + 0.28209479177387814 * cloud.harmonics[:, 0], 0, 1), atol=1e-6)
    np.testing.assert_allclose(values["KHR_gaussian_splatting:ROTATION"], cloud.quats_wxyz[:, [1, 2, 3, 0]], atol=1e-6)
    np.testing.assert_array_equal(values["KHR_gaussian_splatting:SCALE"], cloud.scales)
    np.testing.assert_array_equal(values["KHR_gaussian_splatting:OPACITY"][:, 0], cloud.opacities)
    orders = [(degree, order) for degree in range(3) for order in range(2 * degree + 1)]
    coefficients = [values[f"KHR_gaussian_splatting:SH_DEGREE_{degree}_COEF_{order}"] for degree, order in orders]
    np.testing.assert_array_equal(np.stack(coefficients, axis=1), cloud.harmonics)
    assert not any("SH_DEGREE_3" in name for name in values)
    bounds = document["accessors"][primitive["attributes"]["POSITION"]]
    np.testing.assert_allclose(bounds["min"], cloud.means.min(axis=0))
    np.testing.assert_allclose(bounds["max"], cloud.means.max(axis=0))


def test_rows_that_are_not_finite_are_dropped_with_their_number(tmp_path, caplog):
    cloud = random_cloud(6)
    cloud.means[1, 2], cloud.quats_wxyz[4] = np.nan, 0.0
    write_splats(tmp_path / "holes.ply", cloud, "ply")
    with caplog.at_level(logging.WARNING):
        again = read_splats(tmp_path / "holes.ply")
    assert len(again) == 4 and "dropped 2 of 6" in caplog.text
    np.testing.assert_array_equal(again.means, cloud.means[[0, 2, 3, 5]])
    cloud.means[:] = np.inf
    write_splats(tmp_path / "bad.ply", cloud, "ply")
    with pytest.raises(InputError, match="none of which is usable"):
        read_splats(tmp_path / "bad.ply")


@pytest.mark.parametrize("activated", [True, False])
def test_opacities_and_scales_that_were_activated_are_told(tmp_path, caplog, activated):
    cloud = random_cloud(20, degree=0)
    write_splats(tmp_path / "cloud.ply", cloud, "ply")
    if activated:
        columns = read_vertices(tmp_path / "cloud.ply")
        columns |= {"opacity": cloud.opacities, **{f"scale_{axis}": cloud.scales[:, axis] for axis in range(3)}}
        write_ply(tmp_path / "cloud.ply", columns)
    read_splats(tmp_path / "cloud.ply")
    assert ("results of sigmoid and exponential" in caplog.text) == activated


@pytest.mark.parametrize(
    ("lines", "text"),
    [
        (("element chunk 1", "property float min_x", "element vertex 256", "property uint packed_position"), "compres"),
        (("element vertex 1", "property float x", "property float f_offset_0"), "anchors"),
        (("element vertex 1", "property float x", "property float filter_3D"), "Mip-Splatting"),
        (("element vertex 1", "property float x", "property uchar red"), "point cloud"),
        (("element vertex 1", *(f"property float {axis}" for axis in "xyz")), "f_dc_0"),
    ],
)
def test_files_of_other_lineage_are_refused_by_name(tmp_path, lines, text):
    path = tmp_path / "other.ply"
    header = "\n".join(["ply", "format binary_little_endian 1.0", *lines, "end_header\n"]).encode()
    path.write_bytes(header + bytes(12))
    with pytest.raises(InputError, match=text):
        read_splats(path)


def test_an_incomplete_set_of_harmonics_is_refused(tmp_path):
    path = tmp_path / "odd.ply"
    write_splats(path, random_cloud(2), "ply")
    path.write_bytes(path.read_bytes().replace(b"f_rest_44", b"g_rest_44"))
    with pytest.raises(InputError, match="44 properties f_rest"):
        read_splats(path)


@pytest.mark.parametrize("name", ["ply", "spz"])
def test_damaged_and_missing_files_are_clear_errors(tmp_path, name):
    path = written(tmp_path, random_cloud(30), name)
    path.write_bytes(path.read_bytes()[:-7])
    with pytest.raises(InputError):
        read_splats(path)
    path.unlink()
    with pytest.raises(InputError, match="cannot read"):
        read_splats(path)


def test_unknown_formats_and_nothing_to_write_are_refused(tmp_path):
    with pytest.raises(InputError, match=f"one of {', '.join(WRITERS)}"):
        write_splats(tmp_path / "a", random_cloud(1), "sog")
    with pytest.raises(InputError, match="no Gaussian"):
        write_splats(tmp_path / "a", random_cloud(0), "ply")
    with pytest.raises(InputError, match="no reader"):
        read_splats(tmp_path / "a.glb")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", WRITERS)
def test_formats_keep_positions_and_are_documented(tmp_path, name):
    cloud = random_cloud(9)
    path = written(tmp_path, cloud, name)
    if name in READERS:
        np.testing.assert_allclose(READERS[name](path).means, cloud.means, atol=1.0 / 4096)
    (row,) = re.findall(rf"^\| `{name}` \|.*\| (.*?) \|$", DOCUMENTATION.read_text(encoding="utf-8"), re.M)
    assert row.startswith("yes" if name in READERS else "no")


@pytest.mark.parametrize("name", ["mesh.ply", "mesh.obj", "mesh.glb", "splats.ply", "splats.glb"])
def test_trimesh_reads_files_in_the_frame_of_the_scene(tmp_path, name):
    """A tetrahedron that no turn and no mirroring brings back onto itself."""
    places = np.array([[1, 2, 30], [5, 2, 31], [1, 9, 33], [2, 3, 45]], np.float32)
    colors = np.array([[255, 0, 0], [0, 255, 0], [0, 0, 255], [255, 255, 255]], np.uint8)
    if name.startswith("mesh"):
        write_mesh(
            tmp_path / name, TriangleMesh(places, np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]), colors)
        )
    else:
        write_splats(tmp_path / name, replace(random_cloud(4, 0), means=places), name.partition(".")[2])
    (placed,) = trimesh.load_scene(tmp_path / name, skip_materials=True).dump()
    order = np.argsort(placed.vertices[:, 2])
    np.testing.assert_allclose(placed.vertices[order], places, rtol=1e-6)
    if name.startswith("mesh"):
        np.testing.assert_array_equal(placed.visual.vertex_colors[order, :3], colors)
