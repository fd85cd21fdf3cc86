"""Forward and backward passes of one view."""

import jax
import jax.numpy as jnp

import a2tg_jax
from a2tg_jax.render import appearance_of, render_traced
from benchmarks.arrays import random_image
from benchmarks.timing import timed
from benchmarks.workload import random_scene, random_textures


def measure_render(case: dict) -> dict:
    """The random workload."""
    gaussians, camera = random_scene(case["num"], case["width"], case["height"])
    textures, layout = random_textures(case["num"], case.get("textures", "none"))
    settings = a2tg_jax.RenderSettings(compositor=case.get("compositor", "auto"), tile_size=case.get("tile_size", 8))
    return measure_view(gaussians, camera, textures, layout, settings)


def measure_view(
    gaussians: a2tg_jax.Gaussians,
    camera: a2tg_jax.Camera,
    textures: a2tg_jax.Textures | None,
    layout: a2tg_jax.AtlasLayout | None,
    settings: a2tg_jax.RenderSettings,
) -> dict:
    """Forward, forward with backward of L1 against a fixed random image, and how many pairs were composited."""
    settings = a2tg_jax.plan_render(gaussians, camera, textures, layout, settings=settings)
    target = jnp.asarray(random_image(camera.width, camera.height))

    def image(gaussians, textures, tap=None):
        rule = appearance_of(gaussians, textures, layout, settings)
        return render_traced(gaussians, camera, rule, jnp.zeros(3), settings, has_geometry=False, tap=tap)[0].color

    def loss(gaussians, textures, tap=None):
        return jnp.mean(jnp.abs(image(gaussians, textures, tap) - target))

    both = jax.jit(jax.grad(loss, argnums=(0, 1)))
    figures = {
        "forward": timed(jax.jit(image), gaussians, textures, wait=jax.block_until_ready),
        "both": timed(both, gaussians, textures, wait=jax.block_until_ready),
    }
    counts = jax.jit(jax.grad(loss, argnums=2))(gaussians, textures, jnp.zeros((gaussians.num, 4)))
    return {**figures, "composited_pairs": float(counts[:, 3].sum())}
