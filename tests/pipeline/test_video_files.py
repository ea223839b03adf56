"""Video files of all kinds: frames by number, times, shapes, and files that are damaged."""

from __future__ import annotations

import logging
import struct
from fractions import Fraction
from pathlib import Path
from types import SimpleNamespace

import av
import numpy as np
import pytest

from coliags_plugin.cli.scenes import every_of, seconds_of
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.images import write_image
from coliags_plugin.geometry.lenses.models import LENSES
from coliags_plugin.pipeline.frame_sources import Span, chosen_frames, frame_source, one_field, opened_recording
from coliags_plugin.pipeline.settings import FrameSettings
from coliags_plugin.pipeline.survey import Survey, survey_video
from coliags_plugin.pipeline.video_files import VideoFile
from coliags_plugin.reconstruction.structure.sfm_settings import SfmSettings
from coliags_plugin.reporting.video import write_video
from tests.layouts import calibration_text
from tests.pipeline.films import film, number_of, numbered, write_film, write_images

FRAMES = numbered(40)
#: Some frames that depend on those after them, and keys that later frames refer across.
ORDERED = {"g": 8, "bf": 2}
OPEN = ORDERED | {"x264-params": "open-gop=1:scenecut=0"}


WHOLE = Span()


def numbers(path, span=WHOLE):
    """Numbers of frames by their names and by what they show."""
    pairs = [(int(name[-6:]), number_of(image)) for name, image in frame_source(path, span)]
    assert [name for name, _ in pairs] == list(range(span.first, span.first + len(pairs)))
    return [shown for _, shown in pairs]


@pytest.mark.parametrize(
    ("name", "codec", "options"),
    [
        ("a.mp4", "libx264", ORDERED),
        ("a.mp4", "libx264", OPEN),
        ("a.mov", "prores_ks", {"pix_fmt": "yuv422p10le"}),
        ("a.mkv", "libx264", ORDERED),
        ("a.mkv", "ffv1", {"pix_fmt": "yuva444p"}),
        ("a.mkv", "ffv1", {"pix_fmt": "bgra"}),
        ("a.webm", "libvpx-vp9", {"g": 8, "cpu-used": 8}),
        ("a.ts", "libx264", ORDERED),
        ("a.m2ts", "libx264", OPEN),
        ("a.ts", "mpeg2video", ORDERED),
        ("a.mpg", "mpeg2video", ORDERED),
        ("a.vob", "mpeg2video", {**ORDERED, "kind": "vob"}),
        ("a.avi", "mjpeg", {"pix_fmt": "yuvj420p"}),
        ("a.avi", "mjpeg", {"pix_fmt": "yuvj420p", "sound": True}),
        ("a.avi", "mpeg4", ORDERED),
        ("a.mp4", "libx264", ORDERED | {"times": [-120 + 50 * n for n in range(40)]}),
        ("a.mkv", "libx264", ORDERED | {"times": [90_000 + 50 * n for n in range(40)]}),
        ("a.mp4", "libx264", ORDERED | {"muxing": {"movflags": "frag_keyframe+empty_moov"}}),
    ],
)
def test_frame_n_is_what_follows_n_frames(tmp_path, name, codec, options):
    rate = Fraction(30_000, 1001)
    path = write_film(FRAMES, tmp_path / name, codec, rate, **({"b": 4_000_000} if codec[0] == "m" else {}), **options)
    whole = numbers(path)
    assert whole == list(range(40 - len(whole), 40))
    source = frame_source(path)
    assert source.rate == pytest.approx(20 if "times" in options else 30_000 / 1001, rel=1e-4)
    assert not source.is_variable
    assert [source.frame_at(n / source.rate) for n in range(len(whole))] == list(range(len(whole)))
    for first in (1, 3, 7, 8, 13, 17, 31, len(whole) - 1):
        assert numbers(path, Span(first, first + 1)) == whole[first : first + 2]
    assert VideoFile(path)._sought(30)[0] == 30


@pytest.mark.parametrize("kind", ["webm", "matroska", "mpegts", "avi"])
def test_files_that_do_not_state_their_length_are_read_whole(tmp_path, kind):
    codec = {"webm": "libvpx-vp9", "avi": "mjpeg"}.get(kind, "libx264")
    suffix = {"matroska": "mkv", "mpegts": "mpg"}.get(kind, kind)
    for part in range(2):
        path = tmp_path / f"{part}.{suffix}"
        pipe = SimpleNamespace(write=path.open("wb", buffering=0).write)  # cannot be sought: no length is written
        write_film(FRAMES[:24], pipe, codec, 12, kind=kind, pix_fmt="yuvj420p" if codec == "mjpeg" else "yuv420p")
    assert frame_source(path).expected == len(list(frame_source(path))) == 24
    assert numbers(tmp_path) == [*range(24), *range(24)]
    assert numbers(tmp_path, Span(20, 30)) == [*range(20, 24), *range(7)]


def test_a_folder_keeps_the_places_of_frames_that_a_file_lacks(tmp_path, caplog):
    whole = write_film(FRAMES, tmp_path / "2.mp4", muxing={"movflags": "faststart"}, **ORDERED).read_bytes()
    cut = tmp_path / "1.mp4"
    cut.write_bytes(whole[: 4 * len(whole) // 5])
    there = numbers(cut)
    assert there == list(range(len(there))) and 10 < len(there) < 38
    assert f"1.mp4: {len(there)} frames, though its header says 40" in caplog.text
    lacking = [-4] * (40 - len(there))
    for span in (Span(), Span(5), Span(39), Span(39, 41)):
        assert numbers(tmp_path, span) == [*there, *lacking, *range(40)][span.first :][: span.count(80)]


def test_images_are_frames_in_the_order_of_their_numbers(tmp_path):
    frames = film(range(0, 120, 3))
    folder = write_images(tmp_path, frames)
    for first, last in ((0, None), (0, 5), (1, 1), (17, 30), (38, 99), (5, None)):
        source, numbers = frame_source(folder, Span(first, last)), range(40)[first : None if last is None else last + 1]
        read = list(source)
        assert [name for name, _ in read] == [str(number) for number in numbers] and source.expected == len(read)
        assert all(np.array_equal(image, frames[number]) for (_, image), number in zip(read, numbers, strict=True))
    with pytest.raises(InputError, match=r"does not tell how many frames a second.*frames.first"):
        source.frame_at(200.0)


def test_what_cannot_be_read_is_refused(tmp_path):
    frames = film([0, 5])
    (tmp_path / "noise.mp4").write_bytes(np.random.default_rng(0).bytes(5000))
    write_image(tmp_path / "one.png", frames[0])
    (tmp_path / "empty").mkdir()
    write_images(tmp_path / "two", [frames[0], frames[1][:100]])
    write_video(film(range(0, 30, 3)), tmp_path / "film.mp4", 15.0)
    for name, first, message in (
        ("noise.mp4", 0, r"noise.mp4 \(5000 bytes\) cannot be opened as a video.*Make images with ffmpeg"),
        ("one.png", 0, "is a single image"),
        ("missing.mp4", 0, "no .*missing.mp4. Expected a video file, or a folder of images"),
        ("empty", 0, "empty holds 0 images"),
        ("two", 0, r"1.png is 160 x 100 at 1, what is before 160 x 120. Expected frames of one size"),
        ("film.mp4", 50, r"film.mp4 has no frame 50. Expected one of about 10 frames"),
    ):
        with pytest.raises(InputError, match=message):
            list(frame_source(tmp_path / name, Span(first)))


def test_times_are_written_as_seconds_minutes_and_hours(tmp_path):
    write_video(film(range(3)), tmp_path / "film.mp4", 15.0)
    source = frame_source(tmp_path / "film.mp4")
    for text, frame in (("0", 0), ("3:20", 3000), ("1:00:00.2", 54003), ("0.4", 6)):
        assert source.frame_at(seconds_of(text)) == frame
    for text in ("", "3:x", "-1", "1:2:3:4"):
        with pytest.raises(InputError, match="seconds, or hours, minutes and seconds"):
            seconds_of(text)


@pytest.mark.parametrize(
    ("rate", "target", "every"),
    [(50.0, 10.0, 5), (60.0, 24.0, 2), (59.94, 15.0, 4), (15.0, 30.0, 1), (15.0, 0.5, 30)],
)
def test_of_how_many_frames_one_is_used(rate, target, every, caplog):
    with caplog.at_level(logging.INFO):
        assert every_of(SimpleNamespace(path="film.mp4", known_rate=rate, is_variable=False), target) == every
    assert f"{rate:.4g} frames a second" in caplog.text and f"every {every} is used" in caplog.text


@pytest.mark.thorough
def test_a_damaged_stretch_is_black_and_the_rest_is_read(tmp_path, caplog):
    generator = np.random.default_rng(0)
    images = [
        np.clip(image + generator.normal(0, 12, image.shape), 0, 255).astype(np.uint8) for image in film(range(150))
    ]
    write_video(images, tmp_path / "film.mp4", 15.0)
    whole = list(frame_source(tmp_path / "film.mp4"))
    data = bytearray((tmp_path / "film.mp4").read_bytes())
    data[len(data) // 3 : len(data) // 2] = generator.bytes(len(data) // 2 - len(data) // 3)
    (tmp_path / "damaged.mp4").write_bytes(data)
    read = list(frame_source(tmp_path / "damaged.mp4"))
    assert [name for name, _ in read] == [name for name, _ in whole]
    black = [index for index, (_, image) in enumerate(read) if not image.any()]
    assert 10 < len(black) < 100 and "cannot be decoded: black here" in caplog.text
    assert all(np.array_equal(read[index][1], whole[index][1]) for index in (0, 20, 149))
    for first in (0, black[0] - 2, *black[:2], black[-1] - 1, black[-1], black[-1] + 1, 140):
        for last in (first, first + 3, black[-1], black[-1] + 2):
            if first <= last:
                some = list(frame_source(tmp_path / "damaged.mp4", Span(first, last)))
                assert [name for name, _ in some] == [name for name, _ in read[first : last + 1]]
                assert all(np.array_equal(image, read[first + n][1]) for n, (_, image) in enumerate(some))


def test_the_videos_of_a_folder_are_one_in_the_order_of_their_numbers(tmp_path):
    for part, numbers_of in ((2, range(15, 25)), (10, range(25, 40)), (1, range(15))):
        write_film([FRAMES[number] for number in numbers_of], tmp_path / f"part {part}.mp4", **ORDERED)
    assert frame_source(tmp_path).expected == 40
    for span in (Span(), Span(0, 10), Span(12, 30), Span(15, 15), Span(33)):
        assert numbers(tmp_path, span) == list(range(40)[span.first : None if span.last is None else span.last + 1])
    write_film(numbered(3, 24, 64), tmp_path / "part 11.mp4")
    with pytest.raises(InputError, match=r"part 11.mp4 is 64 x 24 at frame_000040, what is before 64 x 48"):
        list(frame_source(tmp_path))


def test_what_comes_before_the_first_key_frame_is_no_frame(tmp_path):
    whole = write_film(FRAMES, tmp_path / "whole.ts", **OPEN)
    with av.open(str(whole)) as file:
        places = [packet.pos for packet in file.demux(video=0) if packet.is_keyframe]
    data = whole.read_bytes()
    (tmp_path / "cut.ts").write_bytes(data[: 2 * 188] + data[places[1] + 188 * 3 :])
    shown = [number_of(image) for _, image in frame_source(tmp_path / "cut.ts")]
    assert shown == list(range(shown[0], 40)) and shown[0] in range(8, 17)
    assert [number_of(image) for _, image in frame_source(tmp_path / "cut.ts", Span(9))] == shown[9:]


def test_an_edit_list_says_which_frames_are_shown(tmp_path):
    """The list begins at frame 10, for a second: decoding begins before it."""
    data = bytearray(write_film(FRAMES, tmp_path / "a.mp4", rate=25, **ORDERED).read_bytes())
    place = data.index(b"elst") + 12
    length, start = struct.unpack_from(">Ii", data, place)
    assert length == 1600
    struct.pack_into(">Ii", data, place, 1000, start + 10 * 512)
    (tmp_path / "a.mp4").write_bytes(data)
    source = frame_source(tmp_path / "a.mp4")
    assert [number_of(image) for _, image in source] == list(range(10, 35))
    assert source.expected == 25 and source.frame_at(0.4) == 10
    for first in (1, 6, 13, 24):
        assert number_of(next(iter(frame_source(source.path, Span(first))))[1]) == 10 + first


@pytest.mark.parametrize("name", ["a.ts", "a.mkv", "a.avi"])
def test_frames_that_a_file_lacks_are_told(tmp_path, name, caplog):
    """Cut out of the middle of a stream, and off the end of files whose header has the length."""
    codec = {"codec": "mjpeg", "pix_fmt": "yuvj420p"} if name == "a.avi" else {"g": 1}
    path = write_film(FRAMES, tmp_path / name, **codec)
    data = path.read_bytes()
    step = len(data) // 188 // 4 * 188
    path.write_bytes(data[:step] + data[2 * step :] if name == "a.ts" else data[: 2 * step])
    count = len(list(frame_source(path)))
    warning = "there is time for 40" if name == "a.ts" else "its header says 40"
    assert 15 < count < 38 and f"{name}: {count} frames, though {warning}" in caplog.text


def test_colours_that_cannot_be_converted_are_refused(tmp_path):
    path = write_film(FRAMES[:2], tmp_path / "a.mkv", pix_fmt="yuv444p", colorspace=8)
    with pytest.raises(InputError, match=r"a.mkv: FFmpeg does not convert yuv444p with the colour matrix 8"):
        list(frame_source(path))


@pytest.mark.parametrize(
    ("name", "codec", "options"),
    [
        ("a.mp4", "libx264", {"x264-params": "tff=1"}),
        ("a.ts", "libx264", {"x264-params": "bff=1"}),
        ("a.mpg", "mpeg2video", {"flags": "+ildct+ilme", "b": 4_000_000}),
    ],
)
def test_flagged_frames_are_decoded_and_deinterlaced(tmp_path, name, codec, options):
    """The picture does not look interlaced."""
    path = write_film(FRAMES[:12], tmp_path / name, codec, 25, **options)
    plain = list(frame_source(path))
    assert [number_of(image) for _, image in plain] == list(range(12))
    read = chosen_frames(path, FrameSettings())
    assert read.span.deinterlace
    for (_, image), (_, stored) in zip(read, plain, strict=True):
        np.testing.assert_array_equal(image, one_field(stored))
    assert not chosen_frames(path, FrameSettings(deinterlace=False)).span.deinterlace


def test_paths_are_no_addresses_and_no_patterns(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    data = write_film(FRAMES[:5], tmp_path / "plain.mp4").read_bytes()
    for name in ("12:30:05.mp4", "http:.mp4", "a%20 100%.mp4", "%03d.mp4", "Fälle #1?.mp4", "pipe:/1 [x].mp4"):
        path = Path(name)
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(data)
        assert numbers(path) == numbers(path.absolute()) == list(range(5))
    assert numbers(Path("pipe:")) == list(range(5))


#: Ten frames in 0.4 s, a second without any, ten more that come half as fast.
VARIABLE = [40 * n for n in range(10)] + [1400 + 80 * n for n in range(10)]


@pytest.mark.parametrize("name", ["a.mp4", "a.mkv", "a.webm"])
def test_times_are_those_of_the_frames(tmp_path, name, caplog):
    codec = {"codec": "libvpx-vp9", "cpu-used": 8} if name == "a.webm" else ORDERED
    source = frame_source(write_film(FRAMES[:20], tmp_path / name, times=VARIABLE, **codec))
    np.testing.assert_allclose(source.times, np.array(VARIABLE) / 1000, atol=1e-9)
    assert source.is_variable and source.rate == pytest.approx(19 / 2.12) and numbers(source.path) == list(range(20))
    for seconds, frame in ((0, 0), (0.2, 5), (0.359, 9), (1.2, 9), (1.4, 10), (1.75, 14), (2.12, 19)):
        assert source.frame_at(seconds) == frame
    with caplog.at_level("INFO"):
        assert every_of(source, 3.0) == 3
    assert "variable rate" in caplog.text and "every 1/3 s" in caplog.text
    survey = survey_video(frame_source(source.path, Span(5)))
    survey.write(tmp_path)
    np.testing.assert_array_equal(Survey.read(tmp_path).part(7, 12).times, source.times[7:13])


def test_files_of_a_folder_may_have_other_rates(tmp_path):
    for part, rate in enumerate((10, 20)):
        write_film(FRAMES[:20], tmp_path / f"{part}.mp4", rate=rate)
    source = frame_source(tmp_path)
    np.testing.assert_allclose(source.times, [*np.arange(20) / 10, *(2.0 + np.arange(20) / 20)], atol=1e-9)
    assert source.is_variable and source.rate == pytest.approx(39 / 2.95) and source.frame_at(2.5) == 30


QUADRANTS = np.zeros((48, 64, 3), np.uint8)
QUADRANTS[:24, :32], QUADRANTS[:24, 32:], QUADRANTS[24:, :32] = (240, 40, 40), (40, 240, 40), (40, 40, 240)


@pytest.mark.parametrize("aspect", ["1", "16/15", "8/9", "4/3"])
@pytest.mark.parametrize("turn", [None, (90,), (-90,), (180,), (0, True), (0, False, True), (90, True)])
def test_pixels_are_square_and_images_turned_as_the_file_says(tmp_path, aspect, turn, caplog):
    path = write_film([QUADRANTS] * 3, tmp_path / "a.mov", aspect=aspect, turn=turn, pix_fmt="yuv444p")
    (_, image), *_ = frame_source(path)
    width = round(64 * Fraction(aspect))
    stored = np.repeat(QUADRANTS, width, axis=1)[:, 32::64]
    angle, *mirrored = (turn or (0,)) + (False, False)
    right = np.rot90(stored, angle // 90)
    right = right[:: -1 if mirrored[1] else 1, :: -1 if mirrored[0] else 1]
    assert image.shape == right.shape
    assert np.median(np.abs(image.astype(int) - right)) <= 3 and np.mean(np.abs(image.astype(int) - right)) < 8
    warning = f"a.mov has pixels that are not square ({aspect}) and is read as {width} x 48"
    assert caplog.text.count("not square") == (width != 64) and (width == 64 or warning in caplog.text)


@pytest.mark.parametrize("stored", [True, False])
def test_a_calibration_is_of_pixels_as_they_are_stored_or_square(tmp_path, stored):
    lens = LENSES["fisheye"].resized(64 if stored else 80, 48)
    write_film(FRAMES[:2], tmp_path / "a.mp4", aspect="5/4")
    (tmp_path / "a.xml").write_text(calibration_text(lens))
    camera = opened_recording(tmp_path, SfmSettings())[1].camera
    assert camera.model == "OPENCV_FISHEYE"
    pinhole = LENSES["fisheye"].resized(80, 48).pinhole
    np.testing.assert_allclose(camera.params[:4], (pinhole.fx, pinhole.fy, pinhole.cx, pinhole.cy), rtol=1e-6)


def test_which_of_several_streams_is_used(tmp_path, caplog):
    small = numbered(12, 24, 32)
    two = write_film(FRAMES[:12], tmp_path / "two.mkv", second=small[::-1])
    assert numbers(two) == list(range(12))
    assert "two.mkv has 2 video streams: number 0 is used, of 64 x 48" in caplog.text


@pytest.mark.parametrize(
    ("name", "codecs"), [("a.mkv", ["aac"]), ("a.mp4", ["aac", "mjpeg"]), ("a.mp4", ["mjpeg", "aac", "libx264"])]
)
def test_sound_and_cover_pictures_are_no_video(tmp_path, name, codecs, caplog):
    with av.open(str(tmp_path / name), "w") as file:
        streams = {}
        for codec in codecs:
            if codec == "aac":
                streams[codec] = file.add_stream(codec, 8000, layout="mono")
                continue
            streams[codec] = stream = file.add_stream(codec, 20)
            stream.height, stream.width, stream.pix_fmt = 48, 64, "yuvj420p" if codec == "mjpeg" else "yuv420p"
            stream.disposition = av.stream.Disposition.attached_pic if codec == "mjpeg" else 0
        for codec, stream in streams.items():
            frame = av.AudioFrame.from_ndarray(np.zeros((1, 1024), np.float32), format="fltp", layout="mono")
            frame.sample_rate = 8000
            picture = av.VideoFrame.from_ndarray(FRAMES[codec == "libx264"], format="rgb24")
            file.mux([*stream.encode(frame if codec == "aac" else picture), *stream.encode(None)])
    if "libx264" in codecs:
        assert [number_of(image) for _, image in frame_source(tmp_path / name)] == [1] and not caplog.records
    else:
        with pytest.raises(InputError, match=r"has no video among its streams \((audio|audio, video)\)"):
            frame_source(tmp_path / name)


@pytest.mark.parametrize(
    ("codec", "pix_fmt", "options"),
    [
        ("ffv1", "gray", {}),
        ("libx264", "yuvj444p", {"qp": 1}),
        ("libx265", "yuv420p10le", {"x265-params": "lossless=1:log-level=none"}),
    ],
)
def test_pixel_formats(tmp_path, codec, pix_fmt, options):
    frames = [np.full((48, 64, 3), 20 + 20 * n, np.uint8) for n in range(11)]
    path = write_film(frames, tmp_path / "a.mkv", codec, pix_fmt=pix_fmt, **options)
    for (_, image), frame in zip(frame_source(path), frames, strict=True):
        np.testing.assert_allclose(image.astype(int), frame, atol=3)


@pytest.mark.parametrize(("codec", "name"), [("libvpx", "a.webm"), ("mpeg4", "a.avi")])
def test_packets_that_show_nothing_are_no_frames(tmp_path, codec, name):
    """A flag that VP8 clears; and in MPEG-4 a header of a type, time (5 bits) and no content."""
    path = write_film(FRAMES, tmp_path / f"whole-{name}", codec, 25, g=20, bf=0, b=4_000_000)
    with av.open(str(path)) as file, av.open(str(tmp_path / name), "w") as out:
        stream = file.streams.video[0]
        copied = out.add_stream_from_template(stream)
        for number, packet in enumerate(packet for packet in file.demux(stream) if packet.size):
            data = bytes(packet)
            if number in (26, 27) and codec == "libvpx":
                data = bytes([data[0] & ~0x10]) + data[1:]
            elif number in (26, 27):
                data = b"\0\0\1\xb6" + (0b0101_0000_0100_1111 | (number - 25) << 7).to_bytes(2, "big")
            copied_packet = av.Packet(data)
            copied_packet.pts, copied_packet.dts, copied_packet.time_base = packet.pts, packet.dts, packet.time_base
            copied_packet.is_keyframe, copied_packet.stream = packet.is_keyframe, copied
            out.mux(copied_packet)
    whole = [image for _, image in frame_source(tmp_path / name)]
    assert len(whole) == VideoFile(tmp_path / name).count == 38
    for first in (24, 25, 30, 37):
        np.testing.assert_array_equal(next(iter(frame_source(tmp_path / name, Span(first))))[1], whole[first])


def test_a_video_of_one_frame(tmp_path):
    path = write_film(FRAMES[7:8], tmp_path / "one.mp4")
    for source in (frame_source(path), frame_source(tmp_path)):
        assert [number_of(image) for _, image in source] == [7]
        assert (source.expected, source.rate, source.is_variable) == (1, 20.0, False)
