"""Frames of a finished run: its test views, or a smooth path past the cameras, and a video of that."""

import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Literal

from tqdm import tqdm

from a2tg_jax.cameras import Camera
from a2tg_jax.data import Scene
from a2tg_jax.io.model import load_model
from a2tg_jax.paths import smooth_path
from a2tg_jax.renderer import Renderer
from a2tg_jax.results.evaluate_run import background_of
from a2tg_jax.results.folder import Phase, RunFolder
from a2tg_jax.results.pictures import picture_name, save_picture, to_uint8
from a2tg_jax.results.record import read_record
from a2tg_jax.training import render_settings

Route = Literal["test", "smooth"]


def render_frames(
    run: RunFolder, out: Path, *, route: Route = "smooth", num_frames: int = 120, phase: Phase = "stage2"
) -> list[Path]:
    """Writes one PNG per frame and returns their paths.

    Args:
      run: an opened run folder.
      out: folder for the frames, made if absent: frame_0000.png … of a path, NAME.png of test views.
      route: the test views, or a smooth path past all cameras.
      num_frames: length of the path.
      phase: whose model is drawn.

    Raises:
      FileNotFoundError: if that phase is not finished, or the scene is not where it was.
      ValueError: if the scene has no test views and these are wanted.
    """
    if not run.model(phase).is_file():
        raise FileNotFoundError(f"{run.path} has no finished {phase}; go on with a2tg train … --resume")
    record, model = read_record(run), load_model(run.model(phase))
    cameras = dict(_cameras(record.source.load(), route, num_frames))
    renderer = Renderer(
        model,
        cameras=cameras.values(),
        settings=render_settings(record.config),
        background=background_of(record.config),
        has_geometry=False,
    )
    for name, camera in tqdm(cameras.items(), desc="frames", unit="frame"):
        save_picture(out / name, to_uint8(renderer(camera).color))
    return [out / name for name in cameras]


def write_video(folder: Path, path: Path, *, frames_per_second: int = 30) -> bool:
    """Makes an mp4 of frame_0000.png … with ffmpeg; False where that program is not installed.

    Raises:
      ValueError: if ffmpeg fails.
    """
    program = shutil.which("ffmpeg")
    if program is None:
        return False
    even_sides = "pad=ceil(iw/2)*2:ceil(ih/2)*2"
    frames = ["-framerate", str(frames_per_second), "-i", str(folder / "frame_%04d.png")]
    command = [program, "-y", "-loglevel", "error", *frames, "-vf", even_sides, "-pix_fmt", "yuv420p", str(path)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise ValueError(f"ffmpeg could not make {path}: {done.stderr.strip()}")
    return True


def _cameras(scene: Scene, route: Route, num_frames: int) -> Iterator[tuple[str, Camera]]:
    """File names and cameras of the frames."""
    if route == "smooth":
        views = sorted((*scene.train, *scene.test), key=lambda view: view.name)
        path = smooth_path([view.camera for view in views], num_frames)
        yield from ((f"frame_{index:04d}.png", camera) for index, camera in enumerate(path))
        return
    if not scene.test:
        raise ValueError("the scene has no test views; render a path instead with --path smooth")
    yield from ((picture_name(view.name), view.camera) for view in scene.test)
