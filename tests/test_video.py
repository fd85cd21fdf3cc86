"""Frames of a video: sharp ones, apart from each other, turned as players show them."""

from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scipy.ndimage import gaussian_filter

import a2tg_jax as a2tg
from a2tg_jax.data.video import _as_shown, _display_matrix, choose_frames, extract_frames, motion


def test_the_sharpest_of_each_interval_is_chosen():
    sharpness = np.array([1.0, 9, 2, 3, 8, 1, 5, 1, 1, 7])
    np.testing.assert_array_equal(choose_frames(sharpness, np.arange(10.0), 3), [1, 4, 9])
    assert len(choose_frames(sharpness, np.arange(10.0), 99)) == 10


def test_a_camera_that_stands_still_gives_one_frame():
    places = np.array([0.0, 1, 1, 1, 1, 1, 1, 2, 3])
    np.testing.assert_array_equal(choose_frames(np.arange(9.0), places, 4), [0, 6, 7, 8])
    np.testing.assert_array_equal(choose_frames(np.arange(3.0), np.zeros(3), 5), [2])


@pytest.mark.parametrize("shift", [0.0, 0.5, 1.0, 2.0])
def test_motion_is_measured_in_widths(shift):
    wide = gaussian_filter(np.random.default_rng(0).uniform(0, 255, (72, 140)), 4) * 4
    x = np.arange(128)
    moved = np.stack([np.interp(x + shift, np.arange(140), row) for row in wide])
    assert motion(wide[:, :128], moved) == pytest.approx(shift / 128 / 2, rel=0.35, abs=1e-9)


WIDTH, HEIGHT = 96, 64


def encode(path, frames, *, codec="mpeg4", still=None, aspect=1):
    """Writes grey frames [HEIGHT, WIDTH] as a video; `still` is the disposition of a larger picture in a stream before
    it, `aspect` the ratio of the sides of its pixels."""
    av = pytest.importorskip("av", reason="the extra [video] is not installed")
    with av.open(f"file:{path}", "w") as container:
        if still is not None:
            cover = container.add_stream("mjpeg", rate=1)
            cover.width = 640
            cover.height = 480
            cover.pix_fmt = "yuvj420p"
            cover.disposition = still
        stream = container.add_stream(codec, rate=25)
        stream.width = WIDTH
        stream.height = HEIGHT
        stream.pix_fmt = "yuv420p"
        stream.bit_rate = 4_000_000
        stream.codec_context.sample_aspect_ratio = Fraction(aspect)
        if still is not None:
            black = av.VideoFrame.from_ndarray(np.zeros((480, 640, 3), np.uint8), format="rgb24")
            container.mux([*cover.encode(black), *cover.encode()])
        for grey in frames:
            frame = av.VideoFrame.from_ndarray(np.repeat(grey.astype(np.uint8)[..., None], 3, -1), format="rgb24")
            container.mux(stream.encode(frame))
        container.mux(stream.encode())


def write_video(path):
    """A pattern that moves, stands still for ten frames, and moves; every third frame is blurred."""
    wide = np.kron(np.random.default_rng(0).integers(0, 255, (16, 60)), np.ones((4, 4)))
    places = [*range(0, 40, 2), *[40] * 10, *range(40, 80, 2)]
    frames = [gaussian_filter(wide[:, at : at + WIDTH], 2 * (n % 3 == 1)) for n, at in enumerate(places)]
    encode(path, frames)
    return places


def test_sharp_frames_apart_from_each_other_are_written(tmp_path):
    places = write_video(tmp_path / "clip.mp4")
    assert extract_frames(tmp_path / "clip.mp4", tmp_path / "frames", 12, progress=False) == (12, len(places))
    numbers = [int(file.stem) for file in sorted((tmp_path / "frames").iterdir())]
    assert not any(number % 3 == 1 for number in numbers), "blurred"
    at = [places[number] for number in numbers]
    assert at.count(40) <= 2 and len(set(at)) >= 11 and max(np.diff(at)) <= 14


QUADRANTS = {(-1, -1): 20, (1, -1): 90, (-1, 1): 160, (1, 1): 235}
"""Grey levels by direction (right, down) from the middle of the stored picture."""
MATRICES = [(1, 0, 0, 1), (0, 1, -1, 0), (-1, 0, 0, -1), (0, -1, 1, 0)]
MATRICES += [(-a, b, -c, d) for a, b, c, d in MATRICES]
"""(a, b, c, d): turns by 0 to 270 degrees clockwise, and the same in a mirror."""


@pytest.mark.parametrize("matrix", MATRICES)
def test_frames_are_turned_and_mirrored_as_players_show_them(tmp_path, matrix):
    """The track header's matrix (ISO 14496-12) shows (x, y) at (a x + c y, b x + d y)."""
    a, b, c, d = matrix
    top, bottom = ([QUADRANTS[side, down] for side in (-1, 1)] for down in (-1, 1))
    encode(tmp_path / "clip.mp4", [np.kron([top, bottom], np.ones((HEIGHT // 2, WIDTH // 2)))] * 3)
    data = bytearray((tmp_path / "clip.mp4").read_bytes())
    at = data.index(b"tkhd") + 4 + 40
    for place, value in ((0, a), (4, b), (12, c), (16, d)):
        data[at + place : at + place + 4] = (value * 65536).to_bytes(4, "big", signed=True)
    (tmp_path / "clip.mp4").write_bytes(bytes(data))
    extract_frames(tmp_path / "clip.mp4", tmp_path / "frames", 3, progress=False)
    pixels = np.asarray(Image.open(min((tmp_path / "frames").iterdir())))[..., 0]
    height, width = pixels.shape
    assert (width, height) == ((WIDTH, HEIGHT) if a else (HEIGHT, WIDTH))
    for (x, y), grey in QUADRANTS.items():
        right = a * x + c * y
        down = b * x + d * y
        assert abs(int(pixels[height * (2 + down) // 4, width * (2 + right) // 4]) - grey) < 8


@pytest.mark.parametrize("is_turned", [False, True])
@pytest.mark.parametrize(("aspect", "size"), [("3/2", (144, 64)), ("3/4", (96, 85)), ("1/1", (96, 64))])
def test_frames_have_square_pixels(tmp_path, aspect, size, is_turned):
    """The shorter side of the pixels is stretched, before a turn: the square of light stays where its share is."""
    grey = np.zeros((HEIGHT, WIDTH))
    grey[HEIGHT // 2 :, : WIDTH // 4] = 255
    encode(tmp_path / "clip.mp4", [grey] * 3, aspect=aspect)
    if is_turned:
        data = bytearray((tmp_path / "clip.mp4").read_bytes())
        at = data.index(b"tkhd") + 4 + 40
        for place, value in ((0, 0), (4, 1), (12, -1), (16, 0)):
            data[at + place : at + place + 4] = (value * 65536).to_bytes(4, "big", signed=True)
        (tmp_path / "clip.mp4").write_bytes(bytes(data))
    extract_frames(tmp_path / "clip.mp4", tmp_path / "frames", 3, progress=False)
    pixels = np.asarray(Image.open(min((tmp_path / "frames").iterdir())))[..., 0]
    stored = np.rot90(pixels) if is_turned else pixels  # It was turned clockwise.
    assert stored.shape[::-1] == size
    lit = np.argwhere(stored > 128)
    np.testing.assert_allclose(lit.min(axis=0), [size[1] / 2, 0], atol=2)
    np.testing.assert_allclose(lit.max(axis=0), [size[1], size[0] / 4], atol=2)


class FrameOfNewerKind:
    """A frame with side data that this PyAV does not know."""

    rotation = 90

    @property
    def side_data(self):
        raise ValueError("34 is not a valid Type")


def test_frames_with_unknown_side_data_are_turned():
    """By 90 degrees counterclockwise the right edge comes to the top."""
    shown = _as_shown(np.array([[[1], [2], [3]], [[4], [5], [6]]]), _display_matrix(FrameOfNewerKind()))
    np.testing.assert_array_equal(shown[..., 0], [[3, 6], [2, 5], [1, 4]])


@pytest.mark.parametrize("suffix", ["mp4", "mkv"])
@pytest.mark.parametrize("still", [0, 1 << 10])
def test_a_picture_beside_the_video_is_not_taken_for_it(tmp_path, suffix, still):
    """A cover, or a stream of one frame, which Matroska does not mark."""
    frames = np.random.default_rng(0).integers(0, 255, (30, HEIGHT, WIDTH))
    encode(tmp_path / f"clip.{suffix}", frames, still=still)
    assert extract_frames(tmp_path / f"clip.{suffix}", tmp_path / "frames", 9, progress=False)[1] == 30
    assert {Image.open(file).size for file in (tmp_path / "frames").iterdir()} == {(WIDTH, HEIGHT)}


def test_of_several_videos_the_largest_is_read_with_a_warning(tmp_path):
    av = pytest.importorskip("av", reason="the extra [video] is not installed")
    with av.open(str(tmp_path / "clip.mp4"), "w") as container:
        streams = [container.add_stream("mpeg4", rate=25) for _ in range(3)]
        for stream, side in zip(streams, (32, 64, 48), strict=True):
            stream.width = side
            stream.height = side
            stream.pix_fmt = "yuv420p"
        for stream in streams * 12:
            pixels = np.zeros((stream.height, stream.width, 3), np.uint8)
            container.mux(stream.encode(av.VideoFrame.from_ndarray(pixels, format="rgb24")))
        for stream in streams:
            container.mux(stream.encode())
    with pytest.warns(UserWarning, match=r"video streams 0 \(32x32\), 1 \(64x64\), 2 \(48x48\); 1 is read.* -map 0:"):
        extract_frames(tmp_path / "clip.mp4", tmp_path / "frames", 3, progress=False)
    assert {Image.open(file).size for file in (tmp_path / "frames").iterdir()} == {(64, 64)}


def test_an_interlaced_video_is_read_with_advice(tmp_path):
    av = pytest.importorskip("av", reason="the extra [video] is not installed")
    with av.open(str(tmp_path / "0001.mts"), "w", format="mpegts") as container:
        stream = container.add_stream("mpeg2video", rate=25, options={"flags": "+ildct+ilme"})
        stream.width = WIDTH
        stream.height = HEIGHT
        stream.pix_fmt = "yuv420p"
        for grey in np.random.default_rng(0).integers(0, 255, (5, HEIGHT, WIDTH, 1)):
            frame = av.VideoFrame.from_ndarray(np.repeat(grey.astype(np.uint8), 3, -1), format="rgb24")
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    with pytest.warns(UserWarning, match=r"0001\.mts: is interlaced.* -vf bwdif converted\.mp4"):
        extract_frames(tmp_path / "0001.mts", tmp_path / "frames", 3, progress=False)


@pytest.mark.parametrize(
    ("name", "codec"),
    [
        ("2026-05-01T12:30:00.mp4", "mpeg4"), ("100%.mp4", "mpeg4"), ("0001.mts", "mpeg4"), ("0001.M2TS", "mpeg4"),
        ("a.ts", "mpeg4"), ("a.mpg", "mpeg2video"), ("a.vob", "mpeg2video"), ("a.3gp", "mpeg4"), ("a.wmv", "wmv2"),
        ("a.flv", "flv"),
    ],
)  # fmt: skip
def test_videos_of_other_names_are_read(tmp_path, monkeypatch, name, codec):
    encode(tmp_path / name, np.random.default_rng(0).integers(0, 255, (12, HEIGHT, WIDTH)), codec=codec)
    monkeypatch.chdir(tmp_path)
    assert extract_frames(Path(name), Path("frames"), 3, progress=False)[1] == 12


@pytest.mark.parametrize("data", [b"", bytes(4000)])
@pytest.mark.parametrize("suffix", ["mts", "M2TS", "ts", "mpg", "vob", "3gp", "wmv", "flv"])
def test_a_damaged_video_of_any_name_comes_with_advice(tmp_path, suffix, data):
    pytest.importorskip("av", reason="the extra [video] is not installed")
    (tmp_path / f"clip.{suffix}").write_bytes(data)
    reason = "" if data else "it is empty: 0 bytes"
    with pytest.raises(
        ValueError, match=rf"cannot be read as a video \({reason}.*\); convert it: ffmpeg -i .* converted"
    ):
        a2tg.run_sfm(tmp_path / f"clip.{suffix}", tmp_path / "scene", progress=False)


def test_a_video_in_an_unknown_codec_is_named(tmp_path):
    """FFmpeg lists its stream, which has no size."""
    encode(tmp_path / "a.avi", [np.zeros((HEIGHT, WIDTH))] * 2)
    data = (tmp_path / "a.avi").read_bytes()
    (tmp_path / "a.avi").write_bytes(data.replace(b"FMP4", b"ZZZZ"))
    with pytest.raises(ValueError, match=r"a\.avi: has no video stream that can be decoded; convert it: ffmpeg"):
        extract_frames(tmp_path / "a.avi", tmp_path / "frames", 5, progress=False)


def test_what_is_no_video_is_named(tmp_path):
    pytest.importorskip("av", reason="the extra [video] is not installed")
    write_video(tmp_path / "other.mp4")
    for text in ("no video", "ffconcat version 1.0\nfile other.mp4\n"):
        (tmp_path / "clip.mp4").write_text(text)
        with pytest.raises(ValueError, match=r"clip\.mp4: cannot be read as a video"):
            extract_frames(tmp_path / "clip.mp4", tmp_path / "frames", 3)


def test_without_the_extra_the_command_is_reported(tmp_path, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "av", None)
    with pytest.raises(
        ValueError, match=r"a video needs PyAV, which is not installed: pip install 'a2tg-jax\[video\]'"
    ):
        extract_frames(tmp_path / "clip.mp4", tmp_path / "frames", 3)
