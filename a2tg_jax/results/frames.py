"""Frames of a finished run, and a video: its test views, or a path past the cameras, an orbit or saved views.

The folder has a list of rendered files. No other file is replaced without `overwrite`, or deleted.
"""

import contextlib
import dataclasses
import math
import os
import re
import shutil
import subprocess
from collections.abc import Collection, Iterable, Iterator, Sequence
from pathlib import Path
from typing import get_args

import jax.numpy as jnp
import numpy as np
from PIL import Image

from a2tg_jax import Camera, Model, Origin, Renderer, path_through, resize_camera, smooth_path, turntable
from a2tg_jax.base.atomic import replacing, write_whole
from a2tg_jax.base.regular_files import is_regular, read_regular
from a2tg_jax.base.text import did_you_mean, shortened
from a2tg_jax.base.user_warnings import warn
from a2tg_jax.data.camera_paths import front_view
from a2tg_jax.data.capture_geometry import SURROUNDED, largest_gap, matrices_of, without_outlying
from a2tg_jax.host.progress_bars import progress_over
from a2tg_jax.io.path_file import load_views
from a2tg_jax.io.subject import find_subject
from a2tg_jax.results.folder import RunFolder
from a2tg_jax.results.images import picture_names, save_animation, to_uint8, write_png
from a2tg_jax.results.model_source import open_source
from a2tg_jax.results.options import FRAMES_PER_SECOND, STILLS, CameraPath
from a2tg_jax.results.output_paths import check_new

FRAME_PIXELS = 1280 * 720
"""Default width × height of frames, which have the photographs' aspect."""
SUBJECT_SHARE = 0.9
"""Largest share of the width and height of an orbit's frames that the subject takes."""
LEAST_ROOM = 0.25
"""Smallest distance of an orbit's principal point from a border, as a share of the width or height; a nearer one, as
cropped photographs have it, would leave no focal length that shows the whole subject."""
LARGEST_SIDE = 8192
WEBP_QUALITY = 80
LIST = ".a2tg-frames"
"""Name of the list."""
MOST_BYTES = 1 << 26
FRAME_NAME = "frame_%04d.png"
"""File name of a flight's frame by its number, in Python's and ffmpeg's format."""
FRONT_NAME = "front.png"
FRAME = re.compile(r"frame_\d{4,}\.png")


class FrameFolder:
    """Folder for rendered frames and videos, with a list of their names."""

    def __init__(self, path: Path):
        self.path = path

    @property
    def listed(self) -> list[str]:
        """Names of rendered files."""
        if not is_regular(self.path / LIST):
            return []
        # surrogateescape: names of views may be bytes of any encoding.
        lines = read_regular(self.path / LIST, MOST_BYTES).decode(errors="surrogateescape").splitlines()
        return list(dict.fromkeys(lines))

    def check(self, names: Iterable[str], *, overwrite: bool) -> None:
        """Raise FileExistsError if an unlisted file exists, unless `overwrite` is set."""
        for name in set(names) - set(self.listed):
            check_new(self.path / name, "`out`", overwrite=overwrite)

    @contextlib.contextmanager
    def writing(self, name: str) -> Iterator[Path]:
        """Yield a temporary path for a file of the folder, as `replacing` does, and list the file."""
        with replacing(self.path / name) as temporary:
            yield temporary
            # Listed before the rename: a killed render leaves no file that is unlisted.
            with open(self.path / LIST, "a", encoding="utf-8", errors="surrogateescape") as file:
                file.write(f"{name}\n")

    def tidy(self, rendered: Collection[str], *, drops_frames: bool) -> None:
        """List each file once; with `drops_frames`, delete frames of flights that this render did not write."""
        names = self.listed
        if drops_frames:
            for name in names:
                if name not in rendered and FRAME.fullmatch(name):
                    (self.path / name).unlink(missing_ok=True)
        left = "".join(f"{name}\n" for name in names if (self.path / name).is_file())
        write_whole(self.path / LIST, left.encode(errors="surrogateescape"))


def parse_size(text: str) -> tuple[int, int]:
    """Return width and height of a text such as 1280x720. Raises ValueError if it is invalid."""
    match = re.fullmatch(r"(\d{1,6})[x×](\d{1,6})", text)
    size = (int(match[1]), int(match[2])) if match else (0, 0)
    if not all(1 <= side <= LARGEST_SIDE for side in size):
        raise ValueError(
            f"size must be WIDTHxHEIGHT in pixels, each 1 to {LARGEST_SIDE}, such as 1280x720; got {shortened(text)}"
        )
    return size


def render_frames(
    run: RunFolder,
    out: Path,
    *,
    route: CameraPath | Path = "smooth",
    num_frames: int = 120,
    name: str | None = None,
    size: tuple[int, int] | None = None,
    supersample: int = 1,
    edit: Path | None = None,
    overwrite: bool = False,
) -> list[Path]:
    """Write one PNG per frame and return their paths. The photographs are not needed.

    The folder gets frame_0000.png … of a path, front.png, or NAME.png of the test views. Files of earlier renders are
    replaced, and frames of a longer path deleted; other files need `overwrite`.

    Args:
      route: the test views, a smooth path past all cameras, an orbit around the subject, its front alone, or a path
        through the views in a file that the viewer saved.
      name: model to render; None: the last one of the run's main system.
      edit: file of an edit that is applied before.
      size: width and height of the frames. Views of another aspect are whole, with more of the scene at two sides.
        None: the cameras' sizes for test views; otherwise `FRAME_PIXELS` in the aspect of the first camera.

    Raises:
      ValueError, OSError: if that stage is not finished, the views or the path are missing, or a file is in the way.
    """
    if num_frames < 1:
        raise ValueError(f"the number of frames must be at least 1; got {num_frames}")
    if out.exists() and not out.is_dir():
        raise FileExistsError(f"{out} is a file; choose a folder for the frames with `out`")
    source = open_source(run.path, name, edit)
    cameras = _cameras(source.model, route, num_frames)
    if size is None and route != "test":
        size = frame_size(next(iter(cameras.values())))
    if size is not None:
        cameras = {file_name: widen_camera(camera, *size) for file_name, camera in cameras.items()}
    if route == "orbit":
        shown = with_whole_subject(list(cameras.values()), source.model)
        cameras = dict(zip(cameras, shown, strict=True))
    folder = FrameFolder(out)
    folder.check(cameras, overwrite=overwrite)
    settings = dataclasses.replace(source.settings, supersample=supersample)
    renderer = Renderer(source.model, cameras=cameras.values(), settings=settings, has_geometry=False)
    for file_name, camera in progress_over(list(cameras.items()), "frames", "frame"):
        with folder.writing(file_name) as temporary:
            write_png(temporary, to_uint8(renderer(camera).color))
    # Single views leave a flight's frames in place.
    folder.tidy(cameras, drops_frames=route not in STILLS)
    return [out / file_name for file_name in cameras]


def check_rate(frames_per_second: float) -> None:
    """Raise ValueError unless a video can have this frame rate."""
    if not 1 <= frames_per_second <= 1000:
        raise ValueError(f"the number of frames per second must be in 1..1000; got {frames_per_second}")


def video_name() -> str:
    """Return the file name of a flight's video: an MP4 with ffmpeg, and otherwise an animated WebP."""
    return "flight.mp4" if shutil.which("ffmpeg") else "flight.webp"


def write_video(frames: Sequence[Path], *, frames_per_second: float = FRAMES_PER_SECOND) -> Path:
    """Make a video of frame_0000.png … in their folder: an MP4 with ffmpeg, otherwise a looping animated WebP.
    Raises ValueError if ffmpeg fails."""
    path = frames[0].with_name(video_name())
    program = shutil.which("ffmpeg")
    with FrameFolder(path.parent).writing(path.name) as temporary:
        if program is None:
            save_animation(temporary, _images(frames), frames_per_second, quality=WEBP_QUALITY)
            return path
        # Most players decode yuv420p only, which needs even sides: the last row or column is repeated.
        with Image.open(frames[0]) as first:
            right = first.width % 2
            bottom = first.height % 2
        even_sides = f"format=gbrp,pad=iw+{right}:ih+{bottom},fillborders=right={right}:bottom={bottom}:mode=smear"
        source = ["-framerate", str(frames_per_second), "-i", FRAME_NAME]
        # Otherwise ffmpeg continues with whatever numbered files follow.
        made = ["-frames:v", str(len(frames)), "-vf", even_sides, "-pix_fmt", "yuv420p", "-f", "mp4"]
        # ffmpeg chooses formats by suffix, which the temporary path lacks: hence -f mp4.
        command = [os.path.abspath(program), "-y", "-loglevel", "error", *source, *made, str(temporary.absolute())]
        # Run in the folder: ffmpeg would take a % in its name for a number.
        done = subprocess.run(command, cwd=path.parent, capture_output=True, text=True, check=False)
        if done.returncode != 0:
            raise ValueError(f"ffmpeg could not make {path}: {done.stderr.strip()}")
    return path


def _images(frames: Sequence[Path]) -> Iterator[Image.Image]:
    for frame in frames:
        with Image.open(frame) as image:
            # Read now: the file is closed when the generator resumes.
            image.load()
            yield image


def _cameras(model: Model, route: CameraPath | Path, num_frames: int) -> dict[str, Camera]:
    """Return cameras by the file names of their frames; frames of a path have the names that `write_video` expects."""
    if isinstance(route, Path):
        try:
            saved = load_views(route)
        except FileNotFoundError as error:
            raise FileNotFoundError(f"{error}{did_you_mean(str(route), get_args(CameraPath))}") from None
        return _numbered(path_through(saved, num_frames))
    origin = model.origin
    if origin is None:
        raise ValueError("the model has no cameras to render")
    by_name = sorted(range(len(origin.names)), key=origin.names.__getitem__)
    cameras = list(origin.cameras)
    if route == "smooth":
        return _numbered(smooth_path(without_outlying([cameras[index] for index in by_name]), num_frames))
    if route == "front":
        return {FRONT_NAME: cameras[front_view(origin)]}
    if route == "orbit":
        gap = unseen_angle(origin)
        if gap > SURROUNDED:
            warn(
                f"no camera is in {np.degrees(gap):.0f}° of this orbit, where the model shows what no photograph "
                "shows: `path` smooth stays where photographs were taken"
            )
        return _numbered(turntable([cameras[index] for index in by_name], num_frames, origin.up))
    tests = {origin.names[index]: cameras[index] for index in by_name if origin.is_test[index]}
    if not tests:
        raise ValueError("the run has no test views; render a path instead with `path` smooth")
    names = picture_names(tests)
    return {names[name]: camera for name, camera in tests.items()}


def unseen_angle(origin: Origin) -> float:
    """Return the largest angle around the subject, in radians, without a camera (`largest_gap`)."""
    return largest_gap(matrices_of(without_outlying(list(origin.cameras))), origin.vertical)


def frame_size(camera: Camera) -> tuple[int, int]:
    """Return the width and height, both even, of `FRAME_PIXELS` in a camera's aspect."""
    factor = math.sqrt(FRAME_PIXELS / (camera.width * camera.height))
    width, height = (2 * max(1, round(factor * side / 2)) for side in (camera.width, camera.height))
    return min(width, LARGEST_SIDE), min(height, LARGEST_SIDE)


def widen_camera(camera: Camera, width: int, height: int) -> Camera:
    """Return the view of a pinhole camera at another image size and aspect: scaled to fit, with more of the scene at
    two sides. Rays of a lens are left out."""
    factor = min(width / camera.width, height / camera.height)
    camera = dataclasses.replace(camera, rays=None)
    scaled = resize_camera(camera, max(1, round(factor * camera.width)), max(1, round(factor * camera.height)))
    shift = jnp.asarray([(width - scaled.width) / 2, (height - scaled.height) / 2], camera.K.dtype)
    return Camera(camera.viewmat, scaled.K.at[:2, 2].add(shift), width, height)


def with_whole_subject(cameras: Sequence[Camera], model: Model) -> list[Camera]:
    """Return an orbit's cameras with one focal length, at most theirs, at which each shows the whole subject; unchanged
    if the model has no subject. A principal point near a border (`LEAST_ROOM`) moves to the middle.

    An orbit looks at the point that most photographs aim at, which need not be the middle of the subject.
    """
    try:
        is_kept = find_subject(model).is_kept
    except ValueError:
        return list(cameras)
    points = np.asarray(model.live.gaussians.means, np.float64)[is_kept]
    cameras = [_with_room(camera) for camera in cameras]
    factor = 1.0
    for camera in cameras:
        viewmat = np.asarray(camera.viewmat, np.float64)
        K = np.asarray(camera.K, np.float64)
        places = points @ viewmat[:3, :3].T + viewmat[:3, 3]
        places = places[places[:, 2] > 0]
        offsets = places[:, :2] / places[:, 2:] @ K[:2, :2].T
        # From the principal point to the border on the side of each offset.
        sizes = np.array([camera.width, camera.height])
        room = np.where(offsets < 0, K[:2, 2], sizes - K[:2, 2]) - (1 - SUBJECT_SHARE) / 2 * sizes
        factor = min(factor, (room / np.maximum(np.abs(offsets), 1e-9)).min(initial=1.0))
    return [dataclasses.replace(camera, K=camera.K.at[:2, :2].multiply(factor)) for camera in cameras]


def _with_room(camera: Camera) -> Camera:
    """Return the camera, with its principal point in the middle of the image if it is near a border."""
    sizes = np.array([camera.width, camera.height])
    if (np.abs(np.asarray(camera.K)[:2, 2] / sizes - 0.5) <= 0.5 - LEAST_ROOM).all():
        return camera
    return dataclasses.replace(camera, K=camera.K.at[:2, 2].set(sizes / 2))


def _numbered(path: Sequence[Camera]) -> dict[str, Camera]:
    return {FRAME_NAME % index: camera for index, camera in enumerate(path)}
