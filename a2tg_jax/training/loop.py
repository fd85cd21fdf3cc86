"""The training loop of one stage, top to bottom: steps, events between them, checkpoints, history.

Up to `LAUNCHED` steps are launched before Python waits for the device. If a step cannot be taken, the launched ones
after it stay idle (`step.TrainState.status`); the loop removes the cause and launches them again.
"""

import contextlib
import dataclasses
import datetime
import math
import time
from collections.abc import Callable, Mapping, Sequence

import jax
import jax.numpy as jnp
import numpy as np

from a2tg_jax.base.even_spacing import evenly_chosen
from a2tg_jax.base.machine import Devices
from a2tg_jax.base.text import in_bytes
from a2tg_jax.core.cameras import halved_camera
from a2tg_jax.core.compilations import compilations
from a2tg_jax.core.table import Layout
from a2tg_jax.events import Due, StepEvent
from a2tg_jax.model import Model
from a2tg_jax.parallel import any_process, divided, everywhere, mesh_of, num_processes, whole
from a2tg_jax.rasterize.render_types import RenderSettings
from a2tg_jax.rasterize.room import TileRoom, most_pairs
from a2tg_jax.scene import Scene
from a2tg_jax.training.batches import BatchOrder, PhotoStore, can_halve
from a2tg_jax.training.checkpoint import Checkpoint, Interrupted, state_of_checkpoint
from a2tg_jax.training.cost import check_step_fits
from a2tg_jax.training.divergence import DivergedError, largest_loss, what_diverged
from a2tg_jax.training.history import COLUMNS, History
from a2tg_jax.training.host_events import HostEvents
from a2tg_jax.training.options import System
from a2tg_jax.training.recorded_views import RecordedViews
from a2tg_jax.training.reports import Display, LearningCheck, Pace, Progress, StageEffects, saved_work
from a2tg_jax.training.start import state_of_model
from a2tg_jax.training.step import (
    EXPLODED,
    FINE,
    IMPOSSIBLE,
    NOT_FINITE,
    OVERFLOW,
    StepInfo,
    StepInputs,
    StepSettings,
    TrainState,
    attempt,
    jitted_step,
)

LAUNCHED = 10
"""Number of steps between two waits for the device; fewer if their photographs take too much memory."""
LOG_EVERY = 10
PLANNED_VIEWS = 64
"""Largest number of views that room is planned for."""
SHORTENED = 0.1
"""Steps that are left to a stage which is being shortened, as a share of its iterations that are left."""
LEAST_SHORTENED = 100
"""Smallest number of these steps, if as many iterations are left."""
GROWTH_ROOM = 1.5
"""Pairs that lists may reach while a model is trained, as a multiple of the present ones."""

Size = tuple[int, int]
"""Height and width of a view, in pixels."""
OnCheckpoint = Callable[[Checkpoint], None]
OnLog = Callable[[Mapping[str, float]], object]
IsStopped = Callable[[], bool]
Watch = Callable[["StageRun", IsStopped], float]
"""Function called between steps with the running stage. It may read the state but not keep it, because the next step
reuses its buffers. Of several processes, all must read the same parts of it, or the training hangs. It returns the
seconds it took, which are not counted as training."""


def never() -> bool:
    """Default `is_stopped`: never stop."""
    return False


def unwatched(run: "StageRun", is_stopped: IsStopped) -> float:
    """Default `watch`: do nothing."""
    return 0.0


def are_events_decided_by_host(state: TrainState) -> bool:
    """Return whether Python decides which events are due, in which case a step is compiled for each pattern of them.

    A GPU waits for the host at each decision inside a step, and cannot launch the step as one graph. On CPUs one
    program for all steps takes less time to compile.
    """
    devices = state.model.gaussians.means.devices()
    return all(device.platform != "cpu" for device in devices)


def drawn_size(size: Size, *, is_halved: bool) -> Size:
    """Return the size at which views of a size are drawn."""
    height, width = size
    return (height // 2, width // 2) if is_halved else size


def is_multiple_between(before: int, after: int, every: int) -> bool:
    """Return whether there is a multiple of `every` above `before` and up to `after`."""
    return after // every > before // every


class Session:
    """Shared by the trainings of a program: devices, shapes that steps are compiled for, and a view of the training.

    `fit` makes a new session unless you pass one. Pass the same session to all trainings of a sweep. No result depends
    on the shapes; on several devices sums have another order, so that last digits differ.
    """

    def __init__(
        self,
        after_compiling: Callable[[], object] = lambda: None,
        devices: Sequence[jax.Device] | None = None,
        watch: Watch = unwatched,
    ):
        """Args:
        after_compiling: called after a step was compiled, such as `gc.collect`.
        devices: two or more devices that train one scene together, each with a share of the training state and of the
          views of a batch, such as `jax.devices()`; None: JAX's default device. If they are of several processes, each
          of these makes the same calls.
        watch: function of the stage under way and of `is_stopped`, called between steps. It returns the seconds that it
          waited, which do not count as training time.

        Raises:
          ValueError: if there is one device or none.
        """
        self.after_compiling = after_compiling
        self.watch = watch
        self.mesh = mesh_of(devices)
        """Mesh of the devices; None: one device."""
        self.num_devices = 1 if self.mesh is None else self.mesh.size
        processes = num_processes(self.mesh)
        self.devices = Devices(self.num_devices // processes, processes)
        """Numbers of devices of a process and of processes."""
        self.layouts: set[Layout] = set()
        """Shapes of textures."""
        self.room = TileRoom()
        """Capacities of tile lists, by appearance, rows and image size."""
        self.is_shortened = False
        """Set it to True, from any thread, to finish training soon: what is left of the stage under way is done in a
        tenth of the steps, and so is each later stage. A step then counts as several iterations, so that schedules
        reach their end and all events between steps happen."""

    def check_batch_size(self, batch_size: int) -> None:
        """Raise ValueError unless each device draws the same number of views."""
        if batch_size % self.num_devices:
            fitting = [str(number) for number in range(1, self.num_devices) if batch_size % number == 0]
            raise ValueError(
                f"batch_size must be a multiple of the {self.num_devices} devices, because a device draws whole views; "
                f"got {batch_size}: take {self.num_devices} or a multiple of it, or {' or '.join(fitting)} of the "
                "devices (others would have nothing to draw)"
            )


class StageRun:
    """One stage during training: its state, and the bookkeeping in Python."""

    def __init__(
        self,
        scene: Scene,
        system: System,
        index: int,
        start: Model | Checkpoint,
        num_restored: int | None = None,
        session: Session | None = None,
        max_memory: int | None = None,
        progress: Progress = Progress(),  # noqa: B008 - immutable
        shortened_at: int | None = None,
    ):
        """Args:
        scene: training views.
        system: the options.
        index: number of the stage in `system.all_stages()`, from 0.
        start: the model to start from, or a checkpoint of this stage, or of the end of the stage that it continues.
        num_restored: which order of the views, from 0; None: the checkpoint's order, or the first.
        session: what trainings of this process share; None: a new one.
        max_memory: bytes that may be in use; None: what the machine or the GPU has available.
        progress: how progress is shown, and what follows the stage.
        shortened_at: iteration from which the stage is shortened, as `Session.is_shortened` does; None: none, or the
          checkpoint's.
        """
        self.session = session or Session()
        self.session.check_batch_size(system.batch_size)
        self.mesh = self.session.mesh
        self.views = scene.train
        self.system = system
        self.index = index
        stages = system.all_stages()
        self.stage = stages[index]
        self._recorded_views = RecordedViews.of(scene.train)
        self._earlier = History.empty()
        self._rows: list[dict[str, float]] = []
        """Rows that were logged after `_earlier`."""
        self.num_refused = 0
        num_devices = self.session.num_devices
        if isinstance(start, Checkpoint):
            state = state_of_checkpoint(start, stages, index, scene.train, num_devices)
            if start.stage == index:
                self._earlier = start.history
                self.num_refused = start.num_refused
                shortened_at = start.shortened_at if shortened_at is None else shortened_at
                num_restored = start.num_restored if num_restored is None else num_restored
        else:
            state = state_of_model(start, self.stage, system, [view.name for view in scene.train], num_devices)
        self.state = divided(self.mesh, state)
        self.num_restored = num_restored or 0
        self.shortened_at = shortened_at
        """Iteration from which the stage is shortened; None: it is not."""
        self._launched = int(self.state.iteration)
        """Iteration of the last step that was launched, and not found impossible."""

        end = self.stage.iterations
        self.largest_loss = largest_loss(self.history)
        self.scene_scale = jnp.asarray(scene.scale, self.state.model.gaussians.means.dtype)
        self.key = jax.random.fold_in(jax.random.key(system.seed), index + 1)
        self.order = BatchOrder(self.views, system.batch_size, system.seed * 2 + index + 1, self.num_restored)
        self.photographs = PhotoStore(self.views, self.order, end, self.mesh, self.stage.has_depths)
        self.num_launched = LAUNCHED if self.photographs.is_resident else self.photographs.num_ahead
        self.learning = LearningCheck(
            self.views, self.order, end, system.background, is_first=index == 0, small_budget=system.small_budget
        )
        self.effects = StageEffects(self.stage, system, len({view.picture.size for view in self.views}))
        due = Due(
            views=self.views, background=system.background_color, seed=system.seed, layouts=self.session.layouts,
            room=self.session.room,
        )  # fmt: skip
        self.events = HostEvents(self.stage, due, self.effects)
        self._progress = progress
        self._pace = self._pace_from(self._launched)
        self.capacities: dict[Size, int] = {}
        """Capacities of the tile lists that steps are compiled for, by the size of the render."""
        self.memory: float | None = None
        """Bytes in use while a step runs; None: no step is compiled yet."""
        self._max_memory = max_memory
        self.started = time.perf_counter()
        self.time_left: datetime.timedelta | None = None
        """Remaining time of the run, about; None at the beginning."""
        self.num_regrown = 0

    @property
    def history(self) -> History:
        """Logged figures so far."""
        return self._earlier.followed_by(History.of_rows(self._rows))

    @property
    def seconds(self) -> float:
        return self._earlier.last_seconds + time.perf_counter() - self.started

    @property
    def model(self) -> Model:
        """The Gaussians that exist, and what they show, on one device."""
        return self.state.model.live if self.mesh is None else jax.device_put(whole(self.state.model).live)

    @property
    def whole_state(self) -> TrainState:
        """Present state; of several devices in NumPy arrays."""
        return self.state if self.mesh is None else whole(self.state)

    @property
    def checkpoint(self) -> Checkpoint:
        """Present state; the next step reuses its buffers."""
        return Checkpoint(
            self.system, self.index, self.whole_state, self.history, self.num_restored,
            devices=self.session.devices, num_refused=self.num_refused, views=self._recorded_views,
            shortened_at=self.shortened_at,
        )  # fmt: skip

    def train(
        self,
        on_checkpoint: OnCheckpoint | None = None,
        checkpoint_every: int | None = None,
        on_log: OnLog | None = None,
        is_stopped: IsStopped = never,
    ) -> None:
        """Run the stage to its end, then release its photographs. If it is stopped, write a last checkpoint and raise
        `Interrupted`.
        """
        iteration = self._launched
        end = self.stage.iterations
        # Several processes launch the same steps, and stop together.
        stops_launching = is_stopped if num_processes(self.mesh) == 1 else never
        display = (self._progress.display or Display)(self._progress.title or self.stage.name, iteration, end)
        with contextlib.closing(self.photographs), display:
            while iteration < end:
                if self.shortened_at is None and any_process(self.mesh, self.session.is_shortened):
                    self.shortened_at = iteration
                    self._pace = self._pace_from(iteration)
                    if on_checkpoint is not None:
                        on_checkpoint(self.checkpoint)
                # Python acts after `num_launched` steps, and at events and checkpoints.
                paused = iteration
                stride = self.stride_after(paused)
                pauses = [paused + (self.num_launched - paused % self.num_launched) * stride, end]
                pauses += [pause for pause in (*self.events.iterations, self.shortened_at or 0) if pause > paused]
                if checkpoint_every is not None and stride == 1:
                    pauses.append(paused + checkpoint_every - paused % checkpoint_every)
                pause = min(pauses)
                for info in self.steps(min(paused + stride, pause), pause, stops_launching):
                    before = iteration
                    iteration = int(info.iteration)
                    if is_multiple_between(before, iteration, LOG_EVERY * stride) or iteration == end:
                        self._log(iteration, info, on_log)
                    self.learning.observe(iteration, float(info.psnr))
                    row = self._rows[-1] if self._rows else None
                    display.update(iteration, float(info.loss), float(info.psnr), row, self._pace.left(iteration))
                ahead = self.effects.programs_ahead(iteration)
                self._pace.time(iteration, self.effects.num_compiled, ahead, self.effects.seconds_a_program)
                forecast = self._pace.forecast_at(iteration)
                if forecast is not None:
                    display.tell(f"{forecast}; {in_bytes(self.memory or 0)} of memory")
                self.time_left = self._pace.left(iteration)
                # `iteration` is less if a step could not be taken or training is being stopped.
                if iteration == pause and iteration in self.events.iterations:
                    self.apply_events(iteration)
                self.started += self.session.watch(self, is_stopped)
                must_stop = any_process(self.mesh, is_stopped())
                must_save = checkpoint_every is not None and is_multiple_between(paused, iteration, checkpoint_every)
                if on_checkpoint is not None and (must_save or must_stop or iteration == end):
                    on_checkpoint(self.checkpoint)
                if must_stop:
                    raise Interrupted(self.checkpoint)
        self.effects.warn_at_end(self.num_refused, self.state.model.num_rows)

    def _pace_from(self, iteration: int) -> Pace:
        most = max((event.most_gaussians or 0 for event in self.stage.events), default=0)
        return Pace(
            iteration, self.stage.iterations, most_gaussians=most, num_coarse=self.stage.num_coarse,
            saved=saved_work(self.views), after=self._progress.after,
        )  # fmt: skip

    def _log(self, iteration: int, info: StepInfo, on_log: OnLog | None) -> None:
        """Add a row to the history."""
        num_live = int(info.num_live)
        megabytes = self.state.model.bytes_of(num_live) / 1e6
        values = self.index + 1, iteration, float(info.loss), float(info.psnr), num_live, megabytes, self.seconds
        terms = {f"{History.prefix}{name}": float(value) for name, value in info.terms.items()}
        self._rows.append(dict(zip(COLUMNS, values, strict=True)) | terms)
        if on_log is not None:
            on_log(self._rows[-1])
        # The first logged loss decides which later one is an explosion.
        if len(self._rows) == 1:
            self.largest_loss = largest_loss(self.history)

    # Steps

    def stride_after(self, iteration: int) -> int:
        """Return the number of iterations that a step after an iteration counts as."""
        if self.shortened_at is None or iteration < self.shortened_at:
            return 1
        left = self.stage.iterations - self.shortened_at
        return math.ceil(left / max(LEAST_SHORTENED, SHORTENED * left))

    def steps(self, first: int, last: int, is_stopped: IsStopped = never) -> list[StepInfo]:
        """Run iterations `first` to `last`, with a step for each, or for `stride_after` of them.
        Stop at a step that cannot be taken and remove its cause."""
        iterations = [*range(first, last, self.stride_after(self._launched)), last]
        launched: list[StepInfo] = []
        for iteration in iterations:
            if is_stopped():
                break
            launched.append(self._launch(iteration))
            self._launched = iteration
        infos = jax.device_get(launched)  # Only here the loop waits for the device.
        # After a step that was not taken, all others are idle and have its status.
        taken = [info for info in infos if info.status == FINE]
        self.num_refused += sum(int(info.num_refused) for info in taken)
        if len(taken) < len(infos):
            failed = infos[len(taken)]
            self._launched = int(failed.iteration)
            self._after_failure(iterations[len(taken)], failed)
        return taken

    def _launch(self, iteration: int) -> StepInfo:
        arguments = self.arguments(iteration)
        # Of halved photographs a step takes less memory than later ones, which decide whether training fits.
        largest = arguments
        if self.memory is None and arguments[0].is_halved:
            largest = self.arguments(iteration, may_halve=False)
        started = time.perf_counter()
        info: StepInfo
        with compilations() as phases:
            try:
                if self.memory is None:
                    # A call finds this program in JAX's cache of this process: the one that follows, or the first with
                    # whole photographs.
                    step = jitted_step().lower(*largest).compile()
                    model_bytes = sum(leaf.nbytes for leaf in jax.tree.leaves(self.state.model))
                    self.memory = check_step_fits(
                        step, model_bytes, self._progress.after, self.system, self.session.devices, self._max_memory
                    )
                self.state, info = jitted_step()(*arguments)
            except ValueError as error:  # The step is not compiled for the name of its stage.
                raise ValueError(f"stage {self.stage.name!r}: {error}") from error
        num_compiled = sum(phase.makes_code for phase in phases)
        self.effects.launch(iteration, num_compiled, time.perf_counter() - started)
        if num_compiled:
            self.session.after_compiling()
        return info

    def arguments(self, iteration: int, *, may_halve: bool = True) -> tuple[StepSettings, TrainState, StepInputs]:
        """Return the arguments of the step of an iteration; with `may_halve` False, photographs are whole."""
        photographs, chosen = self.photographs.batch(iteration)
        is_halved = may_halve and self._is_halved(iteration)
        render = self.render_settings(self._size(iteration), is_halved=is_halved)
        clock = self.stage.clock(iteration, self.largest_loss, iteration - self._launched)
        happens = None
        if are_events_decided_by_host(self.state):
            happens = tuple(left is None or left > 0 for left in clock.num_left)
        settings = StepSettings(render, self.system.background, happens, self.mesh, is_halved)
        views = np.asarray(self.order.indices(iteration), np.int32) if self.stage.corrections else None
        views = everywhere(self.mesh, views)
        inputs = StepInputs(self.stage, clock, photographs, chosen, views, self.scene_scale, self.key)
        return settings, self.state, inputs

    def _size(self, iteration: int) -> Size:
        return self.views[self.order.indices(iteration)[0]].picture.size

    def _is_halved(self, iteration: int) -> bool:
        """Return whether the photographs of an iteration are halved; small ones never are."""
        return iteration <= self.stage.num_coarse and can_halve(self._size(iteration))

    def render_settings(self, size: Size, *, is_halved: bool) -> RenderSettings:
        """Return settings with a capacity for the views of a size, drawn at half of it or whole. The first call plans
        it, for a sample of these views and for a model that uses all its rows."""
        settings = RenderSettings(tile_size=self.system.tile_size)
        model = self.state.model
        drawn = drawn_size(size, is_halved=is_halved)
        if drawn not in self.capacities:
            dtype = model.gaussians.means.dtype
            appearance = model.appearance
            views = [view for view in self.views if view.picture.size == size]
            sample = evenly_chosen(views, PLANNED_VIEWS)
            cameras = [halved_camera(view.camera) if is_halved else view.camera for view in sample]
            cameras = [jax.tree.map(lambda x: jnp.asarray(x, dtype), camera) for camera in cameras]
            pairs = most_pairs(model.gaussians, cameras, appearance, settings, model.num_live)
            growth = (model.num_rows / max(model.num, 1)) ** 0.5
            self.capacities[drawn] = self.session.room.plan(self._place(drawn), pairs * GROWTH_ROOM * growth)
        return dataclasses.replace(settings, capacity=self.capacities[drawn])

    def _place(self, drawn: Size) -> tuple[object, ...]:
        """Return the place of a capacity in the session's room: stages that show the same share it."""
        return self.stage.appearance, self.state.model.num_rows, *drawn

    def _after_failure(self, iteration: int, info: StepInfo) -> None:
        """Make more room if the tile lists of a step overflowed; raise an error for every other cause."""
        # With its present status all further steps would stay idle.
        self.state = dataclasses.replace(self.state, status=jnp.zeros_like(self.state.status))
        if info.status == OVERFLOW:
            self.num_regrown += 1
            drawn = drawn_size(self._size(iteration), is_halved=self._is_halved(iteration))
            pairs = GROWTH_ROOM * float(info.num_pairs)
            self.capacities[drawn] = self.session.room.enlarge(self._place(drawn), pairs)
            return
        where = f"at iteration {iteration} of stage {self.stage.name}"
        if info.status in (NOT_FINITE, EXPLODED):
            names = [self.views[index].name for index in self.order.indices(iteration)]
            what = "loss or gradient is not finite" if info.status == NOT_FINITE else "the loss has exploded"
            tried = whole(jax.jit(attempt, static_argnums=(0,))(*self.arguments(iteration)))
            raise DivergedError(
                f"{what} {where}, view {', '.join(names)}: {what_diverged(tried, names)}: lower "
                "the learning rates, or look for a damaged camera or image; the state before it is unharmed",
                self.checkpoint,
            )
        assert info.status == IMPOSSIBLE
        events = [event for event in self.stage.events if isinstance(event, StepEvent) and event.impossible]
        reasons = "; or ".join(f"{self.system.path_of(event)}: {event.impossible}" for event in events)
        raise ValueError(
            f"training cannot continue {where}: {reasons}; check the cameras and points of the scene, or lower "
            "rates.logit_opacities"
        )

    def apply_events(self, iteration: int) -> None:
        """Apply the events between steps that follow an iteration."""
        state = self.state if self.mesh is None else jax.device_put(self.whole_state)
        state = self.events.after(iteration, state, is_shortened=self.stride_after(iteration) > 1)
        self.state = divided(self.mesh, state)
