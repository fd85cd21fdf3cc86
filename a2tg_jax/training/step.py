"""One training step, jitted once per image size and stage: render, loss, gradients, Adam, events.

A step is not taken if the tile lists overflow, a number is not finite or the loss explodes. Then the state keeps its
values, and its status makes all further steps idle, so that the host may look at it some steps later and lose nothing.
"""

import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from a2tg_jax.core.cameras import Camera
from a2tg_jax.core.gaussians import SH_C0, Gaussians
from a2tg_jax.core.gradient_statistics import read_probe
from a2tg_jax.core.optim import AdamState, OptStep, adam_init, adam_update
from a2tg_jax.core.origin import Origin
from a2tg_jax.core.pytree import pytree
from a2tg_jax.events import Event, EventInfo, Now, Seen, StepEvent, Times
from a2tg_jax.model import Model
from a2tg_jax.rasterize.exchange import exchange_of, spread
from a2tg_jax.rasterize.placement import gathered
from a2tg_jax.rasterize.render_types import RenderSettings
from a2tg_jax.training.batch_gradients import BatchGradients, batch_gradients, drawn_backgrounds
from a2tg_jax.training.batches import Photographs
from a2tg_jax.training.corrections import CorrectionState, corrected_camera, initial_corrections, rows_of, updated
from a2tg_jax.training.jitter import jittered
from a2tg_jax.training.returned import check_kept, checked_change
from a2tg_jax.training.stage import Background, Clock, Stage

FINE, OVERFLOW, NOT_FINITE, IMPOSSIBLE, EXPLODED = range(5)
"""Status of a state: the reason why the last step was not taken."""


@pytree
class TrainState:
    """All values that training changes. Everything else follows from the system and the iteration."""

    model: Model
    moments: AdamState
    """Adam's memory of (gaussians, params)."""
    events: tuple[Any, ...]
    """State of each event; None for past ones."""
    iteration: Array
    """int32 number of finished iterations of this stage."""
    status: Array
    """int32: FINE, OVERFLOW, NOT_FINITE, IMPOSSIBLE or EXPLODED."""
    corrections: tuple[CorrectionState, ...] = ()
    """State of each correction of the stage."""


@dataclasses.dataclass(frozen=True)
class StepSettings:
    """Settings that a step is compiled for, beside its stage; hashable."""

    render: RenderSettings
    """Render settings with a capacity."""
    background: Background
    due: tuple[bool, ...] | None = None
    """Whether each event of the stage is due; a step is compiled for each pattern. With None the step itself decides,
    which makes a GPU wait for the host."""


class StepInfo(NamedTuple):
    """Scalars about a step, for the host."""

    loss: Array
    psnr: Array
    """Mean over the views, in dB."""
    num_pairs: Array
    """Largest number of pairs among the views, the least capacity."""
    status: Array
    """Status after the step."""
    num_live: Array
    num_refused: Array
    """Number of Gaussians that events could not add for lack of room."""
    terms: dict[str, Array]
    """Summands of the loss by name."""


def initial_state(stage: Stage, model: Model, names: Sequence[str] = (), origin: Origin | None = None) -> TrainState:
    """Return the state before the first iteration of a stage.

    Args:
      stage: which.
      model: with the rows and the appearance of the stage; the state is spread over devices as its rows are.
      names: of the training views.
      origin: of the model that the stage starts from; its corrections go on.
    """
    return TrainState(
        model=model,
        moments=adam_init((model.gaussians, model.params)),
        events=tuple(_initial(event, model) if stage.is_ahead(event) else None for event in stage.events),
        iteration=jnp.zeros((), jnp.int32),
        status=jnp.zeros((), jnp.int32),
        corrections=initial_corrections(stage.corrections, names, origin, model.gaussians.means.dtype),
    )


def _initial(event: Event, model: Model) -> Any:
    """Return the state that an event starts from."""
    return event.init(gathered(exchange_of(model.gaussians.means), model) if event.reads_whole else model)


class Attempt(NamedTuple):
    """Outcome of a step, taken or not."""

    views: BatchGradients
    grads: tuple[Gaussians, Any, tuple[Array, ...]]
    """Mean gradients over the views; of corrections, gradients in the row of each view [V, ...]."""
    state: TrainState
    """State after the step, with the status of the state before."""
    info: EventInfo
    is_finite: Array
    """Whether all numbers are: losses, gradients, and what projections and events made of Adam's results."""


@functools.cache
def jitted_step() -> jax.stages.Wrapped:
    """Return `train_step`, jitted, with the state's buffers donated; its cache counts the traces."""
    return jax.jit(train_step, static_argnums=(0,), donate_argnums=(3,))


def train_step(
    settings: StepSettings, stage: Stage, clock: Clock, state: TrainState, photographs: Photographs,
    views: Array | None, scene_scale: Array, key: Array, rows: Any = None,
) -> tuple[TrainState, StepInfo]:  # fmt: skip
    """Run one iteration.

    Args:
      settings: static.
      stage: its numbers are traced.
      clock: `stage.clock()`.
      state: donated.
      photographs: of one image size.
      views: [V] int32 indices of the photographs to use; None: all of them.
      scene_scale: factor of the means' learning rate.
      key: of the stage; each iteration folds in its number.
      rows: [V] int32, their numbers among all training views; needed for corrections.
    """
    tried = attempt(settings, stage, clock, state, photographs, views, scene_scale, key, rows)
    status = jnp.where(state.status == FINE, _status(clock, tried), state.status)
    new, old = (dataclasses.replace(known, status=status) for known in (tried.state, state))
    chosen = jax.tree.map(lambda a, b: jnp.where(status == FINE, a, b), new, old)
    chosen = spread(settings.render.exchange, chosen)
    found = tried.views
    return chosen, StepInfo(
        loss=jnp.mean(found.loss), psnr=jnp.mean(found.psnr), num_pairs=jnp.max(found.num_pairs), status=status,
        num_live=chosen.model.num_live, num_refused=jnp.asarray(tried.info.num_refused),
        terms=jax.tree.map(jnp.mean, found.terms),
    )  # fmt: skip


def attempt(
    settings: StepSettings, stage: Stage, clock: Clock, state: TrainState, photographs: Photographs,
    views: Array | None, scene_scale: Array, key: Array, rows: Any = None,
) -> Attempt:  # fmt: skip
    """Return the outcome of one iteration. Arguments as of `train_step`, none of them donated."""
    iteration = state.iteration + 1
    num_keys = sum(event.num_keys for event in stage.events if isinstance(event, StepEvent))
    own_key = jax.random.fold_in(key, iteration)
    keys = jax.random.split(own_key, 1 + num_keys)
    dtype = state.model.gaussians.means.dtype
    batch = photographs.of(views)
    batch = batch._replace(viewmats=batch.viewmats.astype(dtype), Ks=batch.Ks.astype(dtype))
    batch = batch if batch.depths is None else batch._replace(depths=batch.depths.astype(dtype))
    if batch.points is not None:
        batch = batch._replace(points=batch.points._replace(depths=batch.points.depths.astype(dtype)))
    backgrounds = drawn_backgrounds(keys[0], settings.background, batch.viewmats.shape[0], dtype)
    own = rows_of(state.corrections, rows)
    is_gathering = any(s is not None and e.statistic for e, s in zip(stage.events, state.events, strict=True))
    shown = state.model
    if stage.jitter:
        shown = dataclasses.replace(shown, gaussians=jittered(own_key, shown.gaussians, stage.jitter))
    found = batch_gradients(settings.render, stage, clock, shown, batch, backgrounds, iteration, own, is_gathering)
    grads = jax.tree.map(lambda g: jnp.mean(g, axis=0), found.grads[:2])

    progress = clock.progress(state.iteration)
    decay = jnp.exp(clock.log_decay * progress)
    rate = (stage.rates.means * decay).astype(scene_scale.dtype) * scene_scale
    step = optimized(stage, state, grads, rate, progress)
    gaussians, params = step.params
    moments: AdamState = step.state
    model = dataclasses.replace(state.model, gaussians=gaussians, params=stage.appearance.project(params))
    cooled = stage.rates.cooled(rate, progress)
    now = Now(keys[1:], iteration, cooled, jnp.asarray(clock.num_iterations), scene_scale)
    seen = _seen(stage, batch, own, found)
    model, moments, events, info = _events(settings.due, stage, clock, now, seen, model, moments, state.events)
    corrections = tuple(
        updated(correction, known, rows, grad, progress)
        for correction, known, grad in zip(stage.corrections, state.corrections, found.grads[2], strict=True)
    )
    after = TrainState(model, moments, events, iteration, state.status, corrections)
    made: Any = (model.gaussians, model.params)
    if settings.due is not None:
        # Adam's steps are finite if gradients are. A check of what nothing else changed makes a GPU write it twice.
        made = _others(step.params, made)
    is_finite = _all_finite((found.loss, grads, found.grads[2], made, [known.rows for known in corrections]))
    return Attempt(found, (*grads, found.grads[2]), after, info, is_finite)


def _seen(stage: Stage, batch: Photographs, own: tuple[Array, ...], found: BatchGradients) -> Seen:
    """Return the views as events observe them."""
    height, width = batch.images.shape[1:3]
    cameras = Camera(batch.viewmats, batch.Ks, width, height)
    if own:
        cameras = jax.vmap(functools.partial(corrected_camera, stage.corrections))(own, cameras)
    colors = found.grads[0].sh[:, :, 0] / SH_C0
    if found.statistic is None or stage.statistic is None:
        nothing = jnp.zeros_like(colors)
        return Seen(cameras, nothing, jnp.zeros(colors.shape[:2], bool), colors)
    return Seen(cameras, *read_probe(found.statistic, stage.statistic, width, height), colors)


def optimized(stage: Stage, state: TrainState, grads: Any, rate_of_means: Array, progress: Array) -> OptStep:
    """Return (gaussians, params) and moments after Adam.

    Args:
      stage: its rates.
      state: before the step.
      grads: of (gaussians, params).
      rate_of_means: present rate of the means.
      progress: share of the stage that is done.
    """
    model = state.model
    of_gaussians = stage.rates.of_gaussians(stage.rates.of_means(rate_of_means, model), model.gaussians.sh_degree)
    of_params = stage.appearance.rates(0.0 if stage.params_rate is None else stage.params_rate, model.params)
    rates = stage.rates.cooled((of_gaussians, of_params), progress)
    return adam_update((model.gaussians, model.params), grads, state.moments, rates)


def _events(
    due: tuple[bool, ...] | None, stage: Stage, clock: Clock, now: Now, seen: Seen, model: Model, moments: AdamState,
    states: Sequence[Any],
) -> tuple[Model, AdamState, tuple[Any, ...], EventInfo]:  # fmt: skip
    """Gather statistics for the events, and apply those inside the step."""
    infos, left, at = EventInfo(jnp.asarray(True), jnp.zeros((), jnp.int32)), [], 0
    known = due or (None,) * len(stage.events)
    for event, times, state, is_due in zip(stage.events, clock.times, states, known, strict=True):
        if state is not None and event.observes:
            before, state = state, event.observe(state, model, seen)
            check_kept(f"stage {stage.name!r}: {type(event).__name__}.observe", state, before)
        if isinstance(event, StepEvent):
            own = now._replace(keys=now.keys[at : at + event.num_keys], times=times)
            at += event.num_keys
            apply = functools.partial(_applied, stage.name, event, own)
            model, moments, state, info = _at_its_times(apply, times, is_due, own.iteration, model, moments, state)
            possible = infos.is_possible & info.is_possible
            infos = EventInfo(possible, infos.num_refused + info.num_refused)
        left.append(state)
    return model, moments, tuple(left), infos


def _applied(
    stage_name: str, event: StepEvent, now: Now, model: Model, moments: AdamState, state: Any
) -> tuple[Model, AdamState, Any, EventInfo]:
    """Return the change by an event, which must keep all shapes."""
    name = f"stage {stage_name!r}: {type(event).__name__}.apply"
    change = checked_change(name, event.apply(now, model, moments, state))
    check_kept(f"{name}: model", change.model, model)
    check_kept(f"{name}: state", change.state, state)
    info = EventInfo(jnp.asarray(change.info.is_possible), jnp.asarray(change.info.num_refused, jnp.int32))
    return change.model, change.moments, change.state, info


def _at_its_times(
    apply: Callable[..., tuple[Model, AdamState, Any, EventInfo]], times: Times | None, is_due: bool | None,
    iteration: Array, model: Model, moments: AdamState, state: Any,
) -> tuple[Model, AdamState, Any, EventInfo]:  # fmt: skip
    """Return the change by an event if it is due; events that are past make none.

    Args:
      apply: `_applied` of the event.
      is_due: whether it is, if the host knows.
    """
    if times is None:
        return apply(model, moments, state)
    if state is None:
        return model, moments, state, EventInfo()

    def happen(carry: tuple[Model, AdamState, Any]) -> tuple[Model, AdamState, Any, EventInfo]:
        return apply(*carry)

    def wait(carry: tuple[Model, AdamState, Any]) -> tuple[Model, AdamState, Any, EventInfo]:
        return *carry, EventInfo(jnp.asarray(True), jnp.zeros((), jnp.int32))

    if is_due is not None:
        return (happen if is_due else wait)((model, moments, state))
    changed: tuple[Model, AdamState, Any, EventInfo]
    changed = jax.lax.cond(times.is_due(iteration), happen, wait, (model, moments, state))
    return changed


def _status(clock: Clock, tried: Attempt) -> Array:
    """Return the first reason why a step may not be taken."""
    found = tried.views
    status = jnp.where(tried.info.is_possible, FINE, IMPOSSIBLE)
    status = jnp.where(jnp.mean(found.loss) > clock.largest_loss, EXPLODED, status)
    status = jnp.where(tried.is_finite, status, NOT_FINITE)
    return jnp.where(jnp.any(found.is_overflow), OVERFLOW, status).astype(jnp.int32)


def _others(known: Any, tree: Any) -> list[Array]:
    """Return the leaves of a tree that are no leaves of a known one."""
    ids = {id(leaf) for leaf in jax.tree.leaves(known)}
    return [leaf for leaf in jax.tree.leaves(tree) if id(leaf) not in ids]


def _all_finite(tree: Any) -> Array:
    """Return whether all numbers are finite: row by row first, then by one reduction of all rows."""
    rows = [jnp.all(jnp.isfinite(leaf), axis=tuple(range(1, leaf.ndim))) for leaf in jax.tree.leaves(tree)]
    # Without the barrier XLA would reduce each leaf to one flag apart, which costs a GPU two launches a leaf.
    return jnp.all(jax.lax.optimization_barrier(jnp.concatenate(rows)))
