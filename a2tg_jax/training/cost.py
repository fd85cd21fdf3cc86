"""Cost of a stage of training, from its shapes alone: bytes of memory at its peak, seconds of an iteration.

Photographs, rows of Gaussians and their appearance are counted. A step needs further bytes per byte of the model, row,
pixel and pair, as XLA reports for compiled steps (`memory_analysis`). The size of an empty process was measured;
`benchmarks/forecasts.py` compares forecasts with peaks.
"""

import dataclasses
from collections.abc import Iterator, Sequence
from typing import NamedTuple

from a2tg_jax.base.machine import Devices, allowed_memory, default_platform, num_threads
from a2tg_jax.base.text import in_bytes
from a2tg_jax.core.budget import BYTES_PER_FLOAT
from a2tg_jax.core.gaussians import floats_per_gaussian
from a2tg_jax.events import HostEvent
from a2tg_jax.scene import Scene, View, ray_bytes
from a2tg_jax.training.batches import plan_batches, view_bytes
from a2tg_jax.training.options import System
from a2tg_jax.training.stage import Stage
from a2tg_jax.training.start import initial_number, rows_needed

MB = 10**6
PROCESS = 300 * MB
"""Python, JAX and other imports."""
# Rounded to fit the runs in experiments/NOTEBOOK.md, "Forecasts of memory".
FIRST_PROGRAM = 270 * MB
"""Memory of the compiled programs of the first stage."""
FURTHER_STAGE = 110 * MB
"""Memory of the compiled programs of each further stage."""
FURTHER_PROGRAM = 25 * MB
"""Memory of each program of new shapes."""
COMPILER = 240 * MB
"""Memory of the compiler during a step's compilation."""
STATES = 3
"""Parameters and the two moments of Adam."""
STEP_PER_MODEL = 2.9
"""Bytes of a step's own buffers for each byte of the model: gradients and the new state."""
STEP_PER_ROW = 300
"""The same for each row: splats."""
STEP_PER_PIXEL = 123
"""The same for each pixel: colours, loss, and the gradients of both."""
STEP_PER_PAIR = 4
"""The same for each pair of the tile lists."""
GEOMETRY_PER_PIXEL = 72
"""Further bytes if a term of the loss reads depth or normals."""
STATISTIC_PER_ROW = 480
"""Further bytes if events gather a statistic and change rows inside the step."""
CORRECTION_COPIES = 8
"""Copies of the rows of a correction: what the stage began with, rows and moments before and after a step, gradients.
"""
VIEW_PER_ROW = 140
"""Bytes of each view of a batch for each row, without its gradient of the model."""
VIEW_PER_PIXEL = 5
"""The same for each pixel."""
PAIRS_PER_TILE = 90
"""Room in the tile lists of a stage that begins with few, large Gaussians."""
DECODER_PER_PIXEL = 15
"""Bytes while a photograph is read."""
SECONDS_PER_ROW = 2.4e-6
"""Seconds of an iteration on one core (docs/performance.md) for each row; all cores share them."""
SECONDS_PER_PIXEL = 0.72e-6
"""The same for each pixel."""


class Bytes(NamedTuple):
    """Bytes in memory at one time, by purpose."""

    program: float = 0
    """The program, its libraries and compiled code."""
    photographs: float = 0
    model: float = 0
    """The model and its moments."""
    gradients: float = 0
    """Gradients and other arrays that a step makes for each Gaussian."""
    pixels: float = 0
    """Renders, loss and tile lists."""
    corrections: float = 0
    """Rows of the corrections of photographs, their moments, and what a step makes to apply them."""

    @property
    def total(self) -> float:
        return sum(self)


@dataclasses.dataclass(frozen=True)
class StageForecast:
    """Forecast of one stage."""

    bytes: Bytes
    """Bytes in memory at its peak."""
    model_bytes: float
    """Bytes of the model at its largest."""
    num_rows: int
    """Gaussians that it can reach."""
    num_programs: int
    """Programs compiled while it runs; 0 if it is not trained."""
    seconds: float
    """All its iterations, on CPUs, roughly."""
    whole_bytes: float
    """Bytes that one of several devices must have room for: its share of the state, and, between steps, all of it."""

    @property
    def is_trained(self) -> bool:
        """Whether the stage is trained, not given as a file."""
        return self.num_programs > 0


def forecast_stages(
    scene: Scene,
    system: System,
    num_given: int | None = None,
    num_devices: int = 1,
    first: int = 0,
    num_start: int | None = None,
) -> Iterator[StageForecast]:
    """Yield the forecast of each stage of a system (host; nothing is compiled).

    If a file gives Gaussians instead of the first stage, `num_given` is their number. Bytes are of all devices that
    train together. Stages before `first` are left out; that one starts from `num_start` Gaussians, or, if it is None,
    from Gaussians at the scene's points.
    """
    stages = system.all_stages()
    mean_pixels = sum(view.camera.width * view.camera.height for view in scene.train) / len(scene.train)
    num = initial_number(scene, system, stages[0]) if num_start is None else num_start
    stages = stages[first:]
    floats = 0.0
    shared = 0
    appearance = None
    if num_given is not None:
        num = num_given
        stages = stages[1:]
        yield StageForecast(Bytes(), system.initial_bytes * num, num, num_programs=0, seconds=0, whole_bytes=0)
    for stage in stages:
        num = rows_needed(stage, num, system)
        if stage.appearance != appearance:
            floats = stage.floats_shown(system.initial_sh_degree)
            appearance = stage.appearance
            shared = stage.shared_bytes
        model_bytes = BYTES_PER_FLOAT * (floats_per_gaussian(system.initial_sh_degree) + floats) * num + shared
        for event in stage.events:
            model_bytes = event.most_bytes(model_bytes, num, stage.iterations)
        floats = (model_bytes - shared) / BYTES_PER_FLOAT / num - floats_per_gaussian(system.initial_sh_degree)
        on_host = [event for event in stage.events if isinstance(event, HostEvent)]
        programs = 1 + sum(event.num_programs(stage.iterations) for event in on_host)
        # An event has the old state and the new one; later, the devices get their shares.
        is_changed = any(event.times(stage.iterations) for event in on_host)
        whole = STATES * (2 if is_changed else 1 + 1 / num_devices) * model_bytes
        seconds = stage.iterations * system.batch_size * (SECONDS_PER_ROW * num + SECONDS_PER_PIXEL * mean_pixels)
        needed = stage_bytes(scene, system, stage, num, model_bytes, num_devices)
        yield StageForecast(needed, model_bytes, num, programs, seconds / num_threads(), whole)
        for event in stage.events:
            num = event.num_after(num, stage.iterations)


def check_rows_fit(
    scene: Scene, system: System, first: int, num_start: int | None, devices: Devices, max_memory: int | None = None
) -> None:
    """Check that a system's stages from `first` on can be held in memory, before rows are allocated.

    Only parameters, moments and gradients count, so that nothing is refused that would fit. Several processes are not
    checked, because each knows the memory of its own machine alone.

    Raises:
      ValueError: if it exceeds `max_memory` bytes, or, if that is None, the memory of the machine or the GPU, naming
        the options to change.
    """
    if devices.processes > 1:
        return
    limit = allowed_memory(max_memory, devices.each)
    copies = STATES + 1
    forecasts = forecast_stages(scene, system, first=first, num_start=num_start)
    for stage, forecast in zip(system.all_stages()[first:], forecasts, strict=True):
        needed = copies * forecast.model_bytes
        if needed <= limit:
            continue
        names = " or ".join(system.limits())
        if system.memory_budget is not None:
            names += f" of {system.memory_budget:,.15g} MB"
        elif num_start is not None and forecast.num_rows == num_start:
            names = "start"
        place = "this machine (its container and ulimit included)" if default_platform() == "cpu" else "the GPU"
        raise ValueError(
            f"{names} is too large for {place}: stage {stage.name!r} trains up to {forecast.num_rows:,} Gaussians of "
            f"{forecast.model_bytes / forecast.num_rows:,.0f} bytes, and {copies} copies of them (parameters, "
            f"gradients and two moments) take at least {in_bytes(needed)} of memory, but {in_bytes(limit)} may be "
            f"used: lower it, to a model of less than {in_bytes(limit / copies)}, or allow more with max_memory"
        )


def stage_bytes(
    scene: Scene, system: System, stage: Stage, num: int, model_bytes: float, num_devices: int = 1
) -> Bytes:
    """Return the bytes of a stage's last steps on all devices, without programs and compilation, given its number of
    rows and the bytes of the model.

    Each of several devices has its share of the state, and, while it draws its views, a copy of the model.
    """
    is_changed = any(isinstance(event, HostEvent) and event.times(stage.iterations) for event in stage.events)
    largest = largest_view(scene.train)
    batch = system.batch_size // num_devices
    per_view = sum(BYTES_PER_FLOAT * correction.neutral.size for correction in stage.corrections)
    per_pixel = STEP_PER_PIXEL + GEOMETRY_PER_PIXEL * stage.has_geometry
    pairs = PAIRS_PER_TILE * largest / system.tile_size**2
    per_row = STEP_PER_ROW + STATISTIC_PER_ROW * any(event.statistic for event in stage.events)
    of_step = STEP_PER_MODEL * model_bytes
    if num_devices > 1:  # The copy and the gradients are of all rows; the rest of a step is divided.
        of_step = (2 + (STEP_PER_MODEL - 1) / num_devices) * model_bytes
    of_step += per_row * num + (batch - 1) * (model_bytes + VIEW_PER_ROW * num)
    return Bytes(
        photographs=held_bytes(scene) + num_devices * fed_bytes(scene.train, batch, has_depths=stage.has_depths),
        model=(STATES + 1) * model_bytes,  # what the stage began with stays
        # An event holds the old state and the new one.
        gradients=max(num_devices * of_step, STATES * model_bytes * is_changed),
        pixels=num_devices * (largest * (per_pixel + VIEW_PER_PIXEL * (batch - 1)) + STEP_PER_PAIR * pairs),
        corrections=CORRECTION_COPIES * len(scene.train) * per_view
        + largest * sum(correction.bytes_per_pixel for correction in stage.corrections),
    )


def held_bytes(scene: Scene) -> int:
    """Return the bytes of the photographs, and of the rays of their lenses, that the scene keeps in memory."""
    views = (*scene.train, *scene.test)
    return sum(view.picture.nbytes for view in views if view.picture.is_held) + ray_bytes(views)


def fed_bytes(views: Sequence[View], batch_size: int, *, has_depths: bool) -> float:
    """Return the bytes of the photographs that are ready for the step, all or the next batches, and of reading them."""
    plan = plan_batches(tuple(views), batch_size, has_depths=has_depths)
    if plan.is_resident:
        return sum(view_bytes(view, has_depths=has_depths) for view in views) + ray_bytes(views)
    is_read = any(not view.picture.is_held for view in views)
    # Rays that do not stay on the device come with each batch: with the step's own and with the next.
    of_rays = ray_bytes(views) if plan.keeps_rays else 2 * max(ray_bytes([view]) for view in views)
    readers = min(plan.num_ahead, num_threads()) * is_read
    return of_rays + (2 * plan.num_ahead + 1) * plan.batch_bytes + readers * DECODER_PER_PIXEL * largest_view(views)


def largest_view(views: Sequence[View]) -> int:
    """Return the pixels of the largest view."""
    return max(view.camera.width * view.camera.height for view in views)
