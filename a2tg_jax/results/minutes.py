"""Choice of a training that fits into given minutes on this machine: size of the photographs, bytes, iterations."""

import contextlib
import dataclasses
import math
import time
from collections.abc import Iterator
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.experimental.compilation_cache.compilation_cache import reset_cache

from a2tg_jax import (
    Camera,
    Gaussians,
    Scene,
    View,
    init_from_points,
    load_scene,
    plan_render,
    render_image,
    view_image,
)
from a2tg_jax.base.text import counted, in_bytes
from a2tg_jax.results.commands import LEAST_SIDE

BYTES_PER_PIXEL = 4.0
"""Bytes of the model for each pixel of a photograph: 0.3 MB at 320×240."""
GAUSSIANS_PER_PIXEL = 0.07
"""Number of Gaussians in these bytes, for each pixel."""
FIRST_DOWNSCALE = 4
"""Factor by which photographs are downscaled to measure the machine."""
ITERATIONS = 3_000
"""Iterations of the preset quick, enough for `PIXELS`. They grow with the side of the photographs."""
PIXELS = 320 * 240
LEAST_ITERATIONS = 1_000
MOST_ITERATIONS = 30_000
NUM_TIMED = 5
"""Number of timed gradients; the median counts."""
STEP = 2.4
"""Mean time of a training step of `bytewise` in `quick` with its events, as a multiple of the time of a gradient of the
initial Gaussians, on two cores."""
OVERHEAD = 25.0
"""Time in which a training compiles, is evaluated, and gets its page and turntable, as a multiple of the time in which
this gradient compiles."""
OTHER_SHARE = 0.1
"""Share of the time that is kept in reserve."""


@dataclasses.dataclass(frozen=True)
class Speed:
    """How fast this machine trains a scene at present."""

    pixel_seconds: float
    """Time of a training step for each pixel of a photograph, in seconds."""
    other_seconds: float
    """Time of everything but steps, in seconds."""


@dataclasses.dataclass(frozen=True)
class TimedTraining:
    """A training that fits into a time."""

    downscale: int
    width: int
    height: int
    iterations: int
    memory_budget: float
    """MB of the model."""
    seconds: float
    """Expected time of training and evaluation, in seconds."""

    @property
    def flags(self) -> list[str]:
        """Flags of `a2tg train`: two thirds of the iterations are in the first stage, as in the preset quick."""
        first = round(self.iterations * 2 / 3)
        return [
            "--preset", "quick",
            "--downscale", str(self.downscale),
            "--memory-budget", f"{self.memory_budget:g}MB",
            "--stage1-iterations", str(first),
            "--stage2-iterations", str(self.iterations - first),
        ]  # fmt: skip

    @property
    def text(self) -> str:
        size = in_bytes(1e6 * self.memory_budget)
        minutes = counted(max(1, round(self.seconds / 60)), "minute")
        return (
            f"photographs of {self.width}×{self.height} pixels, {size}, {self.iterations:,} iterations: about "
            f"{minutes}, if this machine stays as busy as now"
        )


def choose_training(path: Path, seconds: float) -> TimedTraining:
    """Return the training of a scene that takes about this many seconds on this machine (host; measures its speed).

    Photographs and iterations grow together: four times the pixels get twice the iterations.

    Raises:
      ValueError: if the time is too short for a useful training.
    """
    downscale = FIRST_DOWNSCALE
    scene = load_scene(path, downscale=downscale)
    if max(_size(scene)) < LEAST_SIDE:
        downscale = 1
        scene = load_scene(path)
    return training_within(seconds, measured_speed(scene), _size(scene), downscale)


def training_within(seconds: float, speed: Speed, size: tuple[int, int], downscale: int) -> TimedTraining:
    """Return the training that takes about this many seconds.

    Args:
      seconds: time of the training and of what follows.
      speed: speed of the machine.
      size: width and height of photographs that are downscaled by `downscale`.

    Raises:
      ValueError: if the time is too short for a useful training.
    """
    full = size[0] * downscale, size[1] * downscale
    available = (1 - OTHER_SHARE) * seconds - speed.other_seconds
    # iterations = ITERATIONS √(pixels / PIXELS), and iterations · pixels · pixel_seconds = available.
    rate = ITERATIONS / math.sqrt(PIXELS) * speed.pixel_seconds
    pixels = (max(available, 0) / rate) ** (2 / 3)
    chosen = max(1, math.ceil(math.sqrt(full[0] * full[1] / max(pixels, 1))))
    chosen = min(chosen, max(1, max(full) // LEAST_SIDE))
    width = full[0] // chosen
    height = full[1] // chosen
    step = speed.pixel_seconds * width * height
    iterations = min(int(available / step), MOST_ITERATIONS)
    if iterations < LEAST_ITERATIONS:
        least = (LEAST_ITERATIONS * step + speed.other_seconds) / (1 - OTHER_SHARE)
        raise ValueError(
            f"minutes are too few: {max(seconds, 0) / 60:.1f} are left to train, and this machine needs "
            f"{math.ceil(least / 6) / 10} at least, as busy as now; repeat the command with more: the cameras "
            "that were found are kept"
        )
    expected = iterations * step + speed.other_seconds + OTHER_SHARE * seconds
    budget = round(BYTES_PER_PIXEL * width * height / 1e6, 2)
    return TimedTraining(chosen, width, height, iterations, max(budget, 0.1), expected)


def measured_speed(scene: Scene) -> Speed:
    """Return the speed of this machine, from gradients of renders of the scene's initial points."""
    views = scene.train[:: max(1, len(scene.train) // NUM_TIMED)][:NUM_TIMED]
    width, height = _size(scene)
    gaussians = init_from_points(scene.points, scene.colors, max(2, round(GAUSSIANS_PER_PIXEL * width * height)))
    settings = plan_render(gaussians, [view.camera for view in views])

    def loss(gaussians: Gaussians, camera: Camera, photograph: Array) -> Array:
        image = render_image(gaussians, camera, settings=settings).color
        return jnp.mean(jnp.abs(image - photograph))

    gradient = jax.jit(jax.value_and_grad(loss))

    def seconds_of(view: View) -> float:
        photograph = view_image(view)
        started = time.perf_counter()
        jax.block_until_ready(gradient(gaussians, view.camera, photograph))
        return time.perf_counter() - started

    with _compiled_anew():
        compiling = seconds_of(views[0])
    pixel_seconds = STEP * float(np.median([seconds_of(view) for view in views])) / (width * height)
    return Speed(pixel_seconds, OVERHEAD * compiling)


@contextlib.contextmanager
def _compiled_anew() -> Iterator[None]:
    """Read no compiled program from disk within the block: it would hide how long this machine compiles."""
    folder = jax.config.values["jax_compilation_cache_dir"]
    jax.config.update("jax_compilation_cache_dir", None)
    reset_cache()  # JAX looks at the option only once.
    try:
        yield
    finally:
        jax.config.update("jax_compilation_cache_dir", folder)
        reset_cache()


def _size(scene: Scene) -> tuple[int, int]:
    """Return width and height of the largest photograph."""
    cameras = [view.camera for view in scene.train]
    largest = max(cameras, key=lambda camera: camera.width * camera.height)
    return largest.width, largest.height
