"""Images of textured 2D Gaussians: `render_image` for Gaussians and textures, `render_appearance` for any rule.

N splats, H×W pixels. An eager call plans its own capacity. Under jit or vmap, the capacity comes from the settings,
which `plan_render` fills in.
"""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from a2tg_jax.appearance import Appearance, AppearanceRule, Features, PlainRule, appearance_for, check_rule
from a2tg_jax.core.cameras import Camera, check_camera
from a2tg_jax.core.checks import check_floats, check_kind, check_shape, check_unmasked, dtype_of, plain
from a2tg_jax.core.gaussians import Gaussians, check_gaussians
from a2tg_jax.core.overflow import OverflowWatch
from a2tg_jax.rasterize.capacity import with_capacity
from a2tg_jax.rasterize.render_types import RenderOutput, RenderSettings
from a2tg_jax.rasterize.views import render_traced
from a2tg_jax.texture import AtlasLayout, Textures, check_textures


def render_image(
    gaussians: Gaussians,
    camera: Camera,
    textures: Textures | None = None,
    layout: AtlasLayout | None = None,
    *,
    features: Any = None,
    background: Any = None,
    settings: RenderSettings = RenderSettings(),  # noqa: B008 - frozen
) -> RenderOutput:
    """Render a view: equations (3) to (6) of A²TG. Differentiable in every float, camera and background included.

    Args:
      gaussians: N Gaussians.
      camera: the view.
      textures, layout: textures of the Gaussians; without both, the splats are plain 2DGS.
      features: [N, D] numbers of each Gaussian to show in place of its colour, D >= 1, of either sign. They are
        weighted as the colour is and not clipped: `color` is [H, W, D]. Of textures they see alpha only.
      background: [3] colour, or [D] features, behind everything; None is 0.
      settings: static options. An eager call, also under `jax.grad`, needs no capacity and never overflows.

    Returns:
      The images of the view. If a visible splat has a mean, rotation, scale, opacity or colour that is not finite, the
      whole image and all gradients are NaN. A NaN texel is NaN in the image where it is visible.

    Raises:
      ValueError: under jit or vmap without a capacity, if only one of textures and layout is given, if the layout
        has another number of Gaussians, or if an argument has a wrong shape.
    """
    check_gaussians(gaussians)
    rule = with_features(rule_of(gaussians, textures, layout, settings), features, gaussians)
    return render_appearance(gaussians, camera, rule, background=background, settings=settings)


def render_appearance(
    gaussians: Gaussians,
    camera: Camera,
    rule: AppearanceRule,
    *,
    background: Any = None,
    settings: RenderSettings = RenderSettings(),  # noqa: B008 - frozen
    num_live: Array | int | None = None,
) -> RenderOutput:
    """Render a view as `render_image` does, with an appearance rule; of the first `num_live` rows, if given."""
    check_gaussians(gaussians)
    check_camera(camera)
    check_rule(rule)
    background = (0,) * rule.num_colors if background is None else background
    check_background(background, rule.num_colors)
    if num_live is not None:
        check_live(num_live, gaussians.num)
    planned = with_capacity(settings, gaussians, camera, rule, num_live)
    background = jnp.asarray(background, gaussians.means.dtype)
    output, _ = _jitted_render()(gaussians, camera, rule, background, planned, num_live=num_live)
    if settings.capacity is not None:
        kind = settings, camera.width, camera.height, gaussians.num
        _overflow_watch().observe(output.overflow, settings.capacity, kind)
    return output


@functools.cache
def _jitted_render() -> jax.stages.Wrapped:
    return jax.jit(render_traced, static_argnums=(4,))


@functools.cache
def _overflow_watch() -> OverflowWatch:
    return OverflowWatch()


def with_features(rule: AppearanceRule, features: Any, gaussians: Gaussians) -> AppearanceRule:
    """Return the rule that shows features [N, D] in place of colours; the same rule if features is None.

    Raises:
      ValueError: if the features are not floats [N, D] of the Gaussians' dtype, D >= 1.
    """
    if features is None:
        return rule
    features = plain("features", features, gaussians.means.dtype)
    check_floats("features", features, (gaussians.num, "D"))
    if dtype_of(features) != gaussians.means.dtype or not np.shape(features)[1]:
        found = f"{dtype_of(features)}{[*np.shape(features)]}"
        raise ValueError(f"features must be {gaussians.means.dtype} as the means are, D >= 1; got {found}")
    return Features(rule, jnp.asarray(features))


def check_live(num_live: Any, num: int) -> None:
    """Raise ValueError unless a number of live rows is an integer, up to `num` where it has a value."""
    check_shape("num_live", num_live, ())
    is_known = not isinstance(num_live, jax.core.Tracer)
    if not jnp.issubdtype(dtype_of(num_live), jnp.integer) or (is_known and not 0 <= int(num_live) <= num):
        raise ValueError(f"num_live must be an integer, 0 to {num}; got {num_live}")


def check_background(background: Any, num_colors: int = 3) -> None:
    """Raise ValueError unless the background is one colour, of `num_colors` numbers."""
    check_unmasked("background", background)
    if np.ndim(background) == 3:
        raise ValueError(
            f"background must be one colour [3]; got {[*np.shape(background)]}. To put an image behind the splats, "
            "render on black and add (1 - output.alpha[..., None]) * image"
        )
    if isinstance(background, str):
        raise ValueError(f"background must be [{num_colors}] floats, such as (1, 1, 1) for white; got {background!r}")
    check_shape("background", background, (num_colors,))


def appearance_of(
    gaussians: Gaussians, textures: Textures | None, layout: AtlasLayout | None, settings: RenderSettings
) -> Appearance:
    """Return the appearance of Gaussians and textures given apart, which `settings.texture` decides.

    Raises:
      ValueError: if only one of textures and layout is given, they do not fit the Gaussians, or there are no settings.
    """
    check_kind("settings", settings, RenderSettings)
    if (textures is None) != (layout is None):
        raise ValueError("textures and layout belong together: give both or neither")
    if textures is not None and layout is not None:
        check_textures(textures, layout, gaussians.num)
    return appearance_for(settings.texture, has_textures=textures is not None)


def rule_of(
    gaussians: Gaussians, textures: Textures | None, layout: AtlasLayout | None, settings: RenderSettings
) -> AppearanceRule:
    """Return the rule of `appearance_of`; without Gaussians, that of plain 2DGS. Raises as it does."""
    appearance = appearance_of(gaussians, textures, layout, settings)
    return appearance.rule(textures, layout) if gaussians.num else PlainRule(max_alpha=settings.texture.max_alpha)
