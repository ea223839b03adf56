"""Results files: what is read is what was written, and nothing else is read."""

from __future__ import annotations

import hashlib
import json
import math

import numpy as np
import pytest
from pydantic import ValidationError

from coliags_plugin.core.errors import InputError
from coliags_plugin.results import hashing
from coliags_plugin.results.hashing import ArraysHash, code_key, metrics_sha256, result_key
from coliags_plugin.results.reading import facts, per_frame_table, read_result, write_result
from coliags_plugin.results.record import VERSION, CostRecord, ProfileRecord
from tests.results.made import METRICS, made_result, made_set


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "result.json"
    write_result(path, made_result())
    return path


def refusal(path) -> str:
    with pytest.raises(InputError) as read:
        read_result(path)
    return str(read.value)


def change(path, edit):
    """Edit the content of a results file."""
    content = json.loads(path.read_text())
    edit(content)
    path.write_text(json.dumps(content))


def test_what_is_read_is_what_was_written(tmp_path):
    profile = ProfileRecord(unit="mm", edges=(0, 5, 7.5), pixels=(10**9, 0), rgb_mse=(0.3, None), depth_mse=(1, None))
    part = made_set(("é", ""), (1e-300, None), (-0.0, 0.1 + 0.2), profiles={"distance": profile}, transparent=0.1)
    cost = CostRecord(device="", train_seconds=None, seconds_to_psnr={"25": 1.5, "30": None})
    facts = {"config": {"a": [{"b": None}, True, 2**70]}, "provenance": {"ü": ["\n", 0.1]}}
    result = made_result({"up": part, "test": made_set((), (), ())}, seed=-(2**63), cost=cost, **facts)
    write_result(tmp_path / "result.json", result)
    read = read_result(tmp_path / "result.json")
    assert read == result
    assert [*read.sets] == [*result.sets] and [*read.metrics] == [*result.metrics]


# Hash of the values


@pytest.mark.parametrize("value", [None, 30.0, -0.0, math.nextafter(31.5, 0.0)])
def test_any_change_of_one_value_is_found_out(file, value):
    write_result(file, made_result({"test": made_set(psnr=(0.0, 31.5))}))
    change(file, lambda content: content["sets"]["test"]["values"]["psnr"].__setitem__(value != -0.0, value))
    assert "changed or damaged" in refusal(file)


def test_the_hash_is_of_the_documented_text_whatever_the_order_of_names():
    part = made_set(("f",), (30.1,), (None,))
    turned = part.model_copy(update={"values": dict(reversed(part.values.items()))})
    values = '{"frames":["f"],"values":{"depth_mse":[null],"lpips":[null],"psnr":[30.1]}}'
    expected = hashlib.sha256(f'{{"a":{values},"b":{values}}}'.encode()).hexdigest()
    assert metrics_sha256({"a": part, "b": part}) == metrics_sha256({"b": turned, "a": part}) == expected
    renamed, changed = made_set(("g",), (30.1,), (None,)), made_set(("f",), (30.2,), (None,))
    others = ({"a": part}, {"b": part}, {"a": renamed}, {"a": changed})
    assert len({metrics_sha256(sets) for sets in others}) == 4


# Hash of images


def arrays_hash(*arrays) -> str:
    read = ArraysHash()
    for frame, part, values in arrays:
        read.add(frame, part, values)
    return read.hexdigest()


def test_images_have_a_hash_of_names_shapes_and_numbers_whatever_their_memory():
    image = np.arange(6, dtype=np.float32).reshape(2, 3)
    image[0, 0] = np.nan
    other, odd_nan = image.copy(), image.copy()
    other[1, 2] = np.nextafter(other[1, 2], np.float32(0))
    odd_nan.view(np.uint32)[0, 0] = 0xFFC00123
    one, second = ("a", "rgb", image), ("b", "rgb", image)
    others = [("a", "depth", image), ("a", "rgb", image.reshape(3, 2)), ("a", "rgb", other)]
    variants = [[one], [second], *([each] for each in others), [one, second], [second, one]]
    assert len({arrays_hash(*arrays) for arrays in variants}) == len(variants)
    same = [image, np.asfortranarray(image), image.astype(np.float64), image.astype(">f4"), odd_nan]
    assert len({arrays_hash(("a", "rgb", values)) for values in same}) == 1


# Refusals


@pytest.mark.parametrize(
    ("content", "part"),
    [
        (b"", "is not JSON"),
        (b"psnr,30", "is not JSON"),
        (b'{"format": "coliags-result", "vers', "is not JSON"),  # cut off
        (b"\xff\xfe\x00", "cannot read"),
        (b"[" * 100_000, "result.json is"),
        (b"[]", "is not a results file"),
        (b'{"psnr": 30}', "is not a results file"),
        (b'{"format": "coliags-result"}', "version is null"),
        (b'{"format": "coliags-result", "version": "1"}', 'version is "1"'),
        (b'{"format": "coliags-result", "version": true}', "version is true"),
        (b'{"format": "coliags-result", "version": 0}', "version is 0"),
        (b'{"format": "coliags-result", "version": 1}', "key: is missing"),
        (b'{"format": "coliags-result", "version": %d, "x": {}}' % (VERSION + 1), "Update the package"),
    ],
)
def test_other_content_is_refused(content, part, tmp_path):
    path = tmp_path / "result.json"
    path.write_bytes(content)
    assert part in refusal(path)
    assert all("cannot read" in refusal(place) for place in (tmp_path / "gone.json", tmp_path))


@pytest.mark.parametrize(
    ("keys", "value", "part"),
    [
        (("seed",), "0", "seed: "),
        (("metrics", "psnr", "direction"), "up", "metrics.psnr.direction: "),
        (("sets", "test", "values", "psnr"), [30.0, "31.5"], "sets.test.values.psnr.1: "),
        (("sets", "test", "values", "psnr"), [30.0, math.nan], "sets.test.values.psnr.1"),
        (("sets", "test", "values", "psnr"), [30.0], "metric 'psnr' has 1 values for 2 frames"),
        (("sets", "test", "values", "sharpness"), [1.0, 2.0], "values of sharpness, which `metrics`"),
        (("sets", "test", "frames"), ["0000", "0000"], "a frame is listed twice"),
        (("sets",), {}, "there is no test set"),
        (("cost", "colour"), "red", "cost.colour: "),
        (("unheard_of",), 1, "unheard_of: "),
    ],
)
def test_a_field_of_the_wrong_type_is_named(keys, value, part, file):
    def edit(content):
        for key in keys[:-1]:
            content = content[key]
        content[keys[-1]] = value

    change(file, edit)
    assert part in refusal(file)


def test_what_cannot_be_written_is_refused():
    with pytest.raises(ValidationError, match="finite"):
        made_set(psnr=(30.0, math.inf))
    with pytest.raises(ValidationError, match="rgb_mse has 1 numbers for 2 bins"):
        ProfileRecord(unit="mm", edges=(0, 1, 2), pixels=(1, 2), rgb_mse=(1.0,), depth_mse=(1.0, 2.0))


# Summaries


def test_means_are_over_the_frames_that_have_a_value():
    main_set, other = made_set(), made_set(psnr=(20.0, 20.0))
    summary = made_result({"rotation": other, "test": main_set}).summary()
    assert summary["psnr"] == 30.75 and summary["depth_mse"] == 0.25 and summary["lpips"] is None
    assert summary["reasons"] == {"lpips": "no weights"}
    assert "psnr_seen" not in summary and summary["sets"]["test"]["psnr_seen"] is None
    assert made_result({"rotation": other, "up": main_set}).summary()["psnr"] == 20.0, (
        "the first, without one of that name"
    )
    metrics = {**METRICS, "foreseen_seen": METRICS["lpips"]}
    assert "foreseen_seen" in made_result(metrics=metrics).summary(), "it has no foreseen beside it"


def test_the_table_has_every_frame_and_metric():
    rotation = made_set(("r",), (20.0,), (1.0,))
    rotation = rotation.model_copy(update={"values": {**rotation.values, "psnr_seen": (25.5,)}})
    assert per_frame_table(made_result({"test": made_set(), "rotation": rotation})).splitlines() == [
        "set,frame,psnr,lpips,depth_mse,psnr_seen",
        "test,0000,30.0,,0.25,",
        "test,0008,31.5,,,",
        "rotation,r,20.0,,1.0,25.5",
    ]


# Key

KEY = {
    "config": {"field": {"name": "anchors"}, "schedule": {"steps": 60}},
    "fingerprint": "f",
    "seed": 0,
    "code": "c",
    "protocol": "paper",
    "protocol_version": 1,
}


def test_a_key_depends_on_what_determines_a_result_and_on_nothing_else():
    def key(**changes):
        return result_key(**{**KEY, **changes})

    changes = [
        {"config": {"field": {"name": "anchors"}, "schedule": {"steps": 61}}},
        *({"fingerprint": "g"}, {"seed": 1}, {"code": "d"}, {"protocol": "authors-code"}, {"protocol_version": 2}),
        {"deviations": {"step": 30}},
    ]
    assert len({key(), *(key(**each) for each in changes)}) == 8
    described = KEY["config"] | {"description": "another", "protocol": "authors-code"}
    assert key(config=described, deviations={}) == key()
    plain, read = {"size": (1, 2), "far": math.inf}, {"size": [1, 2], "far": "Infinity"}
    assert key(config=plain) == key(config=read)


def test_the_key_of_the_code_changes_with_any_letter_of_its_files(tmp_path, monkeypatch):
    key = code_key.__wrapped__
    assert key() == key() == code_key()

    def of(**files):
        for name, content in files.items():
            (tmp_path / name).write_bytes(content)
        monkeypatch.setattr(hashing, "code_files", lambda: {name: tmp_path / name for name in files})
        return key()

    plain = of(one=b"x = 1\n", other=b"y = 2\n")
    others = [of(one=b"x = 1\n", other=b"y = 3\n"), of(one=b"x = 1\ny = 2\n", other=b""), of(one=b"x = 1\n")]
    assert len({plain, code_key(), *others}) == 5
    assert of(one=b"x = 1\r\n", other=b"y = 2\r\n") == plain  # as git may check them out


def test_a_result_has_means_and_is_shown_in_one_line_and_as_a_table():
    result = made_result({"test": made_set(), "rotation": made_set(("a",), (20.0,), (None,))})
    assert result.mean("psnr") == 30.75 and result.mean("psnr", "rotation") == 20.0
    assert result.mean("lpips") is None and result.mean("depth_mse", "rotation") is None
    for arguments, match in ((("pnsr",), r"metric 'pnsr'.*'psnr'"), (("psnr", "rotatoin"), r"'rotatoin'.*'rotation'")):
        with pytest.raises(InputError, match=f"no .*{match}"):
            result.mean(*arguments)
    assert repr(result) == "coliags on wall, seed 0, 60 steps, protocol paper v1: psnr 30.75 dB, depth_mse 0.25 mm^2"
    table = result.table()
    assert table.rows[0] == {"metric": "psnr", "unit": "dB", "test": 30.75, "rotation": 20.0}
    assert list(table.notes) == ["not shown: lpips: no weights"]
    assert "test (2 frames)  rotation (1 frames)" in str(result) == str(table)
    assert result._repr_html_() == table._repr_html_()


def test_facts_tell_what_was_measured():
    told = facts(made_result())
    assert told["key"] == "0123456789abcdef" and told["training"] == "1 min 12 s" and told["gaussians"] == "1,234"
    assert "processor time" not in told, "it was not measured"
