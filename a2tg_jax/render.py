"""Images of textured 2D Gaussians: `render_image` for Gaussians and textures, `render_appearance` for any appearance.

N splats, H×W pixels. An eager call plans its own capacity. Under jit or vmap, the capacity comes from the settings,
which `plan_render` fills in.
"""

import collections
import dataclasses
import functools
import threading
from collections.abc import Callable, Hashable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import ArrayLike

from a2tg_jax.appearance import Appearance, Texture, check_is_appearance
from a2tg_jax.appearance.base import num_colors_of
from a2tg_jax.base.checks import (
    check_count,
    check_floats,
    check_kind,
    check_shape,
    check_unmasked,
    dtype_of,
    plain_array,
)
from a2tg_jax.base.user_warnings import warn
from a2tg_jax.core.cameras import Camera, check_camera
from a2tg_jax.core.gaussians import Gaussians, check_gaussians
from a2tg_jax.rasterize.render_types import RenderOutput, RenderSettings
from a2tg_jax.rasterize.room import has_rows, warn_of_empty, with_capacity
from a2tg_jax.rasterize.views import render_traced
from a2tg_jax.texture import Textures, check_textures


class CapacityWarning(UserWarning):
    """An eager render had too small a capacity: its image is only the background."""


def render_image(
    gaussians: Gaussians,
    camera: Camera,
    textures: Textures | None = None,
    *,
    features: ArrayLike | None = None,
    background: ArrayLike | None = None,
    settings: RenderSettings = RenderSettings(),  # noqa: B008 - frozen
) -> RenderOutput:
    """Render a view: equations (3) to (6) of A²TG. Differentiable in every float, camera and background included.

    Args:
      gaussians: N Gaussians.
      camera: the view.
      textures: textures of the Gaussians; without them, the splats are plain 2DGS.
      features: [N, D] numbers of each Gaussian to show instead of its colour, D >= 1, of either sign. They are
        weighted like the colour and not clipped: `color` is [H, W, D]. Of textures only alpha acts on them.
      background: [3] colour, or [D] features, behind everything; None is 0.
      settings: static options. An eager call, also under `jax.grad`, needs no capacity and never overflows.

    Returns:
      The images of the view. If a visible splat has a mean, rotation, scale, opacity or colour that is not finite, the
      whole image and all gradients are NaN. A NaN texel is NaN in the image where it is visible.

    Raises:
      ValueError: under jit or vmap without a capacity, if there are textures of another number of Gaussians, or if an
        argument has a wrong shape.

    Examples:
      >>> output = a2tg.render_image(gaussians, camera)
      >>> output.color.shape, output.depth.shape
      ((36, 48, 3), (36, 48))
      >>> darkness = lambda gaussians: -jnp.mean(a2tg.render_image(gaussians, camera).color)
      >>> jax.grad(darkness)(gaussians).means.shape
      (200, 3)
    """
    check_gaussians(gaussians)
    appearance = with_features(appearance_of(gaussians, textures, settings), features, gaussians)
    return render_appearance(gaussians, camera, appearance, background=background, settings=settings)


def render_appearance(
    gaussians: Gaussians,
    camera: Camera,
    appearance: Appearance,
    *,
    background: ArrayLike | None = None,
    settings: RenderSettings = RenderSettings(),  # noqa: B008 - frozen
    num_live: Array | int | None = None,
) -> RenderOutput:
    """Render a view as `render_image` does, with any appearance; of the first `num_live` rows, if given.

    Args:
      gaussians: N Gaussians.
      camera: the view.
      appearance: their appearance, with a row for each of them.
      background: [3] colour, or one number for each of the appearance's colours, behind everything; None is 0.
      settings: static options, as in `render_image`; `texture` is ignored, since the appearance has its own options.
      num_live: number of rows that exist, 0 to N, a Python or array integer; None: all. It may be traced.

    Returns:
      The images of the view, as `render_image` returns them.

    Raises:
      ValueError: under jit or vmap without a capacity, or if an argument has a wrong shape or kind.

    Examples:
      >>> textures = a2tg.allocate_textures(np.full((gaussians.num, 2), 4))
      >>> appearance = a2tg.Appearance(texture=a2tg.Texture(textures))
      >>> a2tg.render_appearance(gaussians, camera, appearance).color.shape
      (36, 48, 3)
    """
    check_gaussians(gaussians)
    check_camera(camera)
    check_is_appearance(appearance, gaussians)
    num_colors = num_colors_of(appearance)
    background = (0,) * num_colors if background is None else background
    background = background_array(background, gaussians, num_colors)
    if num_live is not None:
        check_count("num_live", num_live, gaussians.num)
    planned = with_capacity(settings, gaussians, camera, appearance, num_live)
    output, num_pairs = jitted_render()(gaussians, camera, appearance, background, planned, num_live=num_live)
    # A capacity planned here suffices; one from the caller may not. Under jit and vmap there is nothing to read.
    if settings.capacity is not None and not isinstance(num_pairs, jax.core.Tracer):
        kind = settings, camera.width, camera.height, gaussians.num
        _watch(_Watched(output.overflow, num_pairs, settings.capacity, has_rows(gaussians, num_live)), kind)
    return output


@functools.cache
def jitted_render() -> Callable[..., tuple[RenderOutput, Array]]:
    """Return `render_traced` under jit."""
    # Made at the first call: importing this library calls no `jax.jit`.
    return jax.jit(render_traced, static_argnums=(4,), static_argnames=("has_geometry",))


class _Watched(NamedTuple):
    """A render that may not be done yet: whether it has overflowed, and whether it is empty."""

    overflow: Any
    num_pairs: Any
    capacity: int
    has_rows: bool


def _watch(rendered: _Watched, kind: Hashable) -> None:
    """Warn if this eager render, or one before it that is done by now, has overflowed or is empty.

    It waits for the first render of a kind (settings, image size and number of Gaussians). Later ones are read once
    they are done, so that rendering stays asynchronous.
    """
    with _watch_lock:
        _pending.append(rendered)
    if kind not in _watched_kinds:
        _watched_kinds.add(kind)
        rendered.num_pairs.block_until_ready()
    while True:
        with _watch_lock:
            if not _pending or not (_pending[0].num_pairs.is_deleted() or _pending[0].num_pairs.is_ready()):
                return
            done = _pending.popleft()
        # Deleted arrays have no values.
        if done.num_pairs.is_deleted() or done.overflow.is_deleted():
            continue
        # Explicit transfers, which `jax.transfer_guard` lets pass.
        if jax.device_get(done.overflow):
            warn(
                f"settings.capacity of {done.capacity:,} was too small for a render: its image is only the background. "
                "Plan it with settings = plan_render(model, cameras), or leave capacity=None outside jit",
                CapacityWarning,
            )
        if done.has_rows and jax.device_get(done.num_pairs) == 0:
            warn_of_empty("the camera of a render")


_watch_lock = threading.Lock()  # threads may render at the same time
_watched_kinds: set[Hashable] = set()
_pending: collections.deque[_Watched] = collections.deque(maxlen=64)
"""Renders that may not be done yet; the oldest are forgotten."""


def with_features(appearance: Appearance, features: ArrayLike | None, gaussians: Gaussians) -> Appearance:
    """Return the appearance that shows features [N, D] instead of colours; the same one if features is None.
    ValueError: they are not floats of the Gaussians' dtype, D >= 1."""
    if features is None:
        return appearance
    features = plain_array("features", features, gaussians.means.dtype)
    check_floats("features", features, (gaussians.num, "D"))
    if dtype_of(features) != gaussians.means.dtype or not np.shape(features)[1]:
        got = f"{dtype_of(features)}{[*np.shape(features)]}"
        raise ValueError(f"features must be {gaussians.means.dtype} as the means are, D >= 1; got {got}")
    return dataclasses.replace(appearance, features=jnp.asarray(features))


def background_array(background: ArrayLike, gaussians: Gaussians, num_colors: int = 3) -> Array:
    """Return the background as an array of the dtype in which Gaussians are drawn. ValueError: it is not one colour, of
    `num_colors` numbers."""
    check_unmasked("background", background)
    # A list may hold tracers, which NumPy does not take.
    if any(isinstance(leaf, Array) for leaf in jax.tree.leaves(background)):
        background = jnp.asarray(background)
    if np.ndim(background) == 3:
        raise ValueError(
            f"background must be one colour [3]; got {[*np.shape(background)]}. To put an image behind the splats, "
            "render on black and add (1 - output.alpha[..., None]) * image"
        )
    if isinstance(background, str):
        raise ValueError(f"background must be [{num_colors}] floats, such as (1, 1, 1) for white; got {background!r}")
    check_shape("background", background, (num_colors,))
    # Without x64, JAX draws Gaussians of NumPy in float32 even if they are float64.
    dtype = jnp.result_type(gaussians.means)
    if isinstance(background, Array):
        return background.astype(dtype)
    # An explicit transfer, which `jax.transfer_guard` lets pass.
    return jax.device_put(np.asarray(background, dtype))


def appearance_of(gaussians: Gaussians, textures: Textures | None, settings: RenderSettings) -> Appearance:
    """Return the appearance of Gaussians and their textures, whose options are `settings.texture`. ValueError: the
    textures do not fit the Gaussians, or there are no settings."""
    check_kind("settings", settings, RenderSettings)
    if textures is None:
        return Appearance(max_alpha=settings.texture.max_alpha)
    check_textures(textures, gaussians.num)
    return Appearance(texture=Texture(textures, options=settings.texture))
