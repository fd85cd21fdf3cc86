"""The training loop of one stage, on the host, top to bottom: steps, host events, checkpoints, history.

The host launches up to `LAUNCHED` steps before it waits for the device. If a step cannot be taken, the launched ones
after it stay idle (`step.TrainState.status`); the loop mends the cause and launches them again.
"""

import dataclasses
import functools
import time
import warnings
from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from a2tg_jax.core.pytree import num_compiled
from a2tg_jax.core.spread_arrays import mesh_of, on_host
from a2tg_jax.data.scene import Scene
from a2tg_jax.events import Change, Due, Event, HostEvent, StepEvent
from a2tg_jax.model import Model
from a2tg_jax.rasterize.exchange import spread
from a2tg_jax.rasterize.placement import asked_by_any, check_same, everywhere, gathered, of_first, readable
from a2tg_jax.rasterize.render_types import RenderSettings
from a2tg_jax.training.batches import BatchOrder, PhotoStore
from a2tg_jax.training.checkpoint import Checkpoint, History, HistoryLog, Interrupted
from a2tg_jax.training.corrections import check_corrections
from a2tg_jax.training.divergence import DivergedError, largest_loss, what_diverged
from a2tg_jax.training.effects import StageEffects
from a2tg_jax.training.learning import LearningCheck
from a2tg_jax.training.options import System
from a2tg_jax.training.progress import ProgressBar
from a2tg_jax.training.resume import check_resume, warn_of_uneven_rows
from a2tg_jax.training.returned import checked_change
from a2tg_jax.training.room import Size, StageRoom
from a2tg_jax.training.session import Session
from a2tg_jax.training.start import padded
from a2tg_jax.training.step import (
    EXPLODED,
    FINE,
    IMPOSSIBLE,
    NOT_FINITE,
    OVERFLOW,
    StepInfo,
    StepSettings,
    TrainState,
    initial_state,
    jitted_step,
)

LAUNCHED = 10
"""Number of steps between two waits for the device; fewer if their photographs take too much memory."""
LOG_EVERY = 10
WORTH_COMPILING = 1_000
"""Iterations for which a step without statistics that nothing reads any more is worth its compilation."""

OnCheckpoint = Callable[[Checkpoint], None]
OnLog = Callable[[Mapping[str, float]], object]
IsStopped = Callable[[], bool]


def never() -> bool:
    """Training that nobody stops."""
    return False


Watch = Callable[["StageRun", IsStopped], float]
"""Function called between steps with the running stage. It may read the state but not keep it, because the next step
reuses its buffers. Of several processes, all must read the same parts of it, or the training hangs. It returns the
seconds it took, which are not counted as training."""


def are_events_decided_by_host() -> bool:
    """Return whether the host says which events are due, in which case a step is compiled for each pattern of them.

    A GPU waits for the host at each decision inside a step, and cannot launch the step as one graph. On CPUs one
    program for all steps takes less time to compile.
    """
    return jax.default_backend() != "cpu"


def unwatched(run: "StageRun", is_stopped: IsStopped) -> float:
    """Training that nobody looks at."""
    return 0.0


def read(infos: list[StepInfo]) -> list[StepInfo]:
    """Return the scalars of some steps as host numbers. Only here the loop waits for the device."""
    known: list[StepInfo] = jax.device_get(infos)
    return known


class StageRun:
    """Running stage: its state, and what the host keeps beside it."""

    def __init__(
        self,
        scene: Scene,
        system: System,
        index: int,
        start: Model | None,
        resume: Checkpoint | None = None,
        num_restored: int | None = None,
        session: Session | None = None,
    ):
        """Args:
        scene: its training views are trained on.
        system: the options.
        index: which of its stages, from 0.
        start: the model to start from; None where `resume` is given.
        resume: a checkpoint of this stage.
        num_restored: which order of the views, from 0; None: that of the checkpoint, or the first.
        session: what trainings of this process share; None: a new one.
        """
        self.session = Session() if session is None else session
        exchange = self.session.exchange
        self.exchange = None if exchange is None else exchange.for_batches(system.batch_size)
        self.views, self.system, self.index = scene.train, system, index
        self.stage = system.stages()[index]
        self.num_restored = (resume.num_restored if resume else 0) if num_restored is None else num_restored
        self._logged, self.earlier_seconds = HistoryLog(resume.history if resume else History.empty()), 0.0
        if resume is not None:
            check_resume(resume, system, index)
            check_corrections(resume.state.corrections, len(self.views))
            warn_of_uneven_rows(resume, self.num_devices)
            self.state: TrainState = spread(self.exchange, self._copied(resume.state))
            self.earlier_seconds = resume.history.last_seconds
        elif start is not None:
            model = spread(self.exchange, padded(self._copied(start.live), self.stage, system, self.num_devices))
            state = initial_state(self.stage, model, [view.name for view in self.views], start.origin)
            self.state = spread(self.exchange, state)
        else:
            raise ValueError("a stage needs a model to start from, or a checkpoint to go on from")
        self._make_room()
        self.clock = self.stage.clock()._replace(largest_loss=largest_loss(self.history))
        self.scene_scale = jnp.asarray(scene.scale, self.state.model.gaussians.means.dtype)
        self.key = jax.random.fold_in(jax.random.key(system.seed), index + 1)
        self.order = BatchOrder(self.views, system.batch_size, system.seed * 2 + index + 1, self.num_restored)
        self.photographs = PhotoStore(self.views, self.order, self.stage.iterations, self.exchange, self.stage.extras)
        self.learning = LearningCheck(
            self.views,
            self.order,
            self.stage.iterations,
            system.background,
            is_first=index == 0,
            small_budget=system.small_budget,
        )
        self.launched = LAUNCHED if self.photographs.is_resident else self.photographs.num_ahead
        self.effects = StageEffects(self.stage, system, len({view.picture.size for view in self.views}))
        self.room = StageRoom(self.stage, self.views, system.tile_size, self.exchange, self.session)
        self.on_log: OnLog | None = None
        """Called with each row of the history."""
        self.started = time.perf_counter()
        self.num_regrown = self.num_compiled = 0
        self.num_refused = resume.num_refused if resume else 0

    def _make_room(self) -> None:
        """Pad the state for what events on the host will add, so that steps need not be compiled anew."""
        model, moments = self.state.model, self.state.moments
        num, num_bytes = model.num, float(model.num_bytes)
        for event, state in zip(self.stage.events, self.state.events, strict=True):
            if isinstance(event, HostEvent) and state is not None:
                found = Change(*event.with_room(model, moments, num_bytes, self.stage.iterations), state)
                found = checked_change(f"stage {self.stage.name!r}: {type(event).__name__}.with_room", found)
                model, moments = found.model, found.moments
            num_bytes = event.most_bytes(num_bytes, num, self.stage.iterations)
        self.state = dataclasses.replace(self.state, model=model, moments=moments)

    def _copied(self, tree: Any) -> Any:
        """Return copies of arrays, for steps take over the buffers they are given: on the device, or on the host if
        several devices are to share them."""
        return jax.tree.map(jnp.array if self.exchange is None else np.array, tree)

    @property
    def history(self) -> History:
        """Logged figures so far."""
        return self._logged.history

    @property
    def seconds(self) -> float:
        return self.earlier_seconds + time.perf_counter() - self.started

    @property
    def num_devices(self) -> int:
        """Number of devices that train together."""
        return 1 if self.exchange is None else self.exchange.num

    @property
    def model(self) -> Model:
        """The Gaussians that exist, and what they show, on one device."""
        if self.exchange is None:
            return self.state.model.live
        on_one: Model = gathered(self.exchange, jax.tree.map(on_host, self.state.model).live)
        return on_one

    @property
    def checkpoint(self) -> Checkpoint:
        """Present state; the next step reuses its buffers."""
        state = readable(self.state)
        return Checkpoint(
            self.system, self.index, state, self.history, self.num_restored, devices=self.session.devices,
            num_refused=self.num_refused,
        )  # fmt: skip

    def train(
        self,
        on_checkpoint: OnCheckpoint | None,
        checkpoint_every: int | None,
        progress: bool,
        title: str | None = None,
        is_stopped: IsStopped = never,
        watch: Watch = unwatched,
    ) -> None:
        """Run the stage to its end, then release its photographs. If it is stopped, write a last checkpoint and raise
        `Interrupted`.
        """
        try:
            self._train(on_checkpoint, checkpoint_every, progress, title, is_stopped, watch)
        finally:
            self.photographs.close()

    def _train(
        self,
        on_checkpoint: OnCheckpoint | None,
        checkpoint_every: int | None,
        progress: bool,
        title: str | None,
        is_stopped: IsStopped,
        watch: Watch,
    ) -> None:
        iteration, end = int(self.state.iteration), self.stage.iterations
        self.effects.warn_of_never()
        may_grow = any(event.most_gaussians is not None for event in self.stage.events)
        with ProgressBar(title or self.stage.name, iteration, end, is_shown=progress, may_grow=may_grow) as bar:
            while iteration < end:
                stop = self._next_stop(iteration, checkpoint_every)
                for info in self.steps(iteration + 1, stop, is_stopped):
                    iteration += 1
                    self._log(iteration, info)
                    self.learning.observe(iteration, float(info.psnr))
                    bar.update(info, self.history)
                ahead = self.effects.programs_ahead(iteration)
                bar.tell_pace(iteration, self.num_compiled, ahead, self.effects.seconds_a_program)
                if iteration == stop:
                    self._host_events(iteration)
                self.started += watch(self, is_stopped)
                is_asked = asked_by_any(self.exchange, is_stopped())
                is_due = checkpoint_every is not None and iteration % checkpoint_every == 0 and iteration == stop
                if on_checkpoint is not None and (is_due or is_asked or iteration == end):
                    on_checkpoint(self.checkpoint)
                if is_asked:
                    raise Interrupted(self.checkpoint)
        self.effects.warn_of_unused()
        if self.num_refused:
            advice = "; or ".join(self._told_by_events("refused"))
            warnings.warn(
                f"stage {self.stage.name}: {self.num_refused:,} times there was no room for a Gaussian that should "
                f"have been added, all {self.state.model.gaussians.num:,} rows being taken{advice and f': {advice}'}",
                stacklevel=2,
            )

    def _told_by_events(self, name: str) -> list[str]:
        """Return the messages that step events have in an attribute, with option names in place of field names."""
        events = [event for event in self.stage.events if isinstance(event, StepEvent)]
        return [self.system.told(event, message) for event in events if (message := getattr(event, name))]

    def _next_stop(self, iteration: int, checkpoint_every: int | None) -> int:
        """Return the next iteration that the host acts after."""
        stops = [iteration + self.launched - iteration % self.launched, self.stage.iterations]
        stops += [due for due in self._due_on_host() if due > iteration]
        if checkpoint_every is not None:
            stops.append(iteration + checkpoint_every - iteration % checkpoint_every)
        return min(stops)

    def _due_on_host(self) -> list[int]:
        """Return the iterations of all host events, and the last one of each step event whose statistic is dropped."""
        count = self.stage.iterations
        due: list[int] = []
        for event, times in zip(self.stage.events, self.clock.times, strict=True):
            if isinstance(event, HostEvent):
                due += event.iterations(count)
            elif times is not None and event.observes and self._is_worth_dropping(times.last):
                due.append(times.last)
        return due

    def steps(self, first: int, last: int, is_stopped: IsStopped = never) -> list[StepInfo]:
        """Run iterations `first` to `last`. Stop at one that cannot be taken and mend its cause."""
        launched: list[StepInfo] = []
        is_common = self.exchange is not None and self.exchange.is_of_processes
        while first + len(launched) <= last and (is_common or not is_stopped()):
            launched.append(self._launch(first + len(launched)))
        infos = read(launched)
        taken = [info for info in infos if info.status == FINE]
        self.num_refused += sum(int(info.num_refused) for info in taken)
        if len(taken) < len(infos):
            self._mend(first + len(taken), infos[len(taken)])
        return taken

    def arguments(self, iteration: int) -> tuple[Any, ...]:
        """Return the arguments of the step of an iteration."""
        photographs, views = self.photographs.batch(iteration)
        due = self._due(iteration) if are_events_decided_by_host() else None
        settings = StepSettings(self.render_settings(self._size(iteration)), self.system.background, due)
        rows = np.asarray(self.order.indices(iteration), np.int32) if self.stage.corrections else None
        if self.exchange is not None:  # Else XLA may choose a sharding for them that JAX cannot name.
            views, rows = jax.tree.map(functools.partial(everywhere, self.exchange), (views, rows))
        return settings, self.stage, self.clock, self.state, photographs, views, self.scene_scale, self.key, rows

    def render_settings(self, size: Size) -> RenderSettings:
        """Return the settings of a step with views of a size, whose room is planned before the first of them."""
        return self.room.settings(size, self.state.model)

    def _due(self, iteration: int) -> tuple[bool, ...]:
        """Return whether each event follows this iteration inside its step."""
        return tuple(times is None or bool(times.is_due(iteration)) for times in self.clock.times)

    def _launch(self, iteration: int) -> StepInfo:
        arguments, step = self.arguments(iteration), jitted_step()
        before, started = num_compiled(step), time.perf_counter()
        info: StepInfo
        self.state, info = step(*arguments)
        is_compiled = num_compiled(step) > before
        self.effects.launch(iteration, time.perf_counter() - started if is_compiled else None)
        if is_compiled:
            self.num_compiled += 1
            self.session.after_compiling()
        return info

    def _size(self, iteration: int) -> Size:
        return self.views[self.order.indices(iteration)[0]].picture.size

    def _mend(self, iteration: int, info: StepInfo) -> None:
        """Make more room for the tile lists; raise an error for every other cause."""
        fine = spread(self.exchange, jnp.zeros((), jnp.int32))
        self.state = dataclasses.replace(self.state, status=fine)
        if info.status == OVERFLOW:
            self.num_regrown += 1
            return self.room.widen(self._size(iteration), self.state.model, float(info.num_pairs))
        where = f"at iteration {iteration} of stage {self.stage.name}"
        if info.status in (NOT_FINITE, EXPLODED):
            raise self._diverged(iteration, where, info)
        assert info.status == IMPOSSIBLE
        reasons = "; or ".join(self._told_by_events("impossible"))
        raise ValueError(
            f"training cannot go on {where}: {reasons}; check the cameras and points of the scene, or lower "
            "rates.logit_opacities"
        )

    def _diverged(self, iteration: int, where: str, info: StepInfo) -> DivergedError:
        """Return the error that names the values that are not finite or too large."""
        names = [self.views[index].name for index in self.order.indices(iteration)]
        what = "loss or gradient is not finite" if info.status == NOT_FINITE else "the loss has exploded"
        return DivergedError(
            f"{what} {where}, view {', '.join(names)}: {what_diverged(self.arguments(iteration), names)}: lower the "
            "learning rates, or look for a damaged camera or image; the state before it is unharmed",
            self.checkpoint,
        )

    def _log(self, iteration: int, info: StepInfo) -> None:
        if iteration % LOG_EVERY == 0 or iteration == self.stage.iterations:
            num_bytes = self.state.model.bytes_of(int(info.num_live))
            row = (
                self.index + 1, iteration, float(info.loss), float(info.psnr), int(info.num_live),
                num_bytes / 1e6, self.seconds,
            )  # fmt: skip
            terms = {name: float(value) for name, value in info.terms.items()}
            self._logged.add(*row, **terms)
            if self.on_log is not None:
                self.on_log(History.row(row, terms))
            self.clock = self.clock._replace(largest_loss=largest_loss(self.history))

    def _host_events(self, iteration: int) -> None:
        """Apply the host events that follow an iteration, and drop the statistics of past events."""
        if iteration not in self._due_on_host():
            return
        for place, (event, times) in enumerate(zip(self.stage.events, self.clock.times, strict=True)):
            if isinstance(event, HostEvent):
                if iteration in event.iterations(self.stage.iterations):
                    self._apply(place, event, iteration)
            elif times is not None and event.observes and iteration == times.last:
                self._keep(place, None)

    def _is_worth_dropping(self, iteration: int) -> bool:
        """Return whether statistics that nothing reads after an iteration are dropped, for which a step is compiled."""
        return self.stage.iterations - iteration >= WORTH_COMPILING

    def _apply(self, place: int, event: HostEvent, iteration: int) -> None:
        """Apply a host event: to arrays that are spread over the devices, or on one device if it wants them whole."""
        if event.reads_whole:
            self.state = gathered(self.exchange, self.state)
        due, agreed = event.iterations(self.stage.iterations), functools.partial(of_first, self.exchange)
        told = Due(due.index(iteration) + 1, len(due), self.views, self.session.shapes, agreed)
        change = event.apply(told, self.state.model, self.state.moments, self.state.events[place])
        change = checked_change(f"stage {self.stage.name!r}: {type(event).__name__}.apply", change)
        self.effects.apply(place, self.state, change)
        self.state = dataclasses.replace(self.state, model=change.model, moments=change.moments)
        if change.rows is not None:
            self._move_rows(change.rows)
        is_dropped = iteration == due[-1] and event.observes and self._is_worth_dropping(iteration)
        self._keep(place, None if is_dropped else change.state)
        # What lies on the devices of all processes was compared when it was placed there.
        own = [leaf for leaf in jax.tree.leaves(self.state) if mesh_of(leaf) is None]
        check_same(self.exchange, own, f"the events at iteration {iteration} of stage {self.stage.name}")
        self.state = spread(self.exchange, self.state)

    def _move_rows(self, rows: np.ndarray) -> None:
        """Move the events' statistics along with the Gaussians."""
        pairs = zip(self.stage.events, self.state.events, strict=True)
        events = tuple(None if state is None else self._moved(event, state, rows) for event, state in pairs)
        self.state = dataclasses.replace(self.state, events=events)

    def _moved(self, event: Event, state: Any, rows: np.ndarray) -> Any:
        """Return the statistic of an event in new rows."""
        return event.gather(gathered(self.exchange, state) if event.reads_whole else state, rows)

    def _keep(self, place: int, gathered: Any) -> None:
        events = list(self.state.events)
        events[place] = gathered
        self.state = dataclasses.replace(self.state, events=tuple(events))
