"""Depth maps of rendered views, for fusion: where a ray meets one surface, and how far away.

A render has the sums Σ w·z and Σ w·z² of its splats, so that a depth is a mean with a spread. At an edge, or in a cloud
of splats, the spread is large, and the mean lies between surfaces.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

from a2tg_jax.core.cameras import Camera
from a2tg_jax.core.numerics import normalize
from a2tg_jax.rasterize.render_types import RenderOutput
from a2tg_jax.training.losses import back_project

LEAST_FACING = 0.1
"""Smallest cosine between a ray and a normal; smaller ones count as this."""
LEAST_ALPHA = 0.5
"""Smallest alpha of a pixel that has a depth."""


class RenderedDepth(NamedTuple):
    """Depths and colours of one view."""

    camera: Camera
    """The view."""
    depth: Array
    """[H, W] along the camera's z axis, at pixel centres; 0 where there is none."""
    spread: Array
    """[H, W] standard deviation of the splats' depths, weighted as the depth is."""
    slant: Array
    """[H, W] in (0, 1]: distance from the surface's plane for a unit of distance along the z axis, on the ray."""
    facing: Array
    """[H, W] cosine between the ray and the surface's normal."""
    color: Array
    """[H, W, 3] in [0, 1]."""


def rendered_depth(output: RenderOutput, camera: Camera) -> RenderedDepth:
    """Return the depths of a render.

    Args:
      output: a render.
      camera: its view.
    """
    is_opaque = (output.alpha > LEAST_ALPHA) & jnp.isfinite(output.depth)
    alpha = jnp.where(is_opaque, output.alpha, 1.0)
    depth = jnp.where(is_opaque, output.depth, 0.0) / alpha
    spread = jnp.sqrt(jnp.maximum(output.distortion, 0.0)) / alpha
    slant, facing = _seen_at(normalize(output.normal), camera)
    color = jnp.clip(jnp.nan_to_num(output.color), 0.0, 1.0)
    return RenderedDepth(camera, jnp.where(is_opaque & (depth > 0), depth, 0.0), spread, slant, facing, color)


def _seen_at(normal: Array, camera: Camera) -> tuple[Array, Array]:
    """Return slant and facing [H, W] of surfaces with unit normals [H, W, 3]."""
    rays = back_project(jnp.ones_like(normal[..., 0]), camera) - camera.center[None, None]
    slant = jnp.abs(jnp.sum(normal * rays, axis=-1))
    return jnp.clip(slant, LEAST_FACING, 1.0), jnp.maximum(slant / jnp.linalg.norm(rays, axis=-1), LEAST_FACING)
