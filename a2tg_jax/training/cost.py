"""Memory of training: what shapes alone say before anything is compiled, and what XLA says of a compiled step."""

import dataclasses
import math
from collections.abc import Iterator, Sequence

import jax

from a2tg_jax.base.machine import Devices, default_platform
from a2tg_jax.base.memory import allowed_memory, used_memory
from a2tg_jax.base.text import in_bytes
from a2tg_jax.core.budget import BYTES_PER_FLOAT
from a2tg_jax.core.gaussians import floats_per_gaussian
from a2tg_jax.events import HostEvent
from a2tg_jax.scene import Scene, View, ray_bytes
from a2tg_jax.training.batches import plan_batches, view_bytes
from a2tg_jax.training.options import System
from a2tg_jax.training.reports import RestOfRun, saved_work
from a2tg_jax.training.start import initial_number, rows_needed

STATES = 3
"""Parameters and the two moments of Adam."""
FURTHER_PROGRAM = 50 * 10**6
"""Bytes that a process keeps for each further program on a CPU, measured: 25 to 110 MB."""


@dataclasses.dataclass(frozen=True)
class StageForecast:
    """Forecast of one stage, from shapes alone."""

    name: str
    model_bytes: float
    """Bytes of the model at its largest."""
    num_rows: int
    """Gaussians that it can reach."""
    num_programs: int
    """Programs compiled while it runs; 0 if it is not trained."""
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

    If a file gives Gaussians instead of the first stage, `num_given` is their number. Stages before `first` are left
    out; that one starts from `num_start` Gaussians, or, if it is None, from Gaussians at the scene's points.
    """
    stages = system.all_stages()
    num = initial_number(scene, system) if num_start is None else num_start
    stages = stages[first:]
    own_floats = floats_per_gaussian(system.initial_sh_degree)
    floats = 0.0
    shared = 0
    appearance = None
    if num_given is not None:
        num = num_given
        yield StageForecast(stages[0].name, system.initial_bytes * num, num, num_programs=0, whole_bytes=0)
        stages = stages[1:]
    for stage in stages:
        num = rows_needed(stage, num, system)
        if stage.appearance != appearance:
            floats = stage.floats_shown
            appearance = stage.appearance
            shared = stage.shared_bytes
        model_bytes = BYTES_PER_FLOAT * (own_floats + floats) * num + shared
        for event in stage.events:
            model_bytes = float(event.most_bytes(model_bytes, num, stage.iterations))
        floats = (model_bytes - shared) / BYTES_PER_FLOAT / num - own_floats
        on_host = [event for event in stage.events if isinstance(event, HostEvent)]
        # One for halved photographs, and one for whole ones.
        num_programs = 2 if stage.num_coarse and saved_work(scene.train) else 1
        num_programs += sum(event.num_programs(stage.iterations) for event in on_host)
        # An event has the old state and the new one; later, the devices get their shares.
        is_changed = any(event.times(stage.iterations) for event in on_host)
        whole = STATES * (2 if is_changed else 1 + 1 / num_devices) * model_bytes
        yield StageForecast(stage.name, model_bytes, num, num_programs, whole)
        for event in stage.events:
            num = event.num_after(num, stage.iterations)


def check_rows_fit(
    scene: Scene, system: System, first: int, num_start: int | None, devices: Devices, max_memory: int | None = None
) -> list[float]:
    """Check, before rows are allocated, that memory can hold the model of each stage from `first` on, and return the
    bytes of these models at their largest.

    Only parameters, moments and gradients count, so that nothing is refused that would fit. Several processes are not
    checked, because each knows the memory of its own machine alone.

    Raises:
      ValueError: if it exceeds `max_memory` bytes, or, if that is None, the memory of the machine or the GPU, naming
        the options to change.
    """
    limit = math.inf if devices.processes > 1 else allowed_memory(max_memory, devices.each)
    copies = STATES + 1
    forecasts = list(forecast_stages(scene, system, first=first, num_start=num_start))
    for forecast in forecasts:
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
            f"{names} is too large for {place}: stage {forecast.name!r} trains up to {forecast.num_rows:,} Gaussians "
            f"of {forecast.model_bytes / forecast.num_rows:,.0f} bytes, and {copies} copies of them (parameters, "
            f"gradients and two moments) take at least {in_bytes(needed)} of memory, but {in_bytes(limit)} may be "
            f"used: lower it, to a model of less than {in_bytes(limit / copies)}, or allow more with max_memory"
        )
    return [forecast.model_bytes for forecast in forecasts]


def check_step_fits(
    step: jax.stages.Compiled,
    model_bytes: float,
    after: RestOfRun,
    system: System,
    devices: Devices,
    max_memory: int | None = None,
) -> float:
    """Check that a compiled step fits into memory, before it first runs, and return the bytes in use while it runs
    (host).

    Args:
      step: the step, of which XLA says how much it allocates.
      model_bytes: bytes of its model.
      after: stages that follow.
      system: whose limits a message names.
      devices: devices that run the step.
      max_memory: as for `check_rows_fit`.

    Raises:
      ValueError: if the step or a later stage exceeds the memory that may be used, naming the options to change.
    """
    said = step.memory_analysis()
    # Some platforms do not say.
    new = 0 if said is None else said.temp_size_in_bytes + said.output_size_in_bytes - said.alias_size_in_bytes
    needed = used_memory(devices.each) + devices.each * new
    # While a step runs there are parameters and moments of before and after it.
    later = needed + 2 * STATES * max(0, after.model_bytes - model_bytes)
    if default_platform() == "cpu":
        later += FURTHER_PROGRAM * after.programs
    limit = allowed_memory(max_memory, devices.each)
    if devices.processes == 1 and later > limit:
        and_later = f", and what follows the stage about {in_bytes(later)}" if later > needed else ""
        names = ", ".join((*system.limits(), "batch_size or sh_degree"))
        raise ValueError(
            f"XLA reports that a step needs {in_bytes(new)} of memory, {in_bytes(needed)} with all that is in use"
            f"{and_later}; {in_bytes(limit)} may be used: lower {names}, take smaller photographs (downscale), or "
            "allow more with max_memory"
        )
    return needed


def held_bytes(scene: Scene) -> int:
    """Return the bytes of the photographs, and of the rays of their lenses, that the scene keeps in memory."""
    views = (*scene.train, *scene.test)
    return sum(view.picture.nbytes for view in views if view.picture.is_held) + ray_bytes(views)


def fed_bytes(views: Sequence[View], batch_size: int, *, has_depths: bool) -> float:
    """Return the bytes of the photographs that are ready for the step, all or the next batches."""
    plan = plan_batches(tuple(views), batch_size, has_depths=has_depths)
    if plan.is_resident:
        return sum(view_bytes(view, has_depths=has_depths) for view in views) + ray_bytes(views)
    # Rays that do not stay on the device come with each batch: with the step's own and with the next.
    of_rays = ray_bytes(views) if plan.keeps_rays else 2 * max(ray_bytes([view]) for view in views)
    return of_rays + (2 * plan.num_ahead + 1) * plan.batch_bytes
