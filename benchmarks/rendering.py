"""Forward and backward passes of one view."""

import functools
import time
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import a2tg_jax
from a2tg_jax.rasterize.views import render_traced
from a2tg_jax.render import appearance_of
from benchmarks.arrays import random_image
from benchmarks.timing import timed
from benchmarks.workload import random_scene, random_textures


def measure_render(case: dict) -> dict:
    """Measure the random workload."""
    gaussians, camera = random_scene(case["num"], case["width"], case["height"])
    textures = random_textures(case["num"], case.get("textures", "none"))
    settings = a2tg_jax.RenderSettings(compositor=case.get("compositor", "auto"), tile_size=case.get("tile_size", 8))
    return measure_view(gaussians, camera, textures, settings)


def measure_ratios(case: dict) -> dict:
    """Measure textured and untextured passes in turn in one process, which a noisy machine distorts least."""
    gaussians, camera = random_scene(case["num"], case["width"], case["height"])
    calls, kinds = {}, ("none", "mixed", "4x4")
    for kind in kinds:
        textures = random_textures(case["num"], kind)
        made = passes(gaussians, camera, textures, a2tg_jax.RenderSettings())
        for which in ("forward", "both"):
            calls[kind, which] = functools.partial(getattr(made, which), gaussians, textures)
    for call in calls.values():
        jax.block_until_ready(call())
    times: dict[tuple[str, str], list[float]] = {key: [] for key in calls}
    for _ in range(case["rounds"]):
        for key, call in calls.items():
            start = time.perf_counter()
            jax.block_until_ready(call())
            times[key].append(time.perf_counter() - start)
    medians = {key: {"ms": float(np.median(of_call)) * 1e3} for key, of_call in times.items()}
    return {"renders": [{"textures": k, **{which: medians[k, which] for which in ("forward", "both")}} for k in kinds]}


def measure_view(
    gaussians: a2tg_jax.Gaussians,
    camera: a2tg_jax.Camera,
    textures: a2tg_jax.Textures | None,
    settings: a2tg_jax.RenderSettings,
) -> dict:
    """Measure forward, and forward with backward."""
    made = passes(gaussians, camera, textures, settings)
    return {
        "forward": timed(made.forward, gaussians, textures, wait=jax.block_until_ready),
        "both": timed(made.both, gaussians, textures, wait=jax.block_until_ready),
    }


class Passes(NamedTuple):
    """Jitted functions of Gaussians and textures."""

    forward: Callable
    """Image."""
    both: Callable
    """Gradient of L1 against a fixed random image."""


def passes(gaussians, camera, textures, settings: a2tg_jax.RenderSettings) -> Passes:
    """Return the measured functions of a view."""
    settings = a2tg_jax.plan_render(gaussians, camera, textures, settings=settings)
    target = jnp.asarray(random_image(camera.width, camera.height))

    def image(gaussians, textures):
        shown = appearance_of(gaussians, textures, settings)
        return render_traced(gaussians, camera, shown, jnp.zeros(3), settings, has_geometry=False)[0].color

    def loss(gaussians, textures):
        return jnp.mean(jnp.abs(image(gaussians, textures) - target))

    return Passes(jax.jit(image), jax.jit(jax.grad(loss, argnums=(0, 1), allow_int=True)))
