"""Forecast of a run's memory, disk and time, and the refusal of runs that cannot fit."""

import dataclasses
import math
from collections.abc import Mapping, Sequence

import jax

from a2tg_jax.core.budget import bytes_of, megabytes_of
from a2tg_jax.data import Scene
from a2tg_jax.data.photo_store import SHARE_OF_MEMORY
from a2tg_jax.host.cores import num_threads
from a2tg_jax.host.machine import default_platform
from a2tg_jax.host.memory import memory_limit
from a2tg_jax.host.text import counted, in_bytes
from a2tg_jax.results.plan import RunPlan
from a2tg_jax.results.record import RunRecord
from a2tg_jax.training import System
from a2tg_jax.training.cost import (
    COMPILER,
    FIRST_PROGRAM,
    FURTHER_PROGRAM,
    FURTHER_STAGE,
    MB,
    PROCESS,
    STATES,
    Bytes,
    StageForecast,
    forecast_stages,
    held_bytes,
    iteration_seconds,
    largest_view,
)

REPORT = 290 * MB
"""Bytes that evaluation, figures and the report compile and import."""
EVALUATION_PER_PIXEL = 150
"""Bytes of a view that is rendered, with depth and normals, compared and drawn."""
KEPT_STATES = 3
"""Number of checkpoints of a stage on disk while a new one is written."""
PICTURE_PER_PIXEL = 2
"""Bytes on disk of each picture of a sheet."""
ROUGHLY = 2.0
"""Factor by which the time may be shorter or longer."""
PROGRAM_SECONDS = 6.0
"""Time to compile a step on CPUs: 3 to 11 s on two cores, by system."""
LONG = 1800
"""Seconds beyond which a forecast names a quicker way to train."""
QUICK = "quick"
"""Preset of short runs."""
QUICK_SIDE = 640
"""Longer side of the photographs, in pixels, with which `quick` takes minutes on two cores."""
OPTIONS = {
    "photographs": "--downscale, or batch_size",
    "model": "{limits}, memory_budget or sh_degree",
    "gradients": "{limits}, memory_budget, batch_size or sh_degree",
    "pixels": "--downscale",
    "corrections": "corrections.grid.size or --downscale",
}
"""Options to change, by what needs most of the memory; `limits` are those of the systems' number of Gaussians."""
OPTIONS_OF_FILES = {
    "model": "sh_degree, or a smaller --init file",
    "gradients": "batch_size, sh_degree, or a smaller --init file",
}
"""Options to change where a file decides on the number of Gaussians."""


@dataclasses.dataclass(frozen=True)
class RunForecast:
    """Estimate of what a run will take."""

    phases: Mapping[str, Bytes]
    """Memory at the peak of each stage, by name, and of the evaluation."""
    disk_bytes: float
    """Bytes in the run folder."""
    seconds: float
    """Training time on CPUs; 0 if it cannot be estimated."""
    limits: tuple[str, ...] = ()
    """Names of the options that limit the number of Gaussians."""
    whole: Mapping[str, float] = dataclasses.field(default_factory=dict)
    """Bytes that one of several devices must have room for, by stage (`StageForecast.whole_bytes`)."""
    num_programs: int = 0
    """Steps that are compiled, as far as events say."""
    of_file: frozenset[str] = frozenset()
    """Names of the phases whose number of Gaussians is that of a file."""

    @property
    def peak(self) -> tuple[str, Bytes]:
        """Phase with the most memory, and its parts."""
        return max(self.phases.items(), key=lambda item: item[1].total)

    def told(self, limit: float) -> str:
        """Return the forecast as lines of text."""
        phase, needed = self.peak
        told = f"{phase}: {_told_parts(needed)}"
        lines = [
            f"memory: about {in_bytes(needed.total)} at the peak ({told}); {in_bytes(limit)} may be used",
            f"disk: about {in_bytes(self.disk_bytes)} in the run folder",
        ]
        if self.seconds:
            compiling = _between(PROGRAM_SECONDS * self.num_programs)
            lines.append(
                f"time: very roughly {_between(self.seconds)} of training on {counted(num_threads(), 'core')}, and "
                f"{compiling} of compiling {counted(self.num_programs, 'program')}; the first steps of each stage tell "
                "it better"
            )
        return "\n".join(lines)

    def check(self, limit: float) -> None:
        """Raise if the run cannot fit.

        Args:
          limit: bytes that may be used.

        Raises:
          ValueError: naming the options to change.
        """
        phase, needed = self.peak
        if needed.total <= limit:
            return
        largest = max(needed._asdict().items(), key=lambda item: item[1])[0]
        advice = (
            f"change {self._told_options(largest, phase)}, or"
            if largest != "program"
            else (f"the program itself takes about {in_bytes(needed.program)} of it:")
        )
        raise ValueError(
            f"the run would need about {in_bytes(needed.total)} of memory ({phase}: {_told_parts(needed)}), and "
            f"{in_bytes(limit)} may be used: {advice} allow more with --max-memory"
        )

    def check_one_device(self, limit: float) -> None:
        """Raise if one of several devices has no room for the finished model besides its share of the state.

        Raises:
          ValueError: naming the options to change.
        """
        phase, needed = max(self.whole.items(), key=lambda item: item[1], default=("", 0.0))
        if needed > limit:
            raise ValueError(
                f"the model of {phase} must fit on one device: that takes about {in_bytes(needed)}, and "
                f"{in_bytes(limit)} may be used: change {self._told_options('model', phase)}"
            )

    def _told_options(self, largest: str, phase: str) -> str:
        """Return the options to change if this part of a phase's memory is the largest."""
        if phase in self.of_file and largest in OPTIONS_OF_FILES:
            return OPTIONS_OF_FILES[largest]
        own = (name for name in self.limits if name != "memory_budget")
        return OPTIONS[largest].format(limits=", ".join(own)).removeprefix(", ")


def forecast_run(scene: Scene, plan: RunPlan, num_given: int | None = None, num_devices: int = 1) -> RunForecast:
    """Return a forecast of what the run will take (host; nothing is compiled).

    Args:
      scene: the run's scene.
      plan: its stages.
      num_given: Gaussians of the file in place of the main system's first stage; None without one.
      num_devices: number of devices that train together; memory is that of all of them.
    """
    is_host = default_platform() == "cpu"
    stages = _stages(scene, plan, num_given, num_devices)
    resident, phases = PROCESS + FIRST_PROGRAM - FURTHER_STAGE, {}
    for name, stage in stages.items():
        if not stage.is_trained:
            continue
        resident += FURTHER_STAGE + FURTHER_PROGRAM * (stage.num_programs - 1)
        compiling = max(COMPILER - stage.bytes.gradients - stage.bytes.pixels, 0)  # before there are any of these
        phases[name] = stage.bytes._replace(program=(resident + compiling) if is_host else 0)
    shown = Bytes(
        program=(resident + REPORT) if is_host else 0,
        photographs=held_bytes(scene) if is_host else 0,
        model=sum(stage.model_bytes for stage in stages.values()),
        pixels=EVALUATION_PER_PIXEL * largest_view((*scene.test, *scene.train)),
    )
    seconds = sum(stage.seconds for stage in stages.values()) if is_host else 0
    systems = {id(planned.system): planned.system for planned in plan.stages}.values()
    limits = tuple(dict.fromkeys(name for system in systems for name in system.limits()))
    disk = _disk_bytes(scene, plan, list(stages.values()))
    whole = {name: stage.whole_bytes for name, stage in stages.items()}
    of_file = {name for name in stages if num_given == stages[name].num_rows and plan.begins_like_main(name)}
    of_file |= {"evaluation"} if of_file == stages.keys() else set()
    sizes = {view.picture.size for view in scene.train}
    programs = len(sizes) * sum(stage.num_programs for stage in stages.values())
    return RunForecast({**phases, "evaluation": shown}, disk, seconds, limits, whole, programs, frozenset(of_file))


def quick_downscale(longest_side: int) -> int:
    """Return the downscale with which photographs of this longer side train quickly."""
    return max(1, math.ceil(longest_side / QUICK_SIDE))


def quick_flags(downscale: int) -> list[str]:
    """Return the flags of a quick training with a downscale."""
    return ["--preset", QUICK, *(["--downscale", str(downscale)] if downscale > 1 else [])]


def quicker_text(scene: Scene, record: RunRecord, num_given: int | None = None) -> str:
    """Return the flags with which a long run on CPUs gets quicker, with their forecast; empty for other runs.

    Args:
      scene: the scene of the record, downscaled as it says.
      record: the run.
      num_given: as in `forecast_run`.
    """
    seconds = forecast_run(scene, record.plan, num_given).seconds
    presets = type(record.system).presets()
    if seconds * ROUGHLY <= LONG or QUICK not in presets:
        return ""
    downscale = quick_downscale(max(max(view.camera.width, view.camera.height) for view in scene.train))
    system = dataclasses.replace(presets[QUICK], memory_budget=record.system.memory_budget)
    quick = dataclasses.replace(record, system=system, preset=QUICK)
    quick_seconds = _training_seconds(scene, quick.plan, downscale, num_given)
    if quick_seconds > seconds / 2:
        return ""
    flags = " ".join(quick_flags(downscale * record.scene.downscale))
    return f"quicker: {flags} takes very roughly {_between(quick_seconds)}"


def _training_seconds(scene: Scene, plan: RunPlan, downscale: int, num_given: int | None) -> float:
    """Return the training time on CPUs if the photographs are downscaled further."""
    forecasts = _stages(scene, plan, num_given)
    return sum(
        planned.stage.iterations
        * planned.system.batch_size
        * iteration_seconds(scene.train, forecasts[planned.name].num_rows, downscale)
        for planned in plan.stages
        if forecasts[planned.name].is_trained
    )


def bytes_allowed(max_memory: float | str | None) -> int | None:
    """Return the bytes of --max-memory, written like a memory budget.

    Raises:
      ValueError: if it is not.
    """
    megabytes = megabytes_of(max_memory, "--max-memory")
    return None if megabytes is None else bytes_of(megabytes)


def allowed_memory(max_memory: int | None, num_devices: int = 1) -> int:
    """Return the bytes a run may use: the limit asked for, or what the machine or so many of its accelerators have
    available (host)."""
    if max_memory is not None:
        return max_memory
    stats = jax.local_devices()[0].memory_stats() or {}
    return num_devices * stats.get("bytes_limit", 0) or memory_limit()


def room_for_photographs(max_memory: int | None) -> int | None:
    """Return the bytes photographs may take of a memory limit; None as in `load_scene`."""
    return None if max_memory is None else int(SHARE_OF_MEMORY * max_memory)


def tell_forecast(
    scene: Scene, plan: RunPlan, max_memory: int | None, num_devices: int = 1, num_given: int | None = None
) -> None:
    """Print the forecast of a run, on so many devices together. `num_given` is as in `forecast_run`.

    Raises:
      ValueError: if that cannot fit, naming the options to change.
    """
    found, limit = forecast_run(scene, plan, num_given, num_devices), allowed_memory(max_memory, num_devices)
    found.check(limit)
    if num_devices > 1:
        found.check_one_device(allowed_memory(max_memory))
    print(found.told(limit), flush=True)


def _stages(scene: Scene, plan: RunPlan, num_given: int | None, num_devices: int = 1) -> dict[str, StageForecast]:
    """Return the forecast of every stage, by name."""
    systems: dict[int, tuple[System, list[StageForecast]]] = {}
    for planned in plan.stages:
        if id(planned.system) not in systems:
            num = num_given if plan.begins_like_main(planned.name) else None
            systems[id(planned.system)] = planned.system, list(forecast_stages(scene, planned.system, num, num_devices))
    return {planned.name: systems[id(planned.system)][1][planned.index] for planned in plan.stages}


def _disk_bytes(scene: Scene, plan: RunPlan, stages: Sequence[StageForecast]) -> float:
    """Return the bytes of checkpoints, models, and pictures of the test views."""
    views = scene.test or scene.train
    pixels = sum(view.camera.width * view.camera.height for view in views)
    num_pictures = 3 + max(1, len(plan.chains) - 1)
    kept = sum((KEPT_STATES * STATES * stage.is_trained + 1) * stage.model_bytes for stage in stages)
    return kept + PICTURE_PER_PIXEL * num_pictures * pixels


def _told_parts(needed: Bytes) -> str:
    """Return the parts of the memory in words; corrections only if there are any."""
    parts = needed._asdict()
    return ", ".join(f"{name} {in_bytes(size)}" for name, size in parts.items() if size or name != "corrections")


def _between(seconds: float) -> str:
    """Return the shortest and the longest time of a rough estimate."""
    return f"{_duration(seconds / ROUGHLY)} to {_duration(seconds * ROUGHLY)}"


def _duration(seconds: float) -> str:
    if seconds < 90:
        return f"{math.ceil(seconds)} s"
    return f"{round(seconds / 60)} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"
