"""The catalogue of real endoscopes against the calibrations that it was made from."""

from __future__ import annotations

import json

import numpy as np
import pytest

from coliags_plugin.core.errors import InputError
from coliags_plugin.geometry.lenses.endoscopes import ENDOSCOPES, endoscope


def test_a_mistyped_name_is_answered_with_the_nearest():
    with pytest.raises(InputError, match=r"no endoscope 'endomaper-07'.*Did you mean 'endomapper-07'"):
        endoscope("endomaper-07")


def test_every_lens_bends_inwards_and_every_axis_is_a_unit_vector_near_the_optical_axis():
    assert list(ENDOSCOPES) == [f"endomapper-{number:02d}" for number in range(1, 19)]
    for each in ENDOSCOPES.values():
        k = each.lens.pinhole
        seen = each.lens.project([[0.0, 0.0, 1.0], [1.0, 0.0, 1.0], [5.0, 0.0, 1.0]])
        assert seen[0] == pytest.approx((k.cx, k.cy))
        assert k.cx < seen[1, 0] < seen[2, 0] < k.cx + k.fx * np.arctan(5.0)
        assert np.linalg.norm(each.axis) == pytest.approx(1.0)
        assert each.axis[2] > np.cos(np.radians(8.2))


def test_the_catalogue_is_the_calibrations(shared_data):
    file = shared_data / "endomapper_calibrations" / "endoscopes.json"
    if not file.is_file():
        pytest.skip(f"no {file.parent.name} in {shared_data.name}")
    records = json.loads(file.read_text())
    assert len(records) == len(ENDOSCOPES)
    for record in records:
        each = endoscope(f"endomapper-{record['endoscope']:02d}")
        lens = each.lens
        assert (lens.width, lens.height) == (record["width"], record["height"])
        assert (lens.fx, lens.fy) == (record["fu"], record["fv"])
        # The files count pixel centres at integers.
        assert (lens.cx, lens.cy) == (record["u0"] + 0.5, record["v0"] + 0.5)
        assert [lens.k1, lens.k2, lens.k3, lens.k4] == record["k"]
        assert each.power == record["light_exponent"]
        assert each.axis == pytest.approx(record["light_direction"], abs=1e-6)
