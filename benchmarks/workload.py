"""The measured workload: random Gaussians as this library's arrays, and textures for them."""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import a2tg_jax
from a2tg_jax.model import Model
from a2tg_jax.training import find_system
from a2tg_jax.training.batches import Photographs
from a2tg_jax.training.start import initial_state
from a2tg_jax.training.step import StepInputs, StepSettings, train_step
from benchmarks.arrays import camera_matrices, random_splats

NUM_PHOTOGRAPHS = 8


def random_scene(num: int, width: int, height: int) -> tuple[a2tg_jax.Gaussians, a2tg_jax.Camera]:
    """Return the Gaussians and the camera of `benchmarks.arrays`."""
    splats = random_splats(num)
    viewmat, K = camera_matrices(width, height)
    as_float = lambda x: jnp.asarray(x, jnp.float32)  # noqa: E731
    gaussians = a2tg_jax.Gaussians(
        means=as_float(splats.means),
        quats=as_float(splats.quats),
        log_scales=as_float(np.log(splats.scales)),
        logit_opacities=as_float(np.log(splats.opacities / (1 - splats.opacities))),
        sh=as_float(splats.sh),
    )
    return gaussians, a2tg_jax.Camera(as_float(viewmat), as_float(K), width, height)


def random_textures(num: int, kind: str, seed: int = 1) -> a2tg_jax.Textures | None:
    """Return textures of one kind: none, 70% 1×1 and 30% up to 4×4 ("mixed"), or all of one size."""
    if kind == "none":
        return None
    rng = np.random.default_rng(seed)
    sizes = np.ones((num, 2), np.int64)
    if kind == "mixed":
        is_larger = rng.uniform(size=num) < 0.3
        sizes[is_larger] = rng.choice([1, 2, 4], size=(is_larger.sum(), 2))
    else:
        sizes[:] = int(kind.split("x")[0])
    textures = a2tg_jax.allocate_textures(sizes)
    noise = lambda x: x + jnp.asarray(rng.normal(size=x.shape) * [0.2, 0.2, 0.2, 0], jnp.float32)  # noqa: E731
    return dataclasses.replace(textures, buckets=tuple(map(noise, textures.buckets)))


class TrainingStep(NamedTuple):
    """A training step between two events, of a preset "paper"."""

    run: Callable
    """(state, inputs with the data of a key) to the next state and figures; the state may be donated."""
    given: tuple[Any, ...]
    """Its arguments."""


def training_step(
    system: str,
    index: int,
    num: int,
    size: tuple[int, int],
    textures: a2tg_jax.Textures | None,
    **settings: Any,
) -> TrainingStep:
    """Return the step of a system's stage on the random scene and photographs of noise; further arguments are fields
    of `RenderSettings`."""
    width, height = size
    gaussians, camera = random_scene(num, width, height)
    stage = find_system(system).preset("paper").stages()[index]
    appearance = stage.appearance if stage.appearance.texture is None else stage.appearance.with_textures(textures)
    render = a2tg_jax.plan_render(gaussians, camera, textures, settings=a2tg_jax.RenderSettings(**settings))
    model = Model(gaussians, appearance, num_live=jnp.asarray(num, jnp.int32))
    clock = stage.clock(1)
    step = StepSettings(render, "black", tuple(left is None for left in clock.num_left))
    stack = lambda matrix: np.repeat(np.asarray(matrix, np.float32)[None], NUM_PHOTOGRAPHS, axis=0)  # noqa: E731
    noise = np.random.default_rng(1).integers(0, 256, (NUM_PHOTOGRAPHS, height, width, 3), dtype=np.uint8)
    photographs = Photographs(stack(camera.viewmat), stack(camera.K), noise, None)
    key = jax.random.key_data(jax.random.key(0))
    chosen = np.zeros(1, np.int32)
    inputs = StepInputs(stage, clock, photographs, chosen, views=None, scene_scale=np.float32(1), key=key)
    given = initial_state(stage, model), inputs

    def run(state, inputs):
        return train_step(step, state, inputs._replace(key=jax.random.wrap_key_data(inputs.key)))

    return TrainingStep(run, given)
