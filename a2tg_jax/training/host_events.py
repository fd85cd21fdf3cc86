"""The events between the steps of a stage (host): when they are due, and what they make of the training state."""

import dataclasses
from typing import Any

import jax
import numpy as np
from jax import Array

from a2tg_jax.core.numerics import first_rows, where_rows
from a2tg_jax.core.table import map_rows
from a2tg_jax.events import Due, Event, HostEvent
from a2tg_jax.model import Model
from a2tg_jax.training.reports import StageEffects
from a2tg_jax.training.returned import calling, checked_change
from a2tg_jax.training.stage import Stage
from a2tg_jax.training.step import TrainState

WORTH_COMPILING = 1_000
"""Remaining iterations for which it is worth compiling a step without statistics that nothing reads any more."""


class HostEvents:
    """The events between the steps of a stage, and the end of statistics that no later event reads."""

    def __init__(self, stage: Stage, due: Due, effects: StageEffects):
        """Args:
        stage: the stage.
        due: information for each event, but for its `index` and `count`.
        effects: records what the events do.
        """
        self._stage = stage
        self._due = due
        self._effects = effects
        self.iterations: set[int] = set()
        """Iterations after which events happen, or statistics end."""
        self._last_gathered: list[int] = []
        """Iteration after which the statistic of each event ends; 0: it is kept, because too few iterations are left to
        compile a step without it."""
        for event, times in zip(stage.events, stage.times, strict=True):
            if isinstance(event, HostEvent):
                self.iterations.update(times)
            last = 0
            if times and event.observes and stage.iterations - times[-1] >= WORTH_COMPILING:
                last = times[-1]
                self.iterations.add(last)
            self._last_gathered.append(last)

    def after(self, iteration: int, state: TrainState, *, is_shortened: bool) -> TrainState:
        """Return the state [whole arrays on one device] after the events that follow an iteration. In a shortened
        stage, statistics are kept: it is not worth compiling a step without them."""
        for place, (event, times) in enumerate(zip(self._stage.events, self._stage.times, strict=True)):
            if isinstance(event, HostEvent) and iteration in times:
                due = dataclasses.replace(self._due, index=times.index(iteration) + 1, count=len(times))
                state = self._changed(state, place, event, due)
            if iteration == self._last_gathered[place] and not is_shortened:
                state = _with_event(state, place, None)
        return state

    def _changed(self, state: TrainState, place: int, event: HostEvent, due: Due) -> TrainState:
        """Return the state after the event at a place."""
        with calling(event, "apply", self._stage.name):
            change = event.apply(due, state.model, state.moments, state.events[place])
            change = checked_change(change)
        self._effects.apply(place, state, change)
        state = dataclasses.replace(state, model=change.model, moments=change.moments)
        if change.rows is not None:  # Statistics of other events move along with the Gaussians.
            pairs = zip(self._stage.events, state.events, strict=True)
            moved = [
                None if gathered is None else _moved(other, gathered, change.rows, change.model)
                for other, gathered in pairs
            ]
            state = dataclasses.replace(state, events=tuple(moved))
        return _with_event(state, place, change.state)


def _moved(event: Event, gathered: Any, rows: np.ndarray, model: Model) -> Any:
    """Return the state of an event after rows have moved, given the model with moved rows."""
    moved = event.gather(gathered, rows)
    if type(event).gather is not Event.gather:
        return moved
    new = event.init(model)
    if jax.tree.structure(new) != jax.tree.structure(moved):  # type: ignore[operator]
        return moved
    # Gaussians that are added between steps take the rows of removed ones.
    is_removed = ~first_rows(model.num_rows, model.live_count)

    def renewed(old: Array, initial: Array) -> Array:
        return where_rows(is_removed, initial, old) if old.ndim else old

    return map_rows(renewed, lambda old, _: old, moved, new)


def _with_event(state: TrainState, place: int, event_state: object) -> TrainState:
    """Return the training state with another state of the event at a place."""
    return dataclasses.replace(state, events=(*state.events[:place], event_state, *state.events[place + 1 :]))
