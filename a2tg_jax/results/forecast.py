"""The least memory and disk that a run needs, before anything is compiled, and errors for runs that cannot fit."""

import dataclasses
import math
import os
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from a2tg_jax import RestOfRun, Scene, View
from a2tg_jax.base.machine import default_platform
from a2tg_jax.base.memory import allowed_memory, used_memory
from a2tg_jax.base.text import in_bytes
from a2tg_jax.data.photo_store import SHARE_OF_MEMORY
from a2tg_jax.results.commands import QUICK_SIDE, quick_flags
from a2tg_jax.results.plan import RunPlan
from a2tg_jax.results.record import MEMORY_OF_FILE, RunRecord
from a2tg_jax.training.cost import STATES, StageForecast, fed_bytes, forecast_stages, held_bytes
from a2tg_jax.training.options import SENSIBLE_GAUSSIANS
from a2tg_jax.training.reports import saved_work

KEPT_STATES = 3
"""Number of checkpoints on disk while a new one is written."""
PICTURE_PER_PIXEL = 2
"""Bytes on disk of each picture of a sheet."""
DRAWN = 0.75
"""Time in which a view is drawn and measured, as a share of an iteration."""
DRAWING_PROGRAM = 1 / 8
"""Time to compile the program that draws a model, as a share of the compilation of a step: 0.12 and 0.14 for the stages
of `bytewise` on two cores."""
PAGES = 1 / 4
"""Time of the figures, the point cloud, the page and the report, as a share of the same: 9 s against 29 s there."""
LONG = 10_000
"""Number of iterations beyond which CPUs take hours."""
SMALL_SIDE = 100
"""Longer side of photographs, in pixels, below which a downscale is likely to be a mistake."""
OPTIONS = {
    "photographs": ("downscale", "batch_size"),
    "model": ("memory_budget", "sh_degree"),
}
"""Options to change, by the largest part of the memory; limits of the number of Gaussians precede them."""


class Bytes(NamedTuple):
    """Bytes in memory at one time, by purpose."""

    program: float = 0
    """The program and its libraries; 0 on accelerators."""
    photographs: float = 0
    model: float = 0
    """Parameters, gradients and moments."""

    @property
    def total(self) -> float:
        return sum(self)


@dataclasses.dataclass(frozen=True)
class RunForecast:
    """The least that runs need. Renders and compiled programs come on top; XLA says how much before a stage begins."""

    phases: Mapping[str, Bytes]
    """Memory of each stage, by name."""
    disk_bytes: float
    """Bytes in the run folder."""
    limits: tuple[str, ...] = ()
    """Options that limit the number of Gaussians."""
    whole: Mapping[str, float] = dataclasses.field(default_factory=dict)
    """Bytes that must fit on one of several devices, by stage (`StageForecast.whole_bytes`)."""

    @property
    def peak(self) -> tuple[str, Bytes]:
        """Phase with the most memory, and its parts."""
        return max(self.phases.items(), key=lambda item: item[1].total)

    def text(self, limit: float) -> str:
        """Return the forecast as lines of text."""
        phase, needed = self.peak
        return (
            f"memory: at least {in_bytes(needed.total)} ({phase}: {_parts(needed)}); {in_bytes(limit)} may be used\n"
            f"disk: about {in_bytes(self.disk_bytes)} in the run folder"
        )

    def check_memory(self, limit: float) -> None:
        """Raise ValueError, naming the options to change, if the run needs more bytes than it may use."""
        phase, needed = self.peak
        if needed.total <= limit:
            return
        parts = needed._asdict()
        largest = max(parts, key=parts.__getitem__)
        if largest == "program":  # No option makes it smaller.
            advice = f"the program itself takes about {in_bytes(needed.program)} of it:"
        else:
            advice = f"change {self._options(largest)}, or"
        raise ValueError(
            f"the run would need at least {in_bytes(needed.total)} of memory ({phase}: {_parts(needed)}), and "
            f"{in_bytes(limit)} may be used: {advice} allow more with `max_memory`"
        )

    def check_one_device(self, limit: float) -> None:
        """Raise ValueError if a device has no room for its share of the state, and for all of it between steps."""
        phase, needed = max(self.whole.items(), key=lambda item: item[1], default=("", 0.0))
        if needed > limit:
            raise ValueError(
                f"the state of {phase} must fit on one device: that takes about {in_bytes(needed)}, and "
                f"{in_bytes(limit)} may be used: change {self._options('model')}"
            )

    def check_disk(self, out: Path) -> None:
        """Raise ValueError unless the disk of a folder, which need not exist, has room for the run."""
        path = Path(os.path.abspath(out))
        existing = next(folder for folder in (path, *path.parents) if folder.is_dir())
        free = shutil.disk_usage(existing).free
        if self.disk_bytes > free:
            raise ValueError(
                f"{out} needs about {in_bytes(self.disk_bytes)} for models and checkpoints, but the disk has "
                f"{in_bytes(free)}: make room, or choose another `out`, fewer Gaussians or fewer `compare`"
            )

    def _options(self, largest: str) -> str:
        """Return the options to change if this part of the memory is the largest."""
        limits = self.limits if largest == "model" else ()
        *others, last = dict.fromkeys(f"`{name}`" for name in (*limits, *OPTIONS[largest]))
        return f"{', '.join(others)} or {last}" if others else last


def forecast_run(scene: Scene, plan: RunPlan, num_given: int | None = None, num_devices: int = 1) -> RunForecast:
    """Return what a run needs at least of memory and disk space (host; nothing is compiled). `num_given` is the number
    of Gaussians of the file that replaces the main system's first stage; memory is the sum over all devices."""
    # On accelerators programs and photographs take the host's memory, not the device's.
    is_host = default_platform() == "cpu"
    held = held_bytes(scene)
    program = max(0, used_memory() - held) if is_host else 0
    # Each of several devices draws with a copy of the model, and has gradients of all rows.
    copies = STATES + (2 * num_devices if num_devices > 1 else 1)
    stages = _forecasts(scene, plan, num_given, num_devices)
    phases = {}
    for name, stage in stages.items():
        if stage.is_trained:
            batch = plan[name].system.batch_size // num_devices
            fed = fed_bytes(scene.train, batch, has_depths=plan[name].stage.has_depths)
            phases[name] = Bytes(program, is_host * held + num_devices * fed, copies * stage.model_bytes)
    model_bytes = [stage.model_bytes for stage in stages.values()]
    # Models stay, the states that can be continued, checkpoints of one stage at a time, and sheets of photograph,
    # renders and error. The last stage's state is one of its checkpoints.
    kept = sum(stages[name].model_bytes for name in plan.kept_states[:-1])
    pictures_per_sheet = 3 + max(1, len(plan.chains) - 1)
    pictures = PICTURE_PER_PIXEL * pictures_per_sheet * _num_pixels(scene.test or scene.train)
    limits = [] if num_given is None else ["init"]
    for planned in plan.stages:
        limits += planned.system.limits()
    return RunForecast(
        phases,
        disk_bytes=sum(model_bytes) + STATES * (kept + KEPT_STATES * max(model_bytes)) + pictures,
        limits=tuple(dict.fromkeys(limits)),
        whole={name: stage.whole_bytes for name, stage in stages.items()},
    )


def _forecasts(scene: Scene, plan: RunPlan, num_given: int | None, num_devices: int) -> dict[str, StageForecast]:
    """Return the forecast of each stage by name."""
    stages: dict[str, StageForecast] = {}
    for chain in plan.chains.values():
        num = num_given if chain[0] == plan.main[0] else None
        stages |= zip(chain, forecast_stages(scene, plan[chain[-1]].system, num, num_devices), strict=True)
    return stages


def _num_pixels(views: Sequence[View]) -> int:
    return sum(view.camera.width * view.camera.height for view in views)


def time_after(
    scene: Scene, plan: RunPlan, names: Sequence[str], num_given: int | None = None, num_tuning: int = 0
) -> dict[str, RestOfRun]:
    """Return what follows each of the stages that are to be trained: others, the run's evaluation, and `num_tuning`
    iterations that tune a file. `num_given` as in `forecast_run`."""
    stages = _forecasts(scene, plan, num_given, 1)
    num_drawn = len(plan.names) * (len(scene.train) + len(scene.test))
    rests = {}
    for index, name in enumerate(names):
        later = names[index + 1 :]
        # An iteration of a later stage is taken to last as long as one of this stage, and a step to compile as long.
        iterations = 0.0
        for other in later:
            stage = plan[other].stage
            iterations += stage.iterations - saved_work(scene.train) * stage.num_coarse
        num_programs: float = sum(stages[other].num_programs for other in later)
        num_programs += DRAWING_PROGRAM * len(plan.names) + PAGES
        largest = max((stages[other].model_bytes for other in later), default=0)
        rests[name] = RestOfRun(iterations + DRAWN * num_drawn + num_tuning, num_programs, largest)
    return rests


def checked_forecast(
    scene: Scene, record: RunRecord, max_memory: int | None, num_devices: int = 1, num_given: int | None = None,
    out: Path | None = None,
) -> str:  # fmt: skip
    """Return the forecast of a run in lines of text, for at most `max_memory` bytes (None: what is available). `out` is
    the folder of a new run, whose disk must have room for it; None for a resumed run. Raises ValueError if the run
    cannot fit, naming the options to change. Other arguments as in `forecast_run`."""
    forecast = forecast_run(scene, record.plan, num_given, num_devices)
    limit = allowed_memory(max_memory, num_devices)
    forecast.check_memory(limit)
    if num_devices > 1:
        forecast.check_one_device(allowed_memory(max_memory))
    if out is not None:
        forecast.check_disk(out)
    text = forecast.text(limit)
    side = _longest_side(scene)
    num_iterations = sum(stage.iterations for stage in record.options.all_stages())
    is_long = num_iterations > LONG or (record.preset == "quick" and side > QUICK_SIDE)
    has_quick = default_platform() == "cpu" and "quick" in type(record.options).presets()
    if out is not None and is_long and has_quick:
        text += f"\nquicker on CPUs: {quick_flags(side, record.scene.downscale)} takes minutes"
    return text


def _longest_side(scene: Scene) -> int:
    return max(max(view.camera.width, view.camera.height) for view in scene.train)


def doubts_about(scene: Scene, record: RunRecord) -> list[str]:
    """Return why a run would show little or take long, with better values: a small or huge memory budget, or a
    downscale that leaves few pixels."""
    doubts = []
    options = record.options
    budget = options.budget_bytes
    one = options.initial_bytes
    # A file budget without a memory budget sets that as well.
    of_file = record.unbudgeted() != record
    name = "file_budget" if of_file else "memory_budget"
    share = MEMORY_OF_FILE if of_file else 1.0

    def size_for(num_gaussians: float) -> str:
        return in_bytes(num_gaussians * one / share).replace(" ", "")

    if options.small_budget and not of_file:
        doubts.append(f"{options.small_budget}; it is in bytes of the model in memory")
    elif options.small_budget and budget is not None:
        doubts.append(
            f"`file_budget` has room for about {budget // one:.0f} Gaussians, and scenes need thousands: "
            f"{size_for(SENSIBLE_GAUSSIANS)} holds about {SENSIBLE_GAUSSIANS:,}"
        )
    if record.scene.is_built_in:
        return doubts  # Built-in scenes are drawn as small as tests need it.
    pixels = _num_pixels(scene.train)
    if budget is not None and budget > pixels * one:
        doubts.append(
            f"`{name}` has room for more Gaussians ({budget / one:,.0f}) than the photographs have pixels "
            f"({pixels:,}): {size_for(0.1 * pixels)} holds one for ten pixels"
        )
    downscale = record.scene.downscale
    side = _longest_side(scene)
    if downscale > 1 and side < SMALL_SIDE:
        largest = next(view.camera for view in scene.train if max(view.camera.width, view.camera.height) == side)
        sensible = math.ceil(side * downscale / QUICK_SIDE)
        doubts.append(
            f"`downscale` {downscale} leaves photographs of {largest.width}×{largest.height} pixels, which show "
            f"little: `downscale` {sensible} makes the longer side {side * downscale // sensible:,}"
        )
    return doubts


def room_for_photographs(max_memory: int | None) -> int | None:
    """Return the bytes photographs may take of a memory limit; None as in `load_scene`."""
    return None if max_memory is None else int(SHARE_OF_MEMORY * max_memory)


def _parts(needed: Bytes) -> str:
    """Return the parts of the memory in words."""
    return ", ".join(f"{name} {in_bytes(size)}" for name, size in needed._asdict().items())
