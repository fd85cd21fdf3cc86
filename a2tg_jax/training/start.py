"""Start of training: Gaussians at a scene's points, and spare rows for those that events add."""

import dataclasses
import warnings
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from a2tg_jax.appearance import Appearance
from a2tg_jax.appearance.nearest_gaussians import nearest_gaussians
from a2tg_jax.core.cameras import Camera
from a2tg_jax.core.gaussians import INITIAL_OPACITY, Gaussians, init_from_points, no_rows
from a2tg_jax.core.pixel_sizes import FILTER_VARIANCE, pixel_sizes
from a2tg_jax.data.scene import Scene
from a2tg_jax.data.start_points import Sight, unseeing
from a2tg_jax.events import FieldError
from a2tg_jax.model import Model
from a2tg_jax.training.batches import check_loss_data
from a2tg_jax.training.options import System
from a2tg_jax.training.sky import check_sky, sky_of
from a2tg_jax.training.stage import Stage

KEY_OF_PARAMETERS = 0x7E8E1
LEAST_OPACITY = INITIAL_OPACITY
"""Lower bound of the reduced opacities: the initial opacity of 3DGS."""
SMALLEST_SIDE = 1e-6
GREY, GREY_SLACK = 0.5, 0.01
"""Colour of points without one, and the difference up to which a colour counts as that grey."""


def initial_model(scene: Scene, system: System) -> Model:
    """Return Gaussians at the scene's points and of its sky, as many as the first stage has room for."""
    num, degree, opacity = initial_number(scene, system), system.initial_sh_degree, system.initial_opacity
    num_sky = system.sky_gaussians
    gaussians = init_from_points(
        scene.points, start_colors(scene), num - num_sky, system.seed, opacity=opacity, sh_degree=degree
    )
    if num_sky:
        gaussians = _followed_by(gaussians, sky_of(scene, num_sky, opacity=opacity, sh_degree=degree))
    adapted = fainter_where_dense if system.stages()[0].appearance.has_low_pass else wider_where_dense
    return Model(adapted(gaussians, [view.camera for view in scene.train]))


def start_colors(scene: Scene) -> np.ndarray:
    """Return the colours [P, 3] of a scene's points; grey, with a warning, if all points have one other colour.

    Point clouds without colours, from a scanner or a depth map, are often stored as black or white.
    """
    colors = np.asarray(scene.colors)
    if len(colors) < 2 or (colors != colors[0]).any() or (np.abs(colors[0] - GREY) < GREY_SLACK).all():
        return colors
    given = ", ".join(f"{number:g}" for number in colors[0].round(3).tolist())
    warnings.warn(
        f"all {len(colors):,} points of {scene.name} have one colour ({given}): taken as points without colours, "
        "which start grey",
        stacklevel=3,
    )
    return np.full_like(colors, GREY)


def wider_where_dense(gaussians: Gaussians, cameras: Sequence[Camera]) -> Gaussians:
    """Widen Gaussians to a standard deviation of a pixel at least, from the camera where they are largest (host).

    Without a low-pass filter smaller splats show only if they cover a pixel's centre, and then without neighbours that
    they overlap. Gaussians that no camera sees stay.
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

    Args:
      gaussians: initial Gaussians, with the opacity for splats larger than a pixel.
      cameras: training cameras.
    """
    sizes = _largest_sizes(gaussians, cameras)
    layers = np.maximum(FILTER_VARIANCE / np.maximum(sizes, SMALLEST_SIDE) ** 2, 1.0)
    opacities = np.asarray(gaussians.opacities, np.float64)
    shared = np.maximum(1 - (1 - opacities) ** (1 / layers), np.minimum(opacities, LEAST_OPACITY))
    logits = np.where(shared < opacities, np.log(shared / (1 - shared)), np.asarray(gaussians.logit_opacities))
    return dataclasses.replace(gaussians, logit_opacities=jnp.asarray(logits, gaussians.logit_opacities.dtype))


def _largest_sizes(gaussians: Gaussians, cameras: Sequence[Camera]) -> np.ndarray:
    """Return the smaller standard deviation of Gaussians in pixels [N], from the camera where it is largest."""
    means, scales = np.asarray(gaussians.means, np.float64), np.asarray(gaussians.scales, np.float64)
    largest = np.zeros(len(means))
    for camera in cameras:
        viewmat, K = np.asarray(camera.viewmat, np.float64), np.asarray(camera.K, np.float64)
        largest = np.maximum(largest, pixel_sizes(means, scales, viewmat, K))
    return largest


def check_start(scene: Scene, system: System, num_given: int | None = None) -> None:
    """Refuse points that no training view sees, a first stage whose events cannot work with the initial number of
    Gaussians, depth priors of a scene without depth maps, and Gaussians of a sky that no view sees.

    Args:
      scene: its photographs and points.
      system: with its options.
      num_given: Gaussians of a file in place of the first stage; None: it is trained.

    Raises:
      ValueError: naming the options to change.
    """
    num = initial_number(scene, system) if num_given is None else num_given
    if num_given is None:
        _check_seen(scene, system)
        with system.naming_options():
            _rows_needed(system.stages()[0], num, system)
    (system.check_number if num_given is None else system.check_given_number)(num)
    for stage in system.stages():
        check_loss_data(scene.train, stage.extras, stage.has_ssim)
    if system.sky_gaussians:
        check_sky(scene, system.sky_gaussians)


def _check_seen(scene: Scene, system: System) -> None:
    """Raise ValueError if no training view sees any of a scene's points, unless there are Gaussians of a sky."""
    points = np.asarray(scene.points)
    if not np.isfinite(points).all():
        return  # `init_from_points` names these.
    cameras = [view.camera for view in scene.train]
    sights = [Sight.of(np.asarray(c.viewmat), np.asarray(c.K), (c.height, c.width), c.rays) for c in cameras]
    if len(unseeing(points, sights)) == len(sights) and not system.sky_gaussians:
        raise ValueError(
            f"scene.points: no training view sees any of the {len(points):,} points: they must be in the "
            "world of the views' cameras; scene.transform.apply leads there from the original world"
        )


def _rows_needed(stage: Stage, num: int, system: System) -> int:
    """Return the rows that a stage allocates for `num` Gaussians.

    Raises:
      FieldError: naming the options to change, if an event cannot reach its number.
    """
    try:
        return num_rows(stage, num)
    except FieldError as error:
        raise FieldError(error.event, f"{error.message}: raise {system.more_growth()}, or lower {{cap}}") from error


def initial_number(scene: Scene, system: System) -> int:
    """Return the number of initial Gaussians: as requested, up to one for each point beside those of the sky, and up to
    the room of the first stage."""
    room = len(scene.points) + system.sky_gaussians
    num = min(system.initial_gaussians or room, room)
    caps = [most for event in system.stages()[0].events if (most := event.most_gaussians) is not None]
    return min(num, *caps) if caps else num


def num_rows(stage: Stage, num: int) -> int:
    """Return the number of rows that a stage allocates for `num` Gaussians and those that its events can add."""
    return max([num, *(event.num_rows(num, stage.iterations) for event in stage.events)])


def padded(model: Model, stage: Stage, system: System, num_devices: int = 1) -> Model:
    """Return the model with the appearance of a stage and with spare rows for its events.

    If the model's appearance is the stage's, its parameters are kept; otherwise they are allocated anew, but for the
    shapes of kernels. A stage without shapes takes the nearest Gaussians, with a warning. The number of devices divides
    that of the rows.

    Raises:
      ValueError: if Gaussians were to be added to a model whose textures have grown.
    """
    num = model.gaussians.num
    room = -(-_rows_needed(stage, num, system) // num_devices) * num_devices
    gaussians = _with_rows(_shown_by(stage, model), room)
    params, layout = model.params, model.layout
    if model.appearance != stage.appearance or room > num:
        params, layout = new_parameters(stage.appearance, gaussians, system)
        params = _with_known_shapes(stage.appearance, params, model)
    if model.appearance == stage.appearance and room > num:
        leaves = zip(jax.tree.leaves(params), jax.tree.leaves(model.params), strict=False)
        if _rows_of(params) != _rows_of(model.params) or any(len(new) < len(old) for new, old in leaves):
            raise ValueError(
                f"stage {stage.name!r} would add Gaussians to a model whose textures or degrees have grown already"
            )
        params = jax.tree.map(lambda new, old: new.at[:num].set(old[:num]), params, model.params)
    return Model(gaussians, params, layout, jnp.asarray(num, jnp.int32), appearance=stage.appearance)


def _shown_by(stage: Stage, model: Model) -> Gaussians:
    """Return the Gaussians of a model, the nearest ones to its kernels if the stage has no shapes of them."""
    shapes = model.appearance.shapes(model.params)
    if shapes is None or stage.appearance.shapes_name is not None:
        return model.gaussians
    warnings.warn(
        f"stage {stage.name!r} has no shapes of kernels: it takes the Gaussians nearest to those of the model",
        stacklevel=2,
    )
    return nearest_gaussians(model.gaussians, np.asarray(shapes))


def new_parameters(appearance: Appearance, gaussians: Gaussians, system: System) -> tuple[Any, Any]:
    """Return the parameters and layout that an appearance of a system's stage begins with."""
    return appearance.allocate(jax.random.fold_in(jax.random.key(system.seed), KEY_OF_PARAMETERS), gaussians)


def _with_known_shapes(appearance: Appearance, params: Any, model: Model) -> Any:
    """Return new parameters with the shapes of the model's kernels, if both have shapes."""
    new, old = appearance.shapes(params), model.appearance.shapes(model.params)
    return params if new is None or old is None else appearance.with_shapes(params, new.at[: len(old)].set(old))


def _rows_of(params: Any) -> Any:
    """Return the structure and shape of one row of the parameters."""
    return jax.tree.structure(params), [leaf.shape[1:] for leaf in jax.tree.leaves(params)]


def _with_rows(gaussians: Gaussians, room: int) -> Gaussians:
    """Return the Gaussians, followed by spare rows."""
    num = room - gaussians.num
    if num == 0:
        return gaussians
    return _followed_by(gaussians, no_rows(num, gaussians.sh.shape[1], gaussians.means.dtype))


def _followed_by(gaussians: Gaussians, others: Gaussians) -> Gaussians:
    joined: Gaussians = jax.tree.map(lambda a, b: jnp.concatenate([a, b]), gaussians, others)
    return joined
