"""Start of a stage: Gaussians at a scene's points, or a given model; and its state, with room for what events add."""

import dataclasses
from collections.abc import Iterator, Sequence
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from a2tg_jax.appearance import Appearance, allocate_appearance
from a2tg_jax.appearance.base import check_appearance, join_rows, without_arrays
from a2tg_jax.appearance.parts import Part, nearest_gaussians
from a2tg_jax.base.checks import fields_of
from a2tg_jax.base.user_warnings import warn
from a2tg_jax.core.cameras import Camera
from a2tg_jax.core.gaussians import INITIAL_OPACITY, Gaussians, init_from_points, no_rows
from a2tg_jax.core.geometry import FILTER_VARIANCE, pixel_sizes
from a2tg_jax.core.optim import adam_init
from a2tg_jax.core.origin import Origin
from a2tg_jax.core.pytree import partition
from a2tg_jax.core.sh import NUM_BASES
from a2tg_jax.core.sight import Sight, unseeing
from a2tg_jax.core.similarity import Similarity
from a2tg_jax.core.table import Table, is_table, map_rows
from a2tg_jax.events import LEAST_LEFT, Change, Event, HostEvent
from a2tg_jax.model import Model, check_model, plain_gaussians
from a2tg_jax.scene import Scene
from a2tg_jax.training.corrections import initial_corrections
from a2tg_jax.training.options import System
from a2tg_jax.training.returned import calling, checked_change
from a2tg_jax.training.stage import Stage
from a2tg_jax.training.step import TrainState

T = TypeVar("T")

KEY_OF_APPEARANCE = 0x7E8E1  # no stage's number, which is folded into the same key
LEAST_OPACITY = INITIAL_OPACITY
"""Lower bound of the reduced opacities: the initial opacity of 3DGS."""
SMALLEST_SIDE = 1e-6
GREY = 0.5
"""Colour of points without one."""
GREY_SLACK = 0.01
"""Largest difference of a colour that counts as this grey."""


# Gaussians at the points of the scene


def check_points(scene: Scene, system: System) -> None:
    """Raise ValueError, naming the options to change, if no training view sees any point, or the events of the first
    stage cannot work with the initial number of Gaussians."""
    _check_seen("scene.points", np.asarray(scene.points), scene)
    num = initial_number(scene, system)
    rows_needed(system.stages()[0], num, system)
    system.check_initial_number(num)


def _check_seen(name: str, points: np.ndarray, scene: Scene) -> None:
    if not np.isfinite(points).all():
        return  # `init_from_points` and `check_model` name them.
    sights = [Sight.of_camera(view.camera) for view in scene.train]
    if len(unseeing(points, sights)) == len(sights):
        raise ValueError(
            f"{name}: no training view sees any of the {len(points):,} points: they must be in the world of the views' "
            "cameras; scene.transform leads there from the original world"
        )


def initial_number(scene: Scene, system: System) -> int:
    """Return the number of initial Gaussians: as requested, at most one for each point, and at most what the first
    stage has room for."""
    num = len(scene.points)
    caps = [event.most_gaussians for event in system.stages()[0].events]
    return min([num, system.initial_gaussians or num, *(cap for cap in caps if cap is not None)])


def initial_model(scene: Scene, system: System) -> Model:
    """Return Gaussians at the scene's points, as many as the first stage has room for; `check_points` checks them."""
    first = system.stages()[0]
    num = initial_number(scene, system)
    degree = system.initial_sh_degree
    opacity = system.initial_opacity
    gaussians = init_from_points(scene.points, start_colors(scene), num, system.seed, opacity=opacity, sh_degree=degree)
    adapted = fainter_where_dense if first.appearance.has_low_pass else wider_where_dense
    return Model(adapted(gaussians, [view.camera for view in scene.train]))


def start_colors(scene: Scene) -> np.ndarray:
    """Return the colours [P, 3] of a scene's points; grey, with a warning, if all points have one other colour."""
    # Point clouds without colours, from a scanner or a depth map, are often stored as black or white.
    colors = np.asarray(scene.colors)
    if len(colors) < 2 or (colors != colors[0]).any() or (np.abs(colors[0] - GREY) < GREY_SLACK).all():
        return colors
    color = ", ".join(f"{number:g}" for number in colors[0].round(3).tolist())
    warn(
        f"all {len(colors):,} points of {scene.name} have one colour ({color}): taken as points without colours, "
        "which start grey"
    )
    return np.full_like(colors, GREY)


def wider_where_dense(gaussians: Gaussians, cameras: Sequence[Camera]) -> Gaussians:
    """Widen Gaussians to a standard deviation of a pixel at least, from the camera where they are largest (host).

    Without a low-pass filter, a smaller splat shows only if it covers a pixel's centre, and rarely overlaps others.
    Gaussians that no camera sees stay unchanged.
    """
    pixels = _largest_sizes(gaussians, cameras)
    growth = np.where(pixels > 0, np.maximum(1 / np.maximum(pixels, SMALLEST_SIDE), 1.0), 1.0)
    log_scales = np.asarray(gaussians.log_scales) + np.log(growth)[:, None]
    return dataclasses.replace(gaussians, log_scales=jnp.asarray(log_scales, gaussians.log_scales.dtype))


def fainter_where_dense(gaussians: Gaussians, cameras: Sequence[Camera]) -> Gaussians:
    """Lower the opacity of Gaussians that are smaller than a pixel to every camera (host).

    The low-pass filter draws each of them over a pixel, so k = filter² / s² of them overlap. s is the standard
    deviation in pixels from the camera where it is largest. k layers of the new opacity 1 − (1 − o)^(1/k) are as opaque
    as one of the given opacity o; the new one is at least `LEAST_OPACITY`. Many opaque layers would hide the splats
    behind them, which then do not learn.
    """
    sizes = _largest_sizes(gaussians, cameras)
    # Measured in experiments/NOTEBOOK.md, "Many initial points".
    layers = np.maximum(FILTER_VARIANCE / np.maximum(sizes, SMALLEST_SIDE) ** 2, 1.0)
    opacities = np.asarray(gaussians.opacities, np.float64)
    # An opacity that is below the bound already stays.
    shared = np.maximum(1 - (1 - opacities) ** (1 / layers), np.minimum(opacities, LEAST_OPACITY))
    logits = np.where(shared < opacities, np.log(shared / (1 - shared)), np.asarray(gaussians.logit_opacities))
    return dataclasses.replace(gaussians, logit_opacities=jnp.asarray(logits, gaussians.logit_opacities.dtype))


def _largest_sizes(gaussians: Gaussians, cameras: Sequence[Camera]) -> np.ndarray:
    """Return the smaller standard deviation of Gaussians in pixels [N], from the camera where it is largest."""
    means = np.asarray(gaussians.means, np.float64)
    scales = np.asarray(gaussians.scales, np.float64)
    largest = np.zeros(len(means))
    for camera in cameras:
        viewmat = np.asarray(camera.viewmat, np.float64)
        K = np.asarray(camera.K, np.float64)
        largest = np.maximum(largest, pixel_sizes(means, scales, viewmat, K))
    return largest


# A given model


def given_model(start: Model, scene: Scene, system: System, index: int) -> Model:
    """Return a model that a stage is to start from, with spherical harmonics of the degree at which training begins.

    Warns of what the stage leaves out, and of options that do not apply. Raises ValueError if the model is invalid, or,
    naming the option, if it has more Gaussians than a cap or a budget allows.
    """
    with fields_of("start"):
        check_model(start)
    # Tables are rebuilt, because in training the block of Gaussian i is in row i (`Table.gather`).
    start = start[:]
    stages = system.all_stages()
    stage = stages[index]
    _check_given_number(start.num, stage, system, is_first=index == 0)
    _check_given_place(start, scene)
    degree = system.initial_sh_degree
    # The appearance of the stage before is expected as well: this stage replaces it, such as textures by others.
    expected = (stage.appearance, stages[max(index - 1, 0)].appearance)
    is_expected = start.appearance.template in expected
    if is_expected and start.gaussians.sh_degree == degree:
        return start
    if is_expected and start.appearance.coefficients is not None:
        raise ValueError(
            f"start has spherical harmonics of degree {start.gaussians.sh_degree} for all Gaussians, and "
            f"{type(system).__name__} begins with degree {degree}: choose the options that it was trained with"
        )
    lost = left_out(start, degree, None if is_expected else stage.appearance)
    if lost:
        warn(f"start: stage {stage.name!r} leaves out {' and '.join(lost)}")
    gaussians = start.gaussians
    appearance = start.appearance
    if not is_expected:
        keeps_shapes = stage.appearance.exponents is not None
        gaussians = plain_gaussians(start, keeps_shapes=keeps_shapes)
        appearance = appearance if keeps_shapes else Appearance()
    return dataclasses.replace(start, gaussians=with_degree(gaussians, degree), appearance=appearance)


def _check_given_number(num: int, stage: Stage, system: System, *, is_first: bool) -> None:
    """Raise ValueError, naming the option, unless a stage can start from a number of given Gaussians. Warn if that is
    not the number that was asked for."""
    if num < LEAST_LEFT:
        raise ValueError(f"start must have at least {LEAST_LEFT} Gaussians; got {num}")
    if not is_first:
        if system.memory_budget is not None:
            system.check_given_number(num)
        return
    system.check_initial_number(num)
    for most, limit in _exceeded(stage, num, system):
        raise ValueError(
            f"start must have at most {most:,} Gaussians, for which {limit} has room; got {num:,}: raise {limit}, "
            f"or start from some of them, such as start[:{most}]"
        )
    if system.initial_gaussians not in (None, num):
        warn(
            f"initial_gaussians of {system.initial_gaussians:,} does not apply: training starts from the {num:,} "
            "Gaussians of start"
        )


def _check_given_place(start: Model, scene: Scene) -> None:
    """Raise ValueError if no training view sees a given model. Warn if its world is not the scene's."""
    transform = scene.transform if start.origin is None else start.origin.transform
    if not _are_close(transform, scene.transform):
        warn(
            "start was made in another world than the scene's, so that its Gaussians are elsewhere: give "
            "start.transform(start.origin.transform.inverse().then(scene.transform))"
        )
    _check_seen("start.gaussians.means", np.asarray(start.gaussians.means), scene)


def left_out(model: Model, degree: int, template: Appearance | None) -> list[str]:
    """Return in words what a model loses if its spherical harmonics get a degree, and its appearance the options of a
    template, which keeps only the shapes of kernels. Template None: the appearance is kept."""
    appearance = model.appearance
    lost = []
    has_shapes = appearance.exponents is not None
    if has_shapes and template is not None and template.exponents is None:
        lost.append("the shapes of its kernels (the nearest Gaussians replace them)")
    if template is not None and (not appearance.is_portable or appearance.texture is not None):
        lost.append("what its splats show besides " + ("kernels" if has_shapes else "Gaussians"))
    if model.sh[:, NUM_BASES[degree] :].any():
        lost.append(f"its spherical harmonics above degree {degree}")
    return lost


def with_degree(gaussians: Gaussians, degree: int) -> Gaussians:
    """Return Gaussians with spherical harmonics of another degree, cut off or padded by zeros (host)."""
    sh = np.zeros((gaussians.num, NUM_BASES[degree], 3), gaussians.sh.dtype)
    num = min(sh.shape[1], gaussians.sh.shape[1])
    sh[:, :num] = np.asarray(gaussians.sh)[:, :num]
    return dataclasses.replace(gaussians, sh=jnp.asarray(sh))


def _are_close(similarity: Similarity, other: Similarity) -> bool:
    """Return whether two similarities are equal but for rounding."""
    pairs = zip(dataclasses.astuple(similarity), dataclasses.astuple(other), strict=True)
    return all(np.allclose(a, b, rtol=1e-6, atol=1e-6) for a, b in pairs)


# The state of a stage


def state_of_model(
    model: Model, stage: Stage, system: System, names: Sequence[str], num_devices: int = 1
) -> TrainState:
    """Return the state before the first iteration of a stage that starts from a model, given the names of the training
    views. The corrections of these in the model's origin continue."""
    with_rows = padded(copied(model.live), stage, system, num_devices)
    return with_room(stage, initial_state(stage, with_rows, names, model.origin))


def copied(tree: T) -> T:
    """Return a pytree on the device with buffers that a step may take over."""
    placed: T = jax.device_put(tree, may_alias=False)
    return placed


def initial_state(stage: Stage, model: Model, names: Sequence[str] = (), origin: Origin | None = None) -> TrainState:
    """Return the state before the first iteration of a stage, given a model with its rows and appearance, the names of
    the training views, and the origin of the model that it starts from, whose corrections continue."""
    events = [event.init(model) if times else None for event, times in zip(stage.events, stage.times, strict=True)]
    return TrainState(
        model=model,
        moments=adam_init(partition(model)[0]),
        events=tuple(events),
        iteration=jnp.zeros((), jnp.int32),
        status=jnp.zeros((), jnp.int32),
        corrections=initial_corrections(stage.corrections, names, origin, model.gaussians.means.dtype),
    )


def continued_state(before: Stage, stage: Stage, state: TrainState) -> TrainState:
    """Return the state before the first iteration of a stage that continues the one before, given that one's last
    state. Events that both stages hold continue as well."""
    state_of = {id(event): event_state for event, event_state in zip(before.events, state.events, strict=True)}
    events = []
    for event, times in zip(stage.events, stage.times, strict=True):
        event_state = state_of.get(id(event))
        is_new = event_state is None and bool(times)
        events.append(event.init(state.model) if is_new else event_state)
    # Two arrays: the step takes over each buffer once.
    iteration = jnp.zeros((), jnp.int32)
    status = jnp.zeros((), jnp.int32)
    return dataclasses.replace(state, events=tuple(events), iteration=iteration, status=status)


def with_room(stage: Stage, state: TrainState) -> TrainState:
    """Return the state, padded for what events will add between steps, so that no step is compiled again."""
    model = state.model
    moments = state.moments
    num = model.num
    num_bytes = float(model.num_bytes)
    for event, event_state in zip(stage.events, state.events, strict=True):
        if isinstance(event, HostEvent) and event_state is not None:
            with calling(event, "with_room", stage.name):
                padding = Change(*event.with_room(model, moments, num_bytes, stage.iterations), event_state)
                padding = checked_change(padding)
            model = padding.model
            moments = padding.moments
        num_bytes = event.most_bytes(num_bytes, num, stage.iterations)
    return dataclasses.replace(state, model=model, moments=moments)


# Rows


def _limit_of(event: Event, system: System) -> str:
    """Return the path of the option that bounds the number of Gaussians of an event."""
    return f"{system.path_of(event)}.{event.limited_by}" if system.memory_budget is None else "memory_budget"


def _exceeded(stage: Stage, num: int, system: System) -> Iterator[tuple[int, str]]:
    """Yield the bounds of a stage's events that a number of Gaussians exceeds, and the options that set them."""
    for event in stage.events:
        most = event.most_gaussians
        if most is not None and num > most:
            yield most, _limit_of(event, system)


def rows_needed(stage: Stage, num: int, system: System) -> int:
    """Return the rows that a stage allocates for `num` Gaussians. ValueError: naming the options to change, if an event
    cannot reach its number."""
    rows = num
    for event in stage.events:
        try:
            rows = max(rows, event.num_rows(num, stage.iterations))
        except ValueError as error:
            reason = str(error)
            field = event.limited_by
            limit = _limit_of(event, system)
            if not (field and reason.startswith(field)):
                raise ValueError(f"{system.path_of(event)}: {reason}") from error
            reason = limit + reason.removeprefix(field)
            raise ValueError(f"{reason}: raise {system.more_growth()}, or lower {limit}") from error
    return rows


def padded(model: Model, stage: Stage, system: System, num_devices: int = 1) -> Model:
    """Return the model with the appearance of a stage and with spare rows for its events.

    Arrays of the model's appearance are kept where the stage has a part of the same options, or the same array of the
    same class. Others are allocated, with a warning if only their shapes differ. A stage without shapes of kernels
    takes the nearest Gaussians, with a warning. The number of devices divides the number of rows. ValueError: if
    Gaussians would be added to a model whose textures have grown.
    """
    num = model.num_rows
    for most, limit in _exceeded(stage, num, system):
        warn(f"stage {stage.name!r} begins with {num:,} Gaussians, more than the {limit} of {most:,}: none is added")
    room = -(-rows_needed(stage, num, system) // num_devices) * num_devices
    gaussians = model.gaussians
    shapes = model.appearance.shapes
    if shapes is not None and stage.appearance.exponents is None:
        warn(f"stage {stage.name!r} has no shapes of kernels: it takes the Gaussians nearest to the model's kernels")
        gaussians = nearest_gaussians(gaussians, np.asarray(shapes))
    if room > num:
        spare = no_rows(room - num, gaussians.sh.shape[1], gaussians.means.dtype)
        gaussians = join_rows([gaussians, spare])
    appearance = model.appearance
    if appearance.template != stage.appearance or room > num:
        allocated = new_appearance(stage.appearance, gaussians, system)
        appearance = dataclasses.replace(allocated, **_kept_fields(appearance, allocated, stage))
        if room > num:
            appearance = _with_spare_rows(appearance, allocated, num, stage)
    check_appearance(appearance, gaussians)
    return Model(gaussians, appearance, jnp.asarray(num, jnp.int32))


def _kept_fields(before: Appearance, allocated: Appearance, stage: Stage) -> dict[str, Any]:
    """Return the parts and arrays of the appearance before a stage that fit the one that the stage allocates, by field.

    A part fits if its options are equal. An array that both classes have fits if the shape of a row is equal; you are
    warned of others.
    """
    is_related = isinstance(before, type(allocated)) or isinstance(allocated, type(before))
    is_same = before.template == stage.appearance
    kept: dict[str, Any] = {}
    for field in dataclasses.fields(allocated):
        name = field.name
        old = getattr(before, name, None)
        new = getattr(allocated, name)
        if old is None or new is None or field.metadata.get("static"):
            continue
        if is_same or (isinstance(old, Part) and _options(old) == _options(new)):
            kept[name] = old
        elif not isinstance(old, Part) and is_related:
            first = 0 if field.metadata.get("shared") else 1
            if _shapes(old, first) == _shapes(new, first):
                kept[name] = old
            else:
                warn(
                    f"stage {stage.name!r} begins with new {type(allocated).__name__}.{name}: the shape of the model's "
                    "does not fit"
                )
    return kept


def _shapes(tree: Any, first: int) -> Any:
    """Return the structure of a tree and the shapes of its arrays from an axis on; tables may have any blocks."""
    leaves, structure = jax.tree.flatten(tree, is_leaf=is_table)
    return structure, [None if is_table(leaf) else jnp.shape(leaf)[first:] for leaf in leaves]


def _with_spare_rows(kept: Appearance, allocated: Appearance, num: int, stage: Stage) -> Appearance:
    """Return an appearance with the first `num` rows of one and the further rows of a larger one."""
    grown = f"stage {stage.name!r} would add Gaussians to a model whose textures or degrees have grown already"

    def with_spare(few: Array, more: Array) -> Array:
        if more.shape[1:] != few.shape[1:] or len(more) < len(few):
            raise ValueError(grown)
        return more.at[:num].set(few[:num])

    def with_spare_blocks(few: Table, more: Table) -> Table:
        if more.bucket_sizes != few.bucket_sizes:
            raise ValueError(grown)
        return dataclasses.replace(more, buckets=tuple(map(with_spare, few.buckets, more.buckets)))

    return map_rows(with_spare, with_spare_blocks, kept, allocated)


def _options(part: Part) -> Part:
    return without_arrays(part, lambda path: None)


def new_appearance(template: Appearance, gaussians: Gaussians, system: System) -> Appearance:
    """Return the appearance that a stage of a system begins with, of the options of a template."""
    key = jax.random.fold_in(jax.random.key(system.seed), KEY_OF_APPEARANCE)
    return allocate_appearance(template, key, gaussians)
