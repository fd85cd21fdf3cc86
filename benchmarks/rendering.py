"""Forward and backward passes of one view."""

import jax
import jax.numpy as jnp

import a2tg_jax
from a2tg_jax.rasterize.views import render_traced
from a2tg_jax.render import appearance_of
from benchmarks.arrays import random_image
from benchmarks.timing import timed
from benchmarks.workload import random_scene, random_textures


def measure_render(case: dict) -> dict:
    """Measure the image of the random workload, and the gradient of L1 against a fixed random image."""
    gaussians, camera = random_scene(case["num"], case["width"], case["height"])
    textures = random_textures(case["num"], case.get("textures", "none"))
    settings = a2tg_jax.RenderSettings(compositor=case.get("compositor", "auto"), tile_size=case.get("tile_size", 16))
    settings = a2tg_jax.plan_render(gaussians, camera, textures, settings=settings)
    target = jnp.asarray(random_image(camera.width, camera.height))

    def image(gaussians, textures):
        shown = appearance_of(gaussians, textures, settings)
        return render_traced(gaussians, camera, shown, jnp.zeros(3), settings, has_geometry=False)[0].color

    def loss(gaussians, textures):
        return jnp.mean(jnp.abs(image(gaussians, textures) - target))

    both = jax.grad(loss, argnums=(0, 1), allow_int=True)
    return {
        name: timed(jax.jit(function), gaussians, textures, wait=jax.block_until_ready)
        for name, function in (("forward", image), ("both", both))
    }
