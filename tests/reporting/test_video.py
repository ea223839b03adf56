import av
import numpy as np
import pytest
import torch

from coliags_plugin.core.errors import InputError
from coliags_plugin.reporting import video
from coliags_plugin.reporting.video import write_video


def ramp(count, height, width):
    """Frames of one colour each; the red channel counts."""
    return [np.full((height, width, 3), (20 * index, 80, 30), np.uint8) for index in range(count)]


def read_back(path):
    with av.open(f"file:{path}") as file:
        frames = [frame.to_ndarray(format="rgb24") for frame in file.decode(video=0)]
        return float(file.streams.video[0].average_rate), frames


@pytest.mark.parametrize("size", [(48, 64), (47, 63)])
def test_frames_come_back_in_order_and_color_and_odd_sizes_lose_no_line(tmp_path, size):
    frames = ramp(9, *size)
    write_video(map(torch.from_numpy, frames), tmp_path / "run 12:30" / "v.mp4", fps=12.5)
    fps, decoded = read_back(tmp_path / "run 12:30" / "v.mp4")
    assert fps == pytest.approx(12.5, rel=1e-3)
    assert len(decoded) == 9
    for wrote, read in zip(frames, decoded, strict=True):
        assert read.shape == (48, 64, 3)
        assert np.abs(wrote[0, 0].astype(float) - read).mean() < 6
        assert np.abs(read[-1].astype(float) - read[20]).mean() < 6
    assert [file.name for file in (tmp_path / "run 12:30").iterdir()] == ["v.mp4"]


def test_an_existing_video_stays_when_frames_fail(tmp_path):
    path = tmp_path / "v.mp4"
    write_video(ramp(2, 48, 64), path, fps=10)
    before = path.read_bytes()

    def failing():
        yield from ramp(2, 48, 64)
        raise RuntimeError("renderer")

    with pytest.raises(RuntimeError, match="renderer"):
        write_video(failing(), path, fps=10)
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


def test_refusals(tmp_path, monkeypatch):
    frames = ramp(2, 48, 64)
    cases = [
        ("v.avi", frames, 10, "ends in .mp4"),
        ("v.mp4", frames, 0, "frames a second"),
        ("v.mp4", [], 10, "no frames"),
        ("v.mp4", [frames[0], frames[1][:40]], 10, "frame 1 is 64 x 40 px"),
        ("v.mp4", [frames[0] / 255.0], 10, "frame 0 is float64"),
    ]
    for name, images, fps, message in cases:
        with pytest.raises(InputError, match=message):
            write_video(images, tmp_path / name, fps)
    monkeypatch.setattr(video, "_CODEC", "none")
    with pytest.raises(InputError, match="PNG"):
        write_video(frames, tmp_path / "v.mp4", fps=10)
    assert not list(tmp_path.iterdir())
