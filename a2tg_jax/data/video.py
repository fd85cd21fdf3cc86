"""Photographs from a video: sharp, well-spaced frames, turned and stretched to square pixels as players show them.

A first pass scores small greyscale frames, a second one writes the chosen ones.
"""

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from scipy.ndimage import laplace

from a2tg_jax.base.regular_files import open_regular
from a2tg_jax.base.user_warnings import warn
from a2tg_jax.data.decoding import MAX_PIXELS
from a2tg_jax.host.errors import as_argument
from a2tg_jax.host.optional import optional
from a2tg_jax.host.progress_bars import counting

SHARPNESS_WIDTH = 640
MOTION_WIDTH = 128
"""Widths in pixels of the greyscale frames on which sharpness and motion are measured."""
LEAST_MOTION = 0.005
"""Motion between two frames, as a share of the width, below which the camera counts as still."""
ONLY_VIDEOS = {"format_whitelist": "mov,matroska,webm,avi,mpegts,mpeg,asf,flv,ogg", "protocol_whitelist": "file"}
"""Options that keep FFmpeg from playlists, which name further files and addresses."""
STILLS = 1 << 10 | 1 << 11 | 1 << 20
"""FFmpeg's dispositions of streams that are pictures, such as a cover: attached_pic, timed_thumbnails, still_image."""
ENOUGH_FRAMES = 10
"""Number of frames of one stream by which another one has its second, or is a picture."""
QUALITY = 95


def extract_frames(video: Path, folder: Path, count: int, *, progress: bool = True) -> tuple[int, int]:
    """Write the frames of a video that suit structure from motion as JPEG files, named by their number.

    Of several videos in a file, the largest picture is read, with a warning. Another warning names interlaced frames.

    Args:
      video: file in a usual format of videos.
      folder: new folder for the frames.
      count: largest number of frames to write.
      progress: show progress bars.

    Returns:
      (number written, number of frames of the video).
    """
    stream, size = _chosen_stream(video)
    scores = []
    places = []
    path = 0.0
    seen = None  # The last frame that moved, so that slow motion adds up.
    is_interlaced = False
    for frame in _frames(video, stream, "scoring frames", progress):
        is_interlaced |= bool(frame.interlaced_frame)
        scores.append(sharpness(_grey(frame, SHARPNESS_WIDTH)))
        small = _grey(frame, MOTION_WIDTH)
        moved = LEAST_MOTION if seen is None else motion(seen, small)
        if moved >= LEAST_MOTION:
            seen = small
            path += moved
        places.append(path)
    if not places:
        raise ValueError(f"{video}: has no frames that can be decoded; {_conversion(video)}")
    if is_interlaced:
        advice = _conversion(video, "-vf bwdif")
        warn(f"{video}: is interlaced, so that moving edges look like combs; {advice}")
    chosen = set(choose_frames(np.array(scores), np.array(places), count).tolist())
    folder.mkdir(parents=True)
    # Decoded again, because all frames would not fit into memory.
    for number, frame in enumerate(_frames(video, stream, "writing frames", progress)):
        if number in chosen:
            matrix = _display_matrix(frame)  # A frame of another size has none.
            if (frame.width, frame.height) != size:
                frame = frame.reformat(*size, format="rgb24", interpolation="BICUBIC")
            pixels = _as_shown(frame.to_ndarray(format="rgb24"), matrix)
            Image.fromarray(np.ascontiguousarray(pixels)).save(folder / f"{number:06d}.jpg", quality=QUALITY)
    return len(chosen), len(places)


def sharpness(grey: np.ndarray) -> float:
    """Return the sharpness of a small greyscale picture [h, w], the variance of its Laplacian."""
    return float(laplace(grey.astype(np.float32)).var())


def choose_frames(sharpness: np.ndarray, places: np.ndarray, count: int) -> np.ndarray:
    """Return the sorted numbers of the frames to keep: the sharpest of each of `count` intervals of equal length.

    An interval that the camera jumped over has none.

    Args:
      sharpness: [T] score of each frame.
      places: [T] length of the camera path up to each frame, constant while the camera is still.
      count: number of intervals, at least 1.
    """
    way = places - places[0]
    # The last frame is in the last interval. 1e-12 is for a camera that stands still.
    interval = np.minimum((way * (count / max(way[-1], 1e-12))).astype(int), count - 1)
    order = np.lexsort((-sharpness, interval))  # By interval, the sharpest first.
    is_first = np.diff(interval[order], prepend=-1) > 0
    return np.sort(order[is_first])


def motion(before: np.ndarray, after: np.ndarray) -> float:
    """Return how far the picture moved between two small greyscale frames [h, w], as a share of the width.

    The change of brightness over time divided by its change over space is the speed along the gradient. Beyond a few
    pixels it saturates, at a value that is large enough.
    """
    before = before.astype(np.float32)
    after = after.astype(np.float32)
    slope = sum(float(np.abs(part).mean()) for part in np.gradient(before))
    # Blank frames have no slope.
    return float(np.abs(after - before).mean() / max(slope, 1.0) / before.shape[1])


@contextmanager
def _opened(video: Path) -> Iterator[Any]:
    """Open a video within the block, in which errors of FFmpeg become one ValueError."""
    av = optional("av", "a video needs PyAV", "video")
    open_regular(video, sys.maxsize).close()
    try:
        # Without file: FFmpeg would take what is before a colon, as in 12:30.mp4, for a protocol.
        with av.open(f"file:{video}", options=ONLY_VIDEOS) as container:
            yield container
    except av.FFmpegError as error:
        reason = error.strerror if video.stat().st_size else "it is empty: 0 bytes"
        raise ValueError(f"{video}: cannot be read as a video ({reason}); {_conversion(video)}") from None


def _conversion(video: Path, options: str = "") -> str:
    """Return the advice to convert a video with ffmpeg."""
    return f"convert it: ffmpeg -i {as_argument(video)} {options and options + ' '}converted.mp4"


def _chosen_stream(video: Path) -> tuple[int, tuple[int, int]]:
    """Return the index of the largest stream that is no single picture, such as a cover, and (width, height) of its
    frames with square pixels."""
    with _opened(video) as container:
        # A stream without a codec is one that FFmpeg cannot decode.
        known = [stream for stream in container.streams.video if stream.codec_context is not None]
        streams = [stream for stream in known if not stream.disposition & STILLS]
        if len(streams) > 1:
            counts = {stream.index: 0 for stream in streams}
            for packet in container.demux(streams):
                counts[packet.stream.index] += packet.size > 0  # The last ones are empty.
                if max(counts.values()) == ENOUGH_FRAMES:
                    break
            streams = [stream for stream in streams if counts[stream.index] > 1] or streams
        if not streams:
            raise ValueError(f"{video}: has no video stream that can be decoded; {_conversion(video)}")
        chosen = max(streams, key=lambda stream: int(stream.width * stream.height))
        if len(streams) > 1:
            names = ", ".join(f"{stream.index} ({stream.width}x{stream.height})" for stream in streams)
            warn(
                f"{video}: has the video streams {names}; {chosen.index} is read. To write another: "
                f"ffmpeg -i {as_argument(video)} -map 0:NUMBER -c copy other.mp4"
            )
        aspect = float(chosen.sample_aspect_ratio or 1)  # Of a pixel; 0: unknown.
        # The shorter side of the pixels grows, so that nothing is lost.
        size = round(chosen.width * max(aspect, 1.0)), round(chosen.height * max(1 / aspect, 1.0))
        if size[0] * size[1] > MAX_PIXELS:
            raise ValueError(f"{video}: has frames of more than {MAX_PIXELS // 10**6} megapixels, {size[0]}x{size[1]}")
        return int(chosen.index), size


def _frames(video: Path, stream_index: int, phase: str, progress: bool) -> Iterator[Any]:
    with _opened(video) as container:
        stream = container.streams[stream_index]
        stream.thread_type = "AUTO"
        with counting(phase, stream.frames or None, "frame", is_shown=progress) as bar:
            for frame in container.decode(stream):
                bar.update()
                yield frame


def _grey(frame: Any, width: int) -> np.ndarray:
    """Return a frame as greyscale of at most a width, [h, w] uint8."""
    width = min(width, frame.width)
    height = max(2, round(frame.height * width / frame.width))  # np.gradient needs two rows.
    return frame.reformat(width=width, height=height, format="gray").to_ndarray()


def _display_matrix(frame: Any) -> np.ndarray:
    """Return [2, 2] that maps stored (x, y) to shown (x, y), y down, up to a positive factor."""
    try:
        stored = frame.side_data.get("DISPLAYMATRIX")
    except ValueError:  # PyAV does not list side data of a kind that is newer than it.
        angle = np.deg2rad(frame.rotation)  # counterclockwise, without mirrors
        return np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    if stored is None:
        return np.eye(2)
    # FFmpeg has rows (a, b, u), (c, d, v), (x, y, w) with x' = a x + c y and y' = b x + d y.
    return np.frombuffer(bytes(stored), np.int32).reshape(3, 3)[:2, :2].T.astype(np.float64)


def _as_shown(pixels: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    """Return pixels [H, W, C] turned and mirrored by the display matrix, rounded to quarter turns."""
    if abs(matrix[0, 1]) + abs(matrix[1, 0]) > abs(matrix[0, 0]) + abs(matrix[1, 1]):
        pixels = pixels.swapaxes(0, 1)
        matrix = matrix[:, ::-1]
    return pixels[:: -1 if matrix[1, 1] < 0 else 1, :: -1 if matrix[0, 0] < 0 else 1]
