"""Calibration files of Vicalib."""

from __future__ import annotations

import pytest

from coliags_plugin.core.errors import InputError
from coliags_plugin.geometry.lenses.models import FisheyeLens
from coliags_plugin.geometry.lenses.vicalib import Calibration, calibration_files, find_calibration, read_calibration

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
    with pytest.raises(InputError, match=r"cannot read .*gone\.xml"):
        read_calibration(tmp_path / "gone.xml")
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
    with pytest.raises(InputError, match=r"geometrical\.XML and other\.xml have different cameras"):
        find_calibration(tmp_path)
