"""What events on the host do in a stage: programs that are compiled because of them, and what made no difference."""

import dataclasses
import warnings
from typing import Any

import jax
import numpy as np

from a2tg_jax.events import Change, Event, HostEvent, StepEvent
from a2tg_jax.host.text import counted
from a2tg_jax.parallel.rows import on_host
from a2tg_jax.training.options import System
from a2tg_jax.training.stage import Stage
from a2tg_jax.training.step import TrainState

MANY_PROGRAMS = 3
"""Compilations because of one event after which it is told how to keep shapes."""


@dataclasses.dataclass
class Effects:
    """What an event on the host has done so far."""

    num_applied: int = 0
    num_compiled: int = 0
    """Number of its changes of shape after which a step was compiled."""
    has_changed: bool = False
    """Whether it has ever changed the model or the moments."""
    unused: str | None = None
    """`Change.unused` if that was given each time."""


class StageEffects:
    """What the events of a stage do; each process has the same."""

    def __init__(self, stage: Stage, system: System, num_sizes: int):
        """Args:
        stage: with its events.
        system: names the options in messages.
        num_sizes: number of image sizes, each of which has a program.
        """
        self._stage, self._system, self._num_sizes = stage, system, num_sizes
        self._on_host: dict[int, tuple[HostEvent, Effects]] = {
            place: (event, Effects()) for place, event in enumerate(stage.events) if isinstance(event, HostEvent)
        }
        self._reshaped_by: list[int] = []
        self._num_compiled, self._seconds = 0, 0.0

    def apply(self, place: int, state: TrainState, change: Change) -> None:
        """Note a change by the event at a place.

        Args:
          place: index of the event.
          state: before the change.
          change: as the event returned it.
        """
        _, own = self._on_host[place]
        before = state.model, state.moments, state.events[place]
        after = change.model, change.moments, change.state
        is_reshaped = _shapes(before) != _shapes(after)
        if is_reshaped:
            self._reshaped_by.append(place)
        # Values are compared until the event has changed some once, which is nearly always the first time.
        own.has_changed = own.has_changed or is_reshaped or not _are_equal(before[:2], after[:2])
        if own.num_applied == 0 or not change.unused:
            own.unused = change.unused
        own.num_applied += 1

    def launch(self, iteration: int, seconds: float | None) -> None:
        """Note a step that was launched, and warn if an event is why steps are compiled again and again.

        Args:
          iteration: of the step.
          seconds: time that its compilation took; None: there was none.
        """
        reshaped_by, self._reshaped_by = self._reshaped_by, []
        if seconds is None:
            return
        self._num_compiled, self._seconds = self._num_compiled + 1, self._seconds + seconds
        for place in dict.fromkeys(reshaped_by):
            event, own = self._on_host[place]
            own.num_compiled += 1
            if own.num_compiled == MANY_PROGRAMS and type(event).with_room is HostEvent.with_room:
                left = len(self._ahead(event, iteration))
                warnings.warn(
                    f"stage {self._stage.name!r}: {type(event).__name__} has changed shapes {MANY_PROGRAMS} times, and "
                    f"each time a step was compiled, last for {seconds:.0f} s; it happens {counted(left, 'time')} "
                    "more: keep shapes, by keep_rows(model, moments, state, is_kept) to remove Gaussians, or by "
                    "padding in with_room for what will be added",
                    stacklevel=2,
                )

    def programs_ahead(self, iteration: int) -> int:
        """Return the number of programs that events will cause from an iteration on, about."""
        num = 0.0
        for event, own in self._on_host.values():
            if left := len(self._ahead(event, iteration)):
                times = event.iterations(self._stage.iterations)
                known = own.num_compiled, own.num_applied
                caused, among = known if own.num_applied else (event.num_programs(self._stage.iterations), len(times))
                num += left * caused / among
        return round(num * self._num_sizes)

    @property
    def seconds_a_program(self) -> float:
        """Mean time of a compilation so far."""
        return self._seconds / max(1, self._num_compiled)

    def _ahead(self, event: HostEvent, iteration: int) -> list[int]:
        """Return the times of an event from an iteration on after which there are steps."""
        end = self._stage.iterations
        return [time for time in event.iterations(end) if iteration <= time < end]

    def warn_of_never(self) -> None:
        """Warn of events none of whose times is in the stage."""
        end = self._stage.iterations
        for event in self._stage.events:
            first = _first_time(event, end)
            if first is not None and not 1 <= first <= end:
                warnings.warn(
                    f"stage {self._stage.name!r}: {type(event).__name__} never happens, for it is first due at "
                    f"iteration {first:,} of {end:,}",
                    stacklevel=2,
                )

    def warn_of_unused(self) -> None:
        """Warn of events that happened at all their times and never made a difference."""
        told = []
        for event, own in self._on_host.values():
            times = event.iterations(self._stage.iterations)
            if not own.num_applied or own.num_applied < len(times):  # A resumed stage has not seen the first ones.
                continue
            if not own.has_changed:
                told.append(f"{type(event).__name__} changed nothing, though it happened {own.num_applied:,} times")
            elif own.unused:
                told.append(f"{self._system.path_of(event)}.{own.unused}")
        if told:
            warnings.warn(f"stage {self._stage.name!r}: {'; '.join(told)}", stacklevel=2)


def _first_time(event: Event, num_iterations: int) -> int | None:
    """Return the iteration at which an event happens first, or the last one below 1; None if it names no time."""
    if isinstance(event, StepEvent):
        times = event.times(num_iterations)
        return max(1, -(-times.first // times.every)) * times.every if times.num_times else None
    assert isinstance(event, HostEvent)
    found = event.iterations(num_iterations)
    return next((time for time in found if time >= 1), found[-1]) if found else None


def _shapes(tree: Any) -> tuple[Any, list[Any]]:
    leaves, structure = jax.tree.flatten(tree)
    return structure, [jax.typeof(leaf) for leaf in leaves]


def _are_equal(tree: Any, other: Any) -> bool:
    """Return whether two trees of the same shapes have the same numbers."""
    pairs = zip(jax.tree.leaves(tree), jax.tree.leaves(other), strict=True)
    return all(a is b or np.array_equal(on_host(a), on_host(b)) for a, b in pairs)
