"""Lens models against OpenCV, against one another and against the real data; resampling through them."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.intrinsics import Intrinsics
from coliags_plugin.geometry.lenses.models import LENSES, FisheyeLens, OpenCVLens, PinholeLens, octagon_mask
from coliags_plugin.geometry.lenses.undistortion import NOWHERE, Undistortion, undistortion_map
from coliags_plugin.geometry.lenses.vicalib import Calibration, calibration_files, find_calibration, read_calibration
from tests.commands import refuses

INTRINSICS = Intrinsics(801.0, 790.0, 660.5, 545.5, 1350, 1080)
ALL = {**LENSES, "pinhole": PinholeLens.of(INTRINSICS)}
FISHEYE = LENSES["fisheye"]
BROWN = LENSES["legacy-pinhole"]
OMNI = LENSES["omnidirectional"]
SIZE = {"width": 1350, "height": 1080}
VIEW = {"fx": 802.3, "fy": 790.1, "cx": 668.3, "cy": 547.7}
FULL = {"k1": -0.42, "k2": 0.1, "p1": 1e-3, "p2": -2e-3, "k3": 0.01, "k4": 0.02, "k5": 0.03, "k6": -0.01}
LENS = OpenCVLens(**SIZE, **VIEW, **FULL)


def angle(directions: np.ndarray) -> np.ndarray:
    return np.degrees(np.arctan(np.linalg.norm(directions[:, :2], axis=1)))


def grid(width: int, height: int, step: int) -> np.ndarray:
    """Centres of every ``step``-th pixel. [N, 2]"""
    columns, rows = np.meshgrid(np.arange(0, width, step), np.arange(0, height, step))
    return np.stack([columns.ravel(), rows.ravel()], axis=1) + 0.5


@pytest.mark.parametrize("name", ALL)
@settings(max_examples=25, deadline=None)
@given(
    x=st.floats(-1.5, 1.5), y=st.floats(-1.5, 1.5), z=st.floats(0.01, 200.0), width=st.sampled_from([1350, 338, 500])
)
def test_projecting_and_unprojecting_are_inverse(name, x, y, z, width):
    lens = ALL[name].resized(width, 270)
    pixel = lens.project([[x * z, y * z, z]])
    direction = lens.unproject(pixel)
    assert direction[0, 2] == 1.0
    np.testing.assert_allclose(direction[0], [x, y, 1.0], rtol=0, atol=1e-10)


def test_fisheye_is_opencvs():
    matrix = FISHEYE.pinhole.opencv_matrix()
    bending = np.array([FISHEYE.k1, FISHEYE.k2, FISHEYE.k3, FISHEYE.k4])
    points = np.random.default_rng(0).uniform([-40, -30, 20], [40, 30, 60], (500, 3))
    reference, _ = cv2.fisheye.projectPoints(points[:, None], np.zeros(3), np.zeros(3), matrix, bending)
    np.testing.assert_allclose(FISHEYE.project(points), reference[:, 0] + 0.5, rtol=0, atol=1e-8)
    pixels = reference[:, 0]
    back = cv2.fisheye.undistortPoints(pixels[:, None], matrix, bending)[:, 0]
    np.testing.assert_allclose(FISHEYE.unproject(pixels + 0.5)[:, :2], back, rtol=0, atol=1e-7)


def test_omnidirectional_follows_its_written_definition():
    u, v = 200.0, 900.0
    q = np.linalg.solve([[OMNI.c, OMNI.e], [OMNI.d, 1.0]], [u - OMNI.cx, v - OMNI.cy])
    rho = np.hypot(*q)
    ray = [q[0], q[1], OMNI.a0 + OMNI.a2 * rho**2 + OMNI.a3 * rho**3 + OMNI.a4 * rho**4]
    np.testing.assert_allclose(OMNI.unproject([[u, v]])[0], np.array(ray) / ray[2], rtol=1e-13)
    np.testing.assert_array_equal(OMNI.unproject([[OMNI.cx, OMNI.cy]]), [[0.0, 0.0, 1.0]])
    np.testing.assert_allclose(OMNI.project([[0.0, 0.0, 5.0]]), [[OMNI.cx, OMNI.cy]], rtol=0, atol=1e-12)


def test_agreement_of_the_three_lenses_is_the_one_on_record():
    # docs/layouts/c3vd.md 2: undistorted radius, source radius, angle by legacy pinhole, omnidirectional and fisheye
    table = [
        (200, 194.8, 14.00, 14.73, 14.73),
        (400, 360.6, 26.50, 28.20, 28.21),
        (600, 478.3, 36.79, 39.07, 39.08),
        (675, 509.2, 40.07, 42.25, 42.24),
        (864, 564.6, 47.12, 48.41, 48.39),
    ]
    for undistorted, source, by_brown, by_omni, by_fisheye in table:
        x = undistorted / BROWN.fx
        assert BROWN.project([[x, 0, 1]])[0, 0] - BROWN.cx == pytest.approx(source, abs=0.06)
        for lens, expected in ((BROWN, by_brown), (OMNI, by_omni), (FISHEYE, by_fisheye)):
            exact = BROWN.project([[x, 0, 1]])[0, 0] - BROWN.cx
            # The table's angles are radial: the small affine part of the omnidirectional lens is not in them.
            assert angle(lens.unproject([[lens.cx + exact, lens.cy]]))[0] == pytest.approx(expected, abs=0.012)


def test_the_scaled_pinhole_is_c3vds_moved_by_half_a_pixel():
    k = BROWN.resized(338, 270).pinhole
    np.testing.assert_allclose([k.fx, k.fy], (200.8769, 200.4713), atol=6e-5)
    # Published K counts from integers and is scaled as if these were pixel edges; here edges stay in place.
    np.testing.assert_allclose([k.cx - 0.5 * 338 / 1350, k.cy - 0.125], (167.3190, 136.9333), atol=6e-5)


@pytest.mark.parametrize("name", ALL)
def test_scaling_keeps_what_a_place_in_the_image_sees(name):
    lens = ALL[name]
    quarter = lens.resized(338, 270)
    pixels = grid(338, 270, 20)
    same_place = pixels * (1350 / 338, 1080 / 270)
    np.testing.assert_allclose(quarter.unproject(pixels), lens.unproject(same_place), rtol=0, atol=1e-12)
    back = quarter.resized(1350, 1080)
    np.testing.assert_allclose(back.unproject(same_place), lens.unproject(same_place), rtol=0, atol=1e-12)


def test_what_cannot_be_seen_is_nan():
    points = [[0, 0, -1], [1, 1, 0], [np.nan, 0, 1]]
    assert np.isnan(ALL["pinhole"].project(points[:2])).all() and ALL["pinhole"].pinhole == INTRINSICS
    for lens in LENSES.values():
        assert np.isnan(lens.project(points)).all() and np.isnan(lens.unproject([[np.nan, 3.0], [1e9, 0.0]])).all()
        assert lens.unproject(np.empty((0, 2))).shape == (0, 3) and lens.project(np.empty((0, 3))).shape == (0, 2)


def test_models_end_where_they_turn_back():
    # The fisheye polynomial turns at 76 degrees; the omnidirectional one reaches 90 degrees at radius 837.
    assert np.isnan(FISHEYE.project([[np.tan(np.radians(80)), 0, 1]])).all()
    assert np.isfinite(FISHEYE.project([[np.tan(np.radians(75)), 0, 1]])).all()
    assert np.isnan(FISHEYE.unproject([[0.0, 0.0]])).all()
    assert np.isnan(OMNI.unproject([[OMNI.cx + 850, OMNI.cy]])).all()
    assert np.isfinite(OMNI.project([[np.tan(np.radians(89.9)), 0, 1]])).all()
    assert np.isfinite(BROWN.project([[50.0, 0, 1]])).all()
    pole = OpenCVLens(**SIZE, **VIEW, k4=-0.5)  # of the rational model, not to be crossed
    assert np.isfinite(pole.project([[1.40, 0, 1]])).all()
    assert np.isnan(pole.project([[1.42, 0, 1], [3.0, 0, 1]])).all()


def test_negligible_terms_change_nothing():
    pixels = np.array([[300.0, 400.0], [900.0, 200.0]])
    for name, term in (("omnidirectional", "a4"), ("legacy-pinhole", "k2"), ("fisheye", "k4")):
        tiny, without = (replace(LENSES[name], **{term: value}).unproject(pixels) for value in (1e-320, 0.0))
        np.testing.assert_array_equal(tiny, without)


def test_undistortion_map_marks_what_the_lens_does_not_reach():
    columns, rows = undistortion_map(FISHEYE, replace(FISHEYE.resized(135, 108).pinhole, fx=6.0, fy=6.0))
    assert columns.dtype == rows.dtype == np.float32 and columns[0, 0] == NOWHERE
    assert np.isfinite(columns).all() and np.isfinite(rows).all()


def test_octagon_is_symmetric_and_scales():
    mask = octagon_mask(1350, 1080)
    np.testing.assert_array_equal(mask, mask[::-1, ::-1])
    np.testing.assert_array_equal(mask, mask[:, ::-1])
    assert not mask[0, 0] and mask[540].all()
    assert mask.mean() == pytest.approx(0.93, abs=2e-4)
    assert octagon_mask(338, 270).mean() == pytest.approx(0.93, abs=2e-3)


def test_octagon_is_c3vds(shared_data):
    """Differing pixels lie within one pixel of the oblique edges: 253 of 1,458,000."""
    published = cv2.imread(str(shared_data / "c3vdv3_mask" / "mask.png"), cv2.IMREAD_UNCHANGED) > 0
    mask = octagon_mask(1350, 1080)
    assert (mask != published).sum() < 300
    kernel = np.ones((3, 3), np.uint8)
    grown, shrunk = cv2.dilate(mask.astype(np.uint8), kernel), cv2.erode(mask.astype(np.uint8), kernel)
    assert not (published & (grown == 0)).any() and not (~published & (shrunk == 1)).any()


def test_lenses_on_real_geometry(shared_data):
    """Points in camera axes, mm, and their pixels, of frames 0 and 1 of three sequences.

    The pixels come from REIM-NeRF's fisheye calibration, and so do the points (they fill its pinhole image to the
    edge); so this tells how far two lenses are from each other on real geometry, not which of them is right.
    """
    parts = []
    for path in sorted((shared_data / "c3vd_sparse_depth").glob("*.npz")):
        data = np.load(path)
        local = (data["points_world_mm"].astype(float) - data["c2w"][:3, 3]) @ data["c2w"][:3, :3]
        parts.append((local, data["uv_raw1350x1080"].astype(float) + 0.5))  # the file counts from integers
    points, pixels = map(np.concatenate, zip(*parts, strict=True))
    for lens, pixel_error, mm_error in (
        (FISHEYE, (0.0001, 0.0002), (0.0002, 0.0003)),
        (OMNI, (1.35, 2.2), (0.12, 0.22)),
        (BROWN, (21.0, 35.0), (1.9, 4.0)),
    ):
        off = np.linalg.norm(lens.project(points) - pixels, axis=1)
        wrong = np.linalg.norm(lens.unproject(pixels) * points[:, 2:] - points, axis=1)
        assert (np.quantile(off, [0.5, 0.95]) < pixel_error).all()
        assert (np.quantile(wrong, [0.5, 0.95]) < mm_error).all()


@pytest.mark.parametrize("name", LENSES)
@pytest.mark.parametrize("size", [(150, 130), (700, 540)])
def test_every_pixel_shows_what_its_pinhole_ray_sees(name, size):
    lens = LENSES[name].resized(675, 540)
    pinhole = LENSES[name].resized(*size).pinhole
    tangents = np.nan_to_num(lens.unproject(grid(675, 540, 1))[:, :2].reshape(540, 675, 2))
    image = np.rint(np.clip(128.0 + 100.0 * tangents, 0, 255)).astype(np.uint8)
    undistortion = Undistortion(lens, pinhole, octagon_mask(675, 540))
    assert undistortion.valid.all()
    result = undistortion.image(np.dstack([image, image[..., :1]]))
    rays = PinholeLens.of(pinhole).unproject(grid(*size, 1))[:, :2].reshape(size[1], size[0], 2)
    # One grey level is 0.01; rounding at the start, in OpenCV's 1/32 pixel and at the end add up to less than two.
    np.testing.assert_allclose(result[..., :2], 128.0 + 100.0 * rays, atol=1.6)


@pytest.mark.parametrize("name", LENSES)
def test_nearest_is_within_half_a_source_pixel_and_keeps_16_bits(name):
    lens = LENSES[name].resized(675, 540)
    pinhole = lens.resized(338, 270).pinhole
    undistortion = Undistortion(lens, pinhole)
    columns, rows = np.meshgrid(np.arange(675, dtype=np.uint16), np.arange(540, dtype=np.uint16))
    column, row = undistortion.nearest(columns, 0), undistortion.nearest(rows, 0)
    assert column.dtype == np.uint16
    exact = lens.project(PinholeLens.of(pinhole).unproject(grid(338, 270, 1))).reshape(270, 338, 2)
    assert np.abs(np.stack([column, row], -1) + 0.5 - exact).max() <= 0.5 + 1e-4


def test_shrinking_by_a_whole_number_is_the_mean_of_blocks_and_the_same_size_changes_nothing():
    lens = replace(BROWN, k1=0.0, k2=0.0).resized(240, 192)
    image = np.random.default_rng(0).integers(0, 256, (192, 240, 3), dtype=np.uint8)
    nominal = lens.resized(60, 48).pinhole
    undistortion = Undistortion(lens, nominal)
    assert undistortion.supersampling == 4
    blocks = image.reshape(48, 4, 60, 4, 3).mean(axis=(1, 3))
    np.testing.assert_allclose(undistortion.image(image), blocks, atol=0.51)
    same = Undistortion(lens, lens.pinhole)
    np.testing.assert_array_equal(same.image(image), image)
    np.testing.assert_array_equal(same.nearest(image[..., 0], 0), image[..., 0])
    # No more samples than of half the focal length.
    for fx, fy in ((0.5 * nominal.fx, 0.5 * nominal.fy), (1.0, nominal.fy)):
        assert Undistortion(lens, replace(nominal, fx=fx, fy=fy)).supersampling == 8


def test_no_pixel_of_the_dark_corners_gets_in():
    lens = LENSES["omnidirectional"].resized(675, 540)
    octagon = octagon_mask(675, 540)
    nominal = lens.resized(169, 135).pinhole
    wide = replace(nominal, fx=nominal.fx * 0.45, fy=nominal.fy * 0.45)
    undistortion = Undistortion(lens, wide, octagon)
    assert 0.5 < undistortion.valid.mean() < 0.97
    image = np.where(octagon[..., None], 200, 0).astype(np.uint8).repeat(3, axis=2)
    assert (undistortion.image(image)[undistortion.valid] == 200).all()
    assert (undistortion.nearest(octagon, 0)[undistortion.valid]).all()


@pytest.mark.parametrize("lens", [LENS, BROWN], ids=["rational", "legacy-pinhole"])
def test_projecting_unprojecting_and_maps_are_opencvs(lens):
    matrix, small = lens.pinhole.opencv_matrix(), lens.resized(338, 270).pinhole
    bends = np.array([getattr(lens, name) for name in FULL])
    points = np.random.default_rng(0).uniform([-40, -30, 20], [40, 30, 60], (500, 3))
    reference, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), matrix, bends)
    np.testing.assert_allclose(lens.project(points), reference[:, 0] + 0.5, rtol=0, atol=1e-9)
    pixels = grid(1350, 1080, 17) - 0.5
    pixels = pixels[np.linalg.norm(pixels - (668.3, 547.7), axis=1) < 500]
    criteria = (cv2.TERM_CRITERIA_MAX_ITER + cv2.TERM_CRITERIA_EPS, 300, 1e-14)
    if hasattr(cv2, "undistortPointsIter"):  # until OpenCV 5
        reference = cv2.undistortPointsIter(pixels[:, None], matrix, bends, None, None, criteria)[:, 0]
    else:
        reference = cv2.undistortPoints(pixels[:, None], matrix, bends, criteria=criteria)[:, 0]
    np.testing.assert_allclose(lens.unproject(pixels + 0.5)[:, :2], reference, rtol=0, atol=1e-8)
    maps = cv2.initUndistortRectifyMap(matrix, bends, None, small.opencv_matrix(), (338, 270), cv2.CV_32FC1)
    np.testing.assert_allclose(undistortion_map(lens, small), maps, rtol=0, atol=1e-3)


@pytest.mark.parametrize(
    "bends", [(-0.3, 0.0), (-0.42234, 0.10654), (-0.2, -0.1), (0.1, -0.05), (0.2, 0.1)], ids=lambda pair: f"{pair}"
)
def test_where_a_polynomial_turns_back_there_is_nothing(bends):
    """r (1 + k1 r^2 + k2 r^4) increases up to the smallest root of its derivative."""
    lens = OpenCVLens(**SIZE, **VIEW, k1=bends[0], k2=bends[1])
    roots = np.roots([5.0 * bends[1], 3.0 * bends[0], 1.0]) if bends[1] else np.array([-1.0 / (3.0 * bends[0])])
    squares = roots.real[(np.abs(roots.imag) < 1e-9) & (roots.real > 0.0)]
    edge = min(np.sqrt(squares.min(initial=np.inf)), np.tan(np.radians(89.8)))
    around = np.linspace(0.0, 2.0 * np.pi, 50)
    for share, is_reached in ((0.9999, True), (1.0001, not len(squares))):
        rim = edge * share * np.stack([np.cos(around), np.sin(around), np.full(50, 1.0 / (edge * share))], axis=1)
        assert np.isfinite(lens.project(rim)).all() == is_reached
    farthest = edge * (1.0 + bends[0] * edge**2 + bends[1] * edge**4)
    for share, is_reached in ((0.99, True), (1.001, False)) if len(squares) else ():
        pixels = np.array([VIEW["cx"], VIEW["cy"]]) + share * farthest * np.diag([VIEW["fx"], -VIEW["fy"]])
        directions = lens.unproject(pixels)
        assert np.isfinite(directions).all() == is_reached
        if is_reached:
            np.testing.assert_allclose(lens.project(directions), pixels, atol=1e-6)


#: As Vicalib writes it, comments and all.
VICALIB = """<rig>
    <camera>
        <camera_model name="" index="0" serialno="0" type="calibu_fu_fv_u0_v0_kb4" version="8">
            <width> 1440 </width>
            <height> 1080 </height>
            <!-- Use RDF matrix, [right down forward], to define the coordinate frame convention -->
            <right> [ 1; 0; 0 ] </right>
            <down> [ 0; 1; 0 ] </down>
            <forward> [ 0; 0; 1 ] </forward>
            <!-- Camera parameters ordered as per type name. -->
            <params> [  717.2; 717.5; 735.4; 552.8; -0.139; -0.00124; 0.000913; -4.07e-05 ] </params>
        </camera_model>
        <pose>
            <T_wc> [ 1, 0, 0, 0; 0, 1, 0, 0; 0, 0, 1, 0 ] </T_wc>
        </pose>
    </camera>
</rig>
"""


def write(folder, text, name="calibration.xml"):
    (folder / name).write_text(text)
    return folder / name


def test_the_lens_has_pixel_centres_half_a_pixel_further(tmp_path):
    path = write(tmp_path, VICALIB.replace("</camera_model>", "<depth_scale> 123.4 </depth_scale></camera_model>"))
    view = {"width": 1440, "height": 1080, "fx": 717.2, "fy": 717.5, "cx": 735.4 + 0.5, "cy": 552.8 + 0.5}
    lens = FisheyeLens(**view, k1=-0.139, k2=-0.00124, k3=0.000913, k4=-4.07e-05)
    assert read_calibration(path) == Calibration(path, lens, 123.4)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("</rig>", "", r"calibration\.xml is not XML: .*line \d+"),
        ("<rig>", "<!DOCTYPE rig [<!ENTITY a 'b'>]><rig>", "has a document type"),
        ("_kb4", "_k1_k2", "camera model 'calibu_fu_fv_u0_v0_k1_k2'. Expected calibu_fu_fv_u0_v0_kb4.* `camera`"),
        ("; -4.07e-05", "", r"params '\[  717\.2;.*913 \]'. Expected 8 finite numbers"),
        ("717.5", "nan", r"params .*Expected 8 finite numbers"),
        ("717.5", "-717.5", r"focal lengths 717\.2, -717\.5 and .*above 0"),
        ("735.4", "1735.4", r"principal point \(1735\.4, 552\.8\).* image of 1440 x 1080"),
        ("<width> 1440 </width>", "", r"width ''. Expected 1 finite number"),
        ("1440", "1440.5", r"an image of 1440\.5 x 1080.*whole pixels"),
        ("1440", "99999", r"an image of 99999 x 1080"),
        ("717.2", "1e9", r"a lens with fx 1e\+09"),
        ("camera_model", "sensor_model", "has 0 different cameras"),
        ("</rig>", "<depth_scale>0</depth_scale></rig>", None),  # not within the camera model
        ("</camera_model>", "<depth_scale>0</depth_scale></camera_model>", "depth_scale 0. Expected a number above 0"),
    ],
)
def test_damaged_files_are_refused(tmp_path, old, new, message):
    path = write(tmp_path, VICALIB.replace(old, new))
    if message is None:
        assert read_calibration(path).depth_scale is None
        return
    with pytest.raises(InputError, match=message) as caught:
        read_calibration(path)
    assert "\n" not in str(caught.value)


def test_a_missing_file_and_a_rig_of_two_cameras_are_refused(tmp_path):
    refuses(r"cannot read .*gone\.xml", read_calibration, tmp_path / "gone.xml")
    camera = VICALIB.removeprefix("<rig>").removesuffix("</rig>\n")
    with pytest.raises(InputError, match="has 2 different cameras"):
        read_calibration(write(tmp_path, f"<rig>{camera}{camera.replace('717.2', '720')}</rig>"))
    assert read_calibration(write(tmp_path, f"<rig>{camera}{camera}</rig>")).lens.fx == 717.2


def test_the_files_of_a_folder_must_agree(tmp_path):
    assert find_calibration(tmp_path) is None and find_calibration(tmp_path / "gone") is None
    write(tmp_path, "<labels/>", "labels.xml")
    (tmp_path / "broken.xml").write_bytes(b"\xff\xfe")
    assert find_calibration(tmp_path) is None
    geometrical = write(tmp_path, VICALIB, "geometrical.XML")
    photometrical = write(tmp_path, VICALIB.replace("</rig>", "<light/></rig>"), "photometrical.xml")
    assert calibration_files(tmp_path) == [geometrical, photometrical]
    assert find_calibration(tmp_path).path == geometrical
    write(tmp_path, VICALIB.replace("717.2", "720"), "other.xml")
    refuses(r"geometrical\.XML and other\.xml have different cameras", find_calibration, tmp_path)
