"""Time of each stage of a training step, on the random workload."""

import functools

import jax
import jax.numpy as jnp

import a2tg_jax
from a2tg_jax.core.optim import adam_init, adam_update
from a2tg_jax.rasterize.compositor import composite, list_tiles
from a2tg_jax.rasterize.splats import project_gaussians, settings_of_pass
from a2tg_jax.rasterize.tiles import TileGrid
from a2tg_jax.render import appearance_of
from benchmarks import timing
from benchmarks.workload import random_scene, random_textures, training_step

timed = functools.partial(timing.timed, wait=jax.block_until_ready)


def measure_stages(case: dict) -> dict:
    """Measure each stage apart."""
    num = case["num"]
    width = case["width"]
    height = case["height"]
    gaussians, camera = random_scene(num, width, height)
    textures = random_textures(num, case.get("textures", "none"))
    settings = a2tg_jax.RenderSettings(tile_size=case.get("tile_size", 16))
    settings = a2tg_jax.plan_render(gaussians, camera, textures, settings=settings)
    capacity = settings.capacity or 0
    appearance = appearance_of(gaussians, textures, settings)
    grid = TileGrid(width, height, settings.tile_size)
    project = jax.jit(lambda gaussians: project_gaussians(gaussians, camera, appearance, settings.near_plane, 3))
    splats, cutoff = project(gaussians)
    compositing, texels, regions = settings_of_pass(
        appearance, splats, grid, settings.near_plane, has_geometry=False, compositor="auto", tile_batch=None
    )
    find_lists = jax.jit(lambda M, cutoff: list_tiles("auto", M, cutoff, settings.near_plane, grid, capacity))
    lists = find_lists(splats.M, cutoff)
    jacobian = camera.K @ camera.viewmat[:3, :3]
    probe = jnp.zeros((num, 4))

    def colors(splats, texels):
        return composite(compositing, splats, texels, regions, cutoff, lists, jacobian, probe)[0]

    def all_of_it(splats, texels):
        _, pull_back = jax.vjp(colors, splats, texels)
        return pull_back(jnp.ones((3, height, width)))

    def project_gradient(gaussians):
        splats, pull_back = jax.vjp(lambda gaussians: project(gaussians)[0], gaussians)
        return pull_back(splats)

    image, target = (jax.random.uniform(jax.random.key(k), (height, width, 3)) for k in (0, 1))
    moments = adam_init(gaussians)
    adam = jax.jit(lambda gaussians, moments: adam_update(gaussians, gaussians, moments, 1e-3))
    return {
        "projection": timed(project, gaussians),
        "projection, forward and backward": timed(jax.jit(project_gradient), gaussians),
        "tile lists": timed(find_lists, splats.M, cutoff),
        "compositing": timed(jax.jit(colors), splats, texels),
        "compositing, forward and backward": timed(jax.jit(all_of_it), splats, texels),
        "loss, value and gradient": timed(jax.jit(jax.value_and_grad(a2tg_jax.photometric_loss)), image, target),
        "Adam": timed(adam, gaussians, moments),
        "evaluated_pairs": float(lists.starts[-1]) * settings.tile_size**2,
    }


def measure_step(case: dict) -> dict:
    """Measure a whole training step, between two events."""
    kind = case.get("textures", "none")
    tile_size = case.get("tile_size", 16)
    system, index = ("gaussians-2d-mcmc", 0) if kind == "none" else ("a2tg", 1)
    textures = random_textures(case["num"], kind)
    size = case["width"], case["height"]
    made = training_step(system, index, case["num"], size, textures, tile_size=tile_size)
    state, inputs = jax.device_put(made.given)
    run = jax.jit(made.run, donate_argnums=0)
    latest = [state]

    def step():
        latest[0], info = run(latest[0], inputs)
        return info

    return {"step": timed(step)}
