"""Reports of a stage to the user: its progress, a forecast of its duration, and warnings.

You are warned of events that do nothing or compile too often, and if training does not learn.
"""

import collections
import dataclasses
import datetime
import time
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple, Self

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from a2tg_jax.base.text import counted
from a2tg_jax.base.user_warnings import warn
from a2tg_jax.events import Change, HostEvent, Times
from a2tg_jax.scene import View, view_image
from a2tg_jax.training.batches import BatchOrder, can_halve
from a2tg_jax.training.options import System
from a2tg_jax.training.stage import Background, Stage
from a2tg_jax.training.step import TrainState

TIMED_SECONDS = 2.0
"""Least time of the steps from which a duration is forecast."""
TIMED_STEPS = 3
"""Least number of these steps."""
HALVED_WORK = 0.55
"""Time of an iteration with halved photographs, as a share of one with whole photographs, about (scarf, fox)."""


class RestOfRun(NamedTuple):
    """Work that is left in a run after a stage."""

    iterations: float = 0.0
    """Time of its steps, as a number of iterations of that stage."""
    programs: float = 0.0
    """Time to compile other programs, as a number of compilations of a step."""
    model_bytes: float = 0.0
    """Bytes of the largest model."""


class Display:
    """A display of a stage's progress, which shows nothing. Subclasses show it, such as `ProgressBar`."""

    def __init__(self, title: str, done: int, total: int):
        """Args:
        title: name of the stage.
        done: number of iterations that were done before.
        total: number of all iterations.
        """

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        """End the display."""

    def update(
        self, done: int, loss: float, psnr: float, row: Mapping[str, float] | None, left: datetime.timedelta | None
    ) -> None:
        """Show that a step is done.

        Args:
          done: number of iterations that are done, of `total`.
          loss: loss of the step.
          psnr: its training PSNR in dB.
          row: last row of the history; None: there is none yet.
          left: remaining time of the run; None: it is not known yet.
        """

    def tell(self, text: str) -> None:
        """Show a forecast of remaining time and memory in words, which is made twice in a stage."""


class Progress(NamedTuple):
    """How the progress of a stage is shown."""

    display: type[Display] | None = None
    """Class of the display; None: it is not shown."""
    title: str | None = None
    """Its title; None: the stage's name."""
    after: RestOfRun = RestOfRun()
    """Work after the stage, for the remaining time that is shown and the memory of later stages."""


class Pace:
    """Time of an iteration, and forecasts of a stage's duration: early, and at a half."""

    def __init__(
        self, first: int, total: int, now: Callable[[], float] = time.perf_counter, *, most_gaussians: int = 0,
        num_coarse: int = 0, saved: float = 0.0, after: RestOfRun = RestOfRun(),  # noqa: B008 - immutable
    ):  # fmt: skip
        """`first` iterations were done before, `total` is the last one, and `now` is a clock in seconds. Gaussians grow
        to at most `most_gaussians`; 0: they do not. In the first `num_coarse` iterations photographs may be halved,
        which saves a share `saved` (`saved_work`) of their time."""
        self._total = total
        self._num_coarse = num_coarse
        self._saved = saved
        self._now = now
        self._most = most_gaussians
        self._after = after
        self._told_at = [first, (first + total) // 2]
        self._before: tuple[int, float, int] | None = None
        self._steps = 0
        self._work = 0.0
        self._seconds = 0.0
        self._ahead = 0
        self._seconds_a_program = 0.0

    def time(self, done: int, num_compiled: int, ahead: int = 0, seconds_a_program: float = 0.0) -> None:
        """Time the iterations since the last call, unless programs were compiled meanwhile.

        Numbers of iterations and compiled programs are totals so far; `ahead` is about how many will be compiled.
        """
        now = self._now()
        self._ahead = ahead
        self._seconds_a_program = seconds_a_program
        if self._before is not None:
            done_before, before, num_compiled_before = self._before
            if num_compiled == num_compiled_before:
                self._steps += done - done_before
                self._work += self._work_of(done_before, done)
                self._seconds += now - before
        self._before = done, now, num_compiled

    def forecast_at(self, done: int) -> str | None:
        """Return a forecast if it is time for one and enough was timed since the last, or None."""
        left = self.left(done)
        is_time = bool(self._told_at) and self._told_at[0] <= done < self._total
        if left is None or not is_time or self._steps < TIMED_STEPS or self._seconds < TIMED_SECONDS:
            return None
        is_growing = self._most and len(self._told_at) > 1
        growing = f"; more as Gaussians are added, up to {self._most:,}" if is_growing else ""
        compiling = f", with {counted(self._ahead, 'program')} to compile" if self._ahead else ""
        pace = f"{1e3 * self._seconds / self._steps:,.0f} ms an iteration"
        self._told_at = [later for later in self._told_at[1:] if later > done]
        self._steps = 0
        self._work = 0.0
        self._seconds = 0.0
        return f"{pace}, about {left} left{compiling}{growing}"

    def left(self, done: int) -> datetime.timedelta | None:
        """Return the remaining time of the run, known compilations included; None before a step was timed."""
        if self._steps == 0:
            return None
        work = self._work_of(done, self._total) + self._after.iterations
        of_steps = work * self._seconds / self._work
        programs = self._ahead + self._after.programs
        return datetime.timedelta(seconds=round(of_steps + programs * self._seconds_a_program))

    def _work_of(self, first: int, last: int) -> float:
        """Return the work of the iterations after `first` up to `last`, in iterations with whole photographs."""
        num_coarse = min(last, self._num_coarse) - min(first, self._num_coarse)
        return last - first - self._saved * num_coarse


def saved_work(views: Sequence[View]) -> float:
    """Return the share of an iteration's time that halved photographs save, as a mean over views: small ones are not
    halved."""
    return (1 - HALVED_WORK) * float(np.mean([can_halve(view.picture.size) for view in views]))


CHECKED_AFTER = 0.2
"""Share of the first stage after which training must have learned something."""
LEAST_ITERATIONS = 200
"""Training is not judged earlier than this."""
NUM_COMPARED = 16
"""Iterations before the check whose PSNR is averaged."""
ONE_COLOR = 100.0
"""PSNR of one flat colour in dB from which a photograph is of one colour, such as an empty one; rounding leaves 130 or
more."""
NEARLY_FLAT = 40.0
"""PSNR of one flat colour in dB, above which photographs do not show whether a model has learned."""
ADVICE = (
    "Compare the photographs with renders from their cameras, and check that the points fit; then try fewer "
    "initial_gaussians, a lower initial_opacity or lower learning rates, and refine_poses if poses may be wrong"
)
FLAT_BACKGROUNDS: dict[Background, float] = {"black": 0.0, "white": 1.0, "random": 0.5}


class LearningCheck:
    """Warn once if training is not above a flat colour per view after a fifth of its first stage."""

    def __init__(
        self, views: tuple[View, ...], order: BatchOrder, iterations: int, background: Background, *, is_first: bool,
        small_budget: str = "",
    ):  # fmt: skip
        """Only the first stage (`is_first`) is checked. `small_budget` is what a small memory budget has room for."""
        self._views = views
        self._order = order
        self._level = FLAT_BACKGROUNDS[background]
        self._advice = f"{small_budget}: raise it" if small_budget else ADVICE
        at = max(round(CHECKED_AFTER * iterations), LEAST_ITERATIONS)
        self._at = at if is_first and at <= iterations else 0
        self._seen: collections.deque[tuple[int, float]] = collections.deque(maxlen=NUM_COMPARED)

    def observe(self, iteration: int, psnr: float) -> None:
        """Record the training PSNR of an iteration in dB; warn once if it stays low."""
        if iteration <= self._at:
            self._seen.append((iteration, psnr))
        if iteration != self._at:
            return
        reached = []
        flat = []
        # Flat colours of the same views, because some are easier than others.
        for earlier, psnr in self._seen:
            of_views = [self._flat_psnr(self._views[index]) for index in self._order.indices(earlier)]
            if max(of_views) < ONE_COLOR:
                reached.append(psnr)
                flat.append(np.mean(of_views))
        if reached and not has_learned(float(np.mean(reached)), float(np.mean(flat))):
            warn(
                f"training does not learn: {np.mean(reached):.1f} dB on the training views after {self._at:,} "
                f"iterations, where one flat colour per view reaches {np.mean(flat):.1f} dB. {self._advice}"
            )

    def _flat_psnr(self, view: View) -> float:
        mask = None if view.mask is None else view.mask.read()
        return float(jax.jit(flat_psnr)(view_image(view, (self._level,) * 3), mask))


def has_learned(psnr: float, flat: float) -> bool:
    """Return whether a PSNR is above `flat_psnr`; always, if the photographs are nearly flat."""
    return psnr > flat or flat > NEARLY_FLAT


def flat_psnr(target: Array, mask: Array | None = None) -> Array:
    """Return the PSNR in dB of the best image of one flat colour, which a model reaches without learning more.

    The target [H, W, 3] is clipped to [0, 1] first; of the mask [H, W], True pixels count.
    """
    target = jnp.clip(target, 0, 1)
    weight = jnp.ones(target.shape[:2], target.dtype) if mask is None else jnp.asarray(mask, target.dtype)
    weight = (weight / jnp.sum(weight))[:, :, None]
    mean = jnp.sum(weight * target, axis=(0, 1), keepdims=True)
    return -10 * jnp.log10(jnp.mean(jnp.sum(weight * (target - mean) ** 2, axis=(0, 1))))


MANY_PROGRAMS = 3
"""Compilations because of one event after which a warning says how to keep shapes."""


@dataclasses.dataclass
class Effects:
    """What an event between steps has done so far."""

    num_applied: int = 0
    num_compiled: int = 0
    """Number of its changes of shape after which a step was compiled."""
    has_changed: bool = False
    """Whether it has ever changed the model or the moments."""
    unused: str | None = None
    """Last `Change.unused`; None if the event made a difference at any time."""


class StageEffects:
    """What the events of a stage do; each process has the same."""

    def __init__(self, stage: Stage, system: System, num_sizes: int):
        """The system names the options in messages; each image size has a program."""
        self._stage = stage
        self._system = system
        self._num_sizes = num_sizes
        self._on_host: dict[int, tuple[HostEvent, Times, Effects]] = {}
        for place, (event, times) in enumerate(zip(stage.events, stage.times, strict=True)):
            if isinstance(event, HostEvent):
                self._on_host[place] = event, times, Effects()
        self._reshaped_by: list[int] = []
        self.num_compiled = 0
        """Number of compiled steps so far."""
        self._seconds = 0.0
        self._warn_of_never()

    def apply(self, place: int, state: TrainState, change: Change) -> None:
        """Record a change of the state by the event at an index."""
        _, _, effects = self._on_host[place]
        leaves, structure = jax.tree.flatten((state.model, state.moments, state.events[place]))
        new, new_structure = jax.tree.flatten((change.model, change.moments, change.state))
        is_reshaped: bool = structure != new_structure  # type: ignore[operator]
        is_reshaped = is_reshaped or [jax.typeof(leaf) for leaf in leaves] != [jax.typeof(leaf) for leaf in new]
        if is_reshaped:
            self._reshaped_by.append(place)
        # Values are compared until the event has changed some once, which is nearly always the first time.
        if not effects.has_changed:
            values = jax.tree.leaves((state.model, state.moments))
            new_values = jax.tree.leaves((change.model, change.moments))
            pairs = zip(values, new_values, strict=True)
            effects.has_changed = is_reshaped or not all(a is b or np.array_equal(a, b) for a, b in pairs)
        if effects.num_applied == 0 or not change.unused:
            effects.unused = change.unused
        effects.num_applied += 1

    def launch(self, iteration: int, num_compiled: int, seconds: float) -> None:
        """Record a step that was launched, the number of programs that were compiled for it, and the seconds that this
        took. Warn if an event is why steps are compiled again and again."""
        reshaped_by = self._reshaped_by
        self._reshaped_by = []
        if num_compiled == 0:
            return
        self.num_compiled += num_compiled
        self._seconds += seconds
        for place in dict.fromkeys(reshaped_by):
            event, times, effects = self._on_host[place]
            effects.num_compiled += 1
            if effects.num_compiled == MANY_PROGRAMS and type(event).with_room is HostEvent.with_room:
                left = len(self._ahead(times, iteration))
                warn(
                    f"stage {self._stage.name!r}: {type(event).__name__} has changed shapes {MANY_PROGRAMS} times, and "
                    f"each time a step was compiled, last for {seconds:.0f} s; it happens {counted(left, 'time')} "
                    "more: keep shapes, by keep_rows(model, moments, state, is_kept) to remove Gaussians, or by "
                    "padding in with_room for what will be added"
                )

    def programs_ahead(self, iteration: int) -> int:
        """Return the number of programs that events will cause from an iteration on, about."""
        num = 0.0
        length = self._stage.iterations
        for event, times, effects in self._on_host.values():
            left = len(self._ahead(times, iteration))
            if left and effects.num_applied:  # As often as so far.
                num += left * effects.num_compiled / effects.num_applied
            elif left:
                num += left * event.num_programs(length) / len(times)
        return round(num * self._num_sizes)

    @property
    def seconds_a_program(self) -> float:
        """Mean time of a compilation so far."""
        return self._seconds / max(1, self.num_compiled)

    def _ahead(self, times: Times, iteration: int) -> list[int]:
        """Return the times from an iteration on after which there are steps."""
        return [time for time in times if iteration <= time < self._stage.iterations]

    def _warn_of_never(self) -> None:
        """Warn of events that never happen within the stage."""
        end = self._stage.iterations
        for event, times in zip(self._stage.events, self._stage.times, strict=True):
            if not times:
                continue
            first = next((time for time in times if time >= 1), times[-1])
            if not 1 <= first <= end:
                warn(
                    f"stage {self._stage.name!r}: {self._system.path_of(event)} never happens: it is first due at "
                    f"iteration {first:,} of {end:,}"
                )

    def warn_at_end(self, num_refused: int, num_rows: int) -> None:
        """Warn of events that happened at all their times and never made a difference, and of Gaussians that events
        should have added and that found no room among all rows."""
        unused = []
        for event, times, effects in self._on_host.values():
            # In a resumed stage, the first times may have been before.
            if not effects.num_applied or effects.num_applied < len(times):
                continue
            name = self._system.path_of(event)
            if not effects.has_changed:
                unused.append(f"{name} changed nothing, though it happened {effects.num_applied:,} times")
            elif effects.unused:
                unused.append(f"{name}.{effects.unused}")
        if unused:
            warn(f"stage {self._stage.name!r}: {'; '.join(unused)}")
        if num_refused:
            events = [event for event in self._stage.events if event.limited_by]
            caps = [f"{self._system.path_of(event)}.{event.limited_by}" for event in events]
            advice = f": raise {' or '.join(caps)}" if caps else ""
            warn(
                f"stage {self._stage.name}: {num_refused:,} times there was no room for a Gaussian that should have "
                f"been added, all {num_rows:,} rows being in use{advice}"
            )
