"""One training step, jitted once per image size and stage: render, loss, gradients, Adam, events.

A step is not taken if the tile lists overflow, a number is not finite or the loss explodes. Then the state keeps its
values, and its status makes all further steps idle, so that Python may read it some steps later and lose nothing.
"""

import dataclasses
import functools
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.sharding import Mesh

from a2tg_jax.appearance import project_appearance
from a2tg_jax.core.cameras import Camera
from a2tg_jax.core.gaussians import Gaussians
from a2tg_jax.core.optim import AdamState, adam_update
from a2tg_jax.core.pytree import combine, partition, pytree
from a2tg_jax.core.sh import SH_C0
from a2tg_jax.events import Change, EventInfo, Now, Seen, StepEvent, read_probe
from a2tg_jax.model import Model
from a2tg_jax.parallel import in_views, with_rows_divided, with_rows_of_views_divided
from a2tg_jax.rasterize.render_types import RenderOutput, RenderSettings
from a2tg_jax.training.batches import Photographs, over_background
from a2tg_jax.training.corrections import (
    CorrectionState,
    corrected_camera,
    corrected_color,
    penalties,
    updated,
)
from a2tg_jax.training.gradients import Differentiated, TracedView, differentiate
from a2tg_jax.training.returned import calling, check_kept, check_scalar, checked_change
from a2tg_jax.training.stage import Background, Clock, Stage
from a2tg_jax.training.terms import Target

FINE, OVERFLOW, NOT_FINITE, IMPOSSIBLE, EXPLODED = range(5)
"""Status of a state: the reason why the last step was not taken."""


@pytree
class TrainState:
    """All values that training changes. Everything else follows from the system and the iteration."""

    model: Model
    moments: AdamState
    """Adam's moments of the model's floats."""
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
    """Settings that a step is compiled for, besides its stage; hashable."""

    render: RenderSettings
    """Render settings with a capacity."""
    background: Background
    happens: tuple[bool, ...] | None = None
    """Whether each event of the stage happens; a step is compiled for each pattern. With None the step itself decides,
    which makes a GPU wait for the host."""
    mesh: Mesh | None = None
    """Devices that draw the views; None: one."""
    is_halved: bool = False
    """Whether photographs are halved (`Photographs.halved`)."""


class StepInputs(NamedTuple):
    """Inputs of a step besides the state, traced."""

    stage: Stage
    clock: Clock
    """`stage.clock(iteration)`."""
    photographs: Photographs
    """Photographs of one image size."""
    chosen: Array | np.ndarray | None
    """[V] int32 indices of the photographs to use; None: all of them."""
    views: Array | np.ndarray | None
    """[V] int32, their numbers among all training views; needed for corrections."""
    scene_scale: Array
    """Factor of the means' learning rate."""
    key: Array
    """Key of the stage; each iteration folds in its number."""


class StepInfo(NamedTuple):
    """Scalars about a step, for the host."""

    iteration: Array
    """Number of finished iterations of the stage."""
    loss: Array
    psnr: Array
    """Mean over the views, in dB."""
    num_pairs: Array
    """Largest number of pairs among the views, the least capacity."""
    status: Array
    """Status after the step."""
    num_live: Array
    num_refused: Array
    """Number of Gaussians that events could not add because all rows were taken."""
    terms: dict[str, Array]
    """Summands of the loss by name."""


class Figures(NamedTuple):
    """Figures of a view besides its loss."""

    psnr: Array
    is_overflow: Array
    terms: dict[str, Array]
    """Summands of the loss by name."""


class Attempt(NamedTuple):
    """Outcome of a step, taken or not."""

    views: Differentiated
    """Losses, gradients and `Figures` of the V views, [V, ...]."""
    grads: tuple[Gaussians, Any, tuple[Array, ...]]
    """Mean gradients over the views; of corrections, gradients in the row of each view [V, ...]."""
    state: TrainState
    """State after the step, with the status of the state before."""
    info: EventInfo
    is_finite: Array
    """Whether all of these are finite: losses, gradients, and the results of Adam, projections and events."""


@functools.cache
def jitted_step() -> jax.stages.Wrapped:
    """Return `train_step`, jitted, with the state's buffers donated."""
    # Made at the first call: importing this library calls no `jax.jit`.
    return jax.jit(train_step, static_argnums=(0,), donate_argnums=(1,))


def train_step(settings: StepSettings, state: TrainState, inputs: StepInputs) -> tuple[TrainState, StepInfo]:
    """Run one iteration. The settings are static; the state is donated."""
    tried = attempt(settings, state, inputs)
    drawn = tried.views
    figures: Figures = drawn.auxiliary
    # The last assignment wins: after an overflow all other numbers are meaningless.
    status = jnp.where(tried.info.is_possible, FINE, IMPOSSIBLE)
    status = jnp.where(jnp.mean(drawn.value) > inputs.clock.largest_loss, EXPLODED, status)
    status = jnp.where(tried.is_finite, status, NOT_FINITE)
    status = jnp.where(jnp.any(figures.is_overflow), OVERFLOW, status).astype(jnp.int32)
    status = jnp.where(state.status == FINE, status, state.status)
    # Chosen inside the step, because it has taken over the old state's buffers.
    taken = dataclasses.replace(tried.state, status=status)
    kept = dataclasses.replace(state, status=status)
    chosen = jax.tree.map(lambda new, old: jnp.where(status == FINE, new, old), taken, kept)
    chosen = with_rows_divided(settings.mesh, chosen)
    return chosen, StepInfo(
        iteration=chosen.iteration,
        loss=jnp.mean(drawn.value),
        psnr=jnp.mean(figures.psnr),
        num_pairs=jnp.max(drawn.num_pairs),
        status=status,
        num_live=chosen.model.num_live,
        num_refused=tried.info.num_refused,
        terms=jax.tree.map(jnp.mean, figures.terms),
    )


def attempt(settings: StepSettings, state: TrainState, inputs: StepInputs) -> Attempt:
    """Return the outcome of one iteration; nothing is donated."""
    stage = inputs.stage
    clock = inputs.clock
    scene_scale = inputs.scene_scale
    iteration = state.iteration + clock.stride
    model = state.model
    num_keys = sum(event.num_keys for event in stage.events if isinstance(event, StepEvent))
    # By iteration, so that repeated and resumed steps draw the same numbers.
    keys = jax.random.split(jax.random.fold_in(inputs.key, iteration), 1 + num_keys)
    dtype = model.gaussians.means.dtype
    batch = inputs.photographs.of(inputs.chosen, dtype)
    batch = batch.halved() if settings.is_halved else batch
    if settings.background == "random":
        backgrounds = jax.random.uniform(keys[0], (len(batch.viewmats), 3), dtype)
    else:
        backgrounds = jnp.full((len(batch.viewmats), 3), 1.0 if settings.background == "white" else 0.0, dtype)
    correction_rows = tuple(correction.rows[inputs.views] for correction in state.corrections)
    is_gathering = False
    for event, event_state in zip(stage.events, state.events, strict=True):
        is_gathering |= event_state is not None and event.statistic is not None
    drawn = batch_gradients(settings, inputs, model, batch, backgrounds, iteration, correction_rows, is_gathering)
    # Gradients of corrections belong to one view each.
    grads = jax.tree.map(lambda g: jnp.mean(g, axis=0), (drawn.gaussians, drawn.appearance))

    progress = clock.progress(state.iteration)
    decay = jnp.exp(clock.log_decay * progress)
    rate = (stage.rates.means * decay).astype(scene_scale.dtype) * scene_scale
    step = optimized(stage, state, grads, rate, progress)
    moments: AdamState = step.state
    model = combine(step.params, partition(model)[1])
    model = dataclasses.replace(model, appearance=project_appearance(model.appearance))

    seen = _seen(stage, batch, correction_rows, drawn)
    num_iterations = jnp.asarray(clock.num_iterations)
    now = Now(keys[1:], clock.scheduled(iteration), stage.cooled(rate, progress), num_iterations, scene_scale)
    change = _after_events(settings, inputs, now, seen, Change(model, moments, state.events))
    corrections = tuple(
        updated(correction, correction_state, inputs.views, grad, progress)  # type: ignore[arg-type]
        for correction, correction_state, grad in zip(stage.corrections, state.corrections, drawn.rows, strict=True)
    )
    after = TrainState(change.model, change.moments, change.state, iteration, state.status, corrections)
    changed: Any = partition(change.model)[0]
    if settings.happens is not None:
        # Adam's results are finite if the gradients are. Only leaves that a projection or an event has changed, which
        # are other tracers, are checked, because the check makes a GPU write a leaf twice.
        ids_after_adam = {id(leaf) for leaf in jax.tree.leaves(step.params)}
        changed = [leaf for leaf in jax.tree.leaves(changed) if id(leaf) not in ids_after_adam]
    rows_after = [correction.rows for correction in corrections]
    is_finite = _are_finite(jax.tree.leaves((drawn.value, grads, drawn.rows, changed, rows_after)))
    return Attempt(drawn, (*grads, drawn.rows), after, change.info, is_finite)


def _seen(stage: Stage, batch: Photographs, correction_rows: tuple[Array, ...], drawn: Differentiated) -> Seen:
    """Return what events observe of a step: its cameras, and the gradients of the splats in each view."""
    height, width = batch.images.shape[1:3]
    cameras = Camera(batch.viewmats, batch.Ks, width, height)
    if correction_rows:
        cameras = jax.vmap(functools.partial(corrected_camera, stage.corrections))(correction_rows, cameras)
    # ∂L/∂colour: the colour is linear in the first coefficient, with the factor SH_C0.
    colors = drawn.gaussians.sh[:, :, 0] / SH_C0
    seen = Seen(cameras, jnp.zeros_like(colors), jnp.zeros(colors.shape[:2], bool), colors)
    if drawn.probe is None or stage.statistic is None:
        return seen
    gradients, is_visible = read_probe(drawn.probe, stage.statistic, width, height)
    return seen._replace(gradients=gradients, is_visible=is_visible)


def _are_finite(leaves: Sequence[Array]) -> Array:
    """Return whether all numbers of some arrays are finite."""
    # Row by row first, then one reduction of all rows. Without the barrier XLA would reduce each leaf separately to one
    # flag, which costs a GPU two launches a leaf.
    are_finite = []
    for leaf in map(jnp.atleast_1d, leaves):
        are_finite.append(jnp.all(jnp.isfinite(leaf), axis=tuple(range(1, leaf.ndim))))
    return jnp.all(jax.lax.optimization_barrier(jnp.concatenate(are_finite)))


def batch_gradients(
    settings: StepSettings,
    inputs: StepInputs,
    model: Model,
    batch: Photographs,
    backgrounds: Array,
    iteration: Array,
    correction_rows: tuple[Array, ...],
    is_gathering: bool,
) -> Differentiated:
    """Return losses, gradients and `Figures` of V views [V, ...], which a device draws one after the other.

    Backgrounds are [V, 3]; `correction_rows` has the rows [V, ...] of each correction. `is_gathering`: whether an event
    still gathers the stage's statistic.
    """
    stage = inputs.stage
    clock = inputs.clock
    height, width = batch.images.shape[1:3]
    highest = settings.render.sh_degree
    degree = jnp.minimum((iteration - 1) // clock.sh_interval, highest) if stage.raises_sh_degree else highest

    def loss(model: Model, view: TracedView, output: RenderOutput) -> tuple[Array, Figures]:
        image, alpha, mask, depth = view.target
        photograph = over_background(image, alpha, view.background)
        color = corrected_color(view.corrections, view.rows, output.color)
        if mask is not None:  # Excluded pixels of both are black, so that they add to no loss term.
            photograph = jnp.where(mask[..., None], photograph, jnp.zeros_like(photograph))
            color = jnp.where(mask[..., None], color, jnp.zeros_like(color))
        target = Target(view.camera, photograph, view.background, mask, clock.progress(iteration - 1), depth)
        output = dataclasses.replace(output, color=color)
        added = penalties(view.corrections, view.rows)
        parts_by_name = {"corrections": functools.reduce(jnp.add, added)} if added else {}
        values: list[Array] = []
        for index, term in enumerate(stage.losses):
            if hasattr(term, "parts"):
                parts: dict[str, Array] = term.parts(model, target, output)
            else:
                parts = {getattr(term, "name", type(term).__name__): term(model, target, output)}
            for name, part in parts.items():
                check_scalar(f"losses[{index}]", part)
                parts_by_name[name if name not in parts_by_name else f"{name}_{index + 1}"] = part
            values.append(functools.reduce(jnp.add, parts.values()))
        value = functools.reduce(jnp.add, [*values, *added])
        # PSNR is of what a screen shows; the loss is of unclipped colours (`losses`).
        error = jnp.mean((jnp.clip(output.color, 0, 1) - target.image) ** 2)
        if mask is not None:  # The mean over the pixels that count; the error of the others is 0.
            share = jnp.mean(mask.astype(error.dtype))
            # No pixel of a halved photograph may count.
            error = error / jnp.maximum(share, 1 / mask.size)
        return value, Figures(-10 * jnp.log10(error), output.overflow, parts_by_name)

    def gradients_of(model: Model, arrays: tuple[Any, ...]) -> Differentiated:
        viewmat, K, background, rows, pictures = arrays
        view = TracedView(Camera(viewmat, K, width, height, batch.rays), background, stage.corrections, rows, pictures)
        return differentiate(
            loss, model, view, settings.render,
            has_geometry=stage.has_geometry, sh_degree=degree, statistic=stage.statistic, has_probe=is_gathering,
        )  # fmt: skip

    def gradients_of_views(model: Model, arrays: tuple[Any, ...]) -> Differentiated:
        return jax.lax.map(functools.partial(gradients_of, model), arrays)

    pictures = batch.images, batch.alphas, batch.masks, batch.depths
    arrays = batch.viewmats, batch.Ks, backgrounds, correction_rows, pictures
    views = in_views(settings.mesh, gradients_of_views)(model, arrays)
    return with_rows_of_views_divided(settings.mesh, views)


def optimized(stage: Stage, state: TrainState, grads: Any, rate_of_means: Array, progress: Array) -> Any:
    """Return the result of `adam_update` for the model's floats, given the gradients of the Gaussians and of the floats
    of their appearance, the present rate of the means, and the share of the stage that is done."""
    floats, _ = partition(state.model)
    of_gaussians = stage.rates.of_gaussians(rate_of_means, floats.gaussians.sh_degree)
    of_appearance = floats.appearance.rates(0.0 if stage.appearance_rate is None else stage.appearance_rate)
    of_gaussians, of_appearance = stage.cooled((of_gaussians, of_appearance), progress)
    rates = dataclasses.replace(floats, gaussians=of_gaussians, appearance=of_appearance)
    grads = dataclasses.replace(floats, gaussians=grads[0], appearance=grads[1])
    return adam_update(floats, grads, state.moments, rates)


def _after_events(settings: StepSettings, inputs: StepInputs, now: Now, seen: Seen, change: Change) -> Change:
    """Return the change by Adam followed by the events inside the step. Its `state` is a tuple of the state of each
    event of the stage, which gathers its statistic first."""
    states = change.state
    change = change._replace(info=EventInfo(jnp.asarray(True), jnp.zeros((), jnp.int32)))
    new_states = []
    first_key = 0
    for place, (event, num_left) in enumerate(zip(inputs.stage.events, inputs.clock.num_left, strict=True)):
        state = states[place]
        if state is not None and event.observes:
            observed = event.observe(state, change.model, seen)
            check_kept(f"{type(event).__name__}.observe", observed, state)
            state = observed
        if isinstance(event, StepEvent):
            keys = now.keys[first_key : first_key + event.num_keys]
            first_key += event.num_keys
            of_event = now._replace(keys=keys, num_left=None if num_left is None else jnp.asarray(num_left, jnp.int32))
            apply = functools.partial(_applied, event, of_event)
            change = change._replace(state=state)
            if num_left is None:  # It happens after every iteration.
                change = apply(change)
            elif state is not None:  # It is not past.
                if settings.happens is None:  # The step itself decides.
                    change = jax.lax.cond(num_left > 0, apply, lambda before: before, change)
                elif settings.happens[place]:
                    change = apply(change)
            state = change.state
        new_states.append(state)
    return change._replace(state=tuple(new_states))


def _applied(event: StepEvent, now: Now, before: Change) -> Change:
    """Return a change followed by an event, which must keep the shapes of model and state."""
    with calling(event, "apply"):
        change = checked_change(event.apply(now, before.model, before.moments, before.state))
        check_kept("model", change.model, before.model)
        check_kept("state", change.state, before.state)
    is_possible = before.info.is_possible & jnp.asarray(change.info.is_possible)
    num_refused = before.info.num_refused + jnp.asarray(change.info.num_refused, jnp.int32)
    return Change(change.model, change.moments, change.state, EventInfo(is_possible, num_refused))
