"""When things happen in a stage of n iterations, counted from 1: the paper's n = 30,000, scaled."""

import jax.numpy as jnp
from jax import Array

from a2tg_jax.config import TextureConfig

PAPER_ITERATIONS = 30_000
EARLY_EVENTS = (0.15, 0.30)
"""Upscaling in short second stages, where n/60 and n/30 would leave the statistic no time to settle."""


def sh_degree_at(iteration: Array, num_iterations: int, highest: int) -> Array:
    """The degree of spherical harmonics in use at an iteration of stage 1: one more after every n/30."""
    interval = max(1, round(num_iterations / 30))
    return jnp.minimum((iteration - 1) // interval, highest)


def densify_span(num_iterations: int) -> tuple[int, int, int]:
    """First and last iteration of relocation and growth, and the interval between events."""
    return round(num_iterations / 60), 5 * num_iterations // 6, max(10, round(num_iterations / 300))


def is_densify_event(iteration: Array, num_iterations: int) -> Array:
    """Whether relocation and growth follow this iteration."""
    first, last, interval = densify_span(num_iterations)
    return (iteration >= first) & (iteration <= last) & (iteration % interval == 0)


def num_reachable(num: int, cap: int, num_iterations: int) -> int:
    """How many Gaussians growth can reach at most from `num`: nothing above it needs memory."""
    first, last, interval = densify_span(num_iterations)
    for iteration in range(interval, last + 1, interval):
        if num < cap and iteration >= first:
            num = min(cap, max(num + 1, num + num // 20))
    return num


def upscale_iterations(config: TextureConfig, num_iterations: int) -> tuple[int, ...]:
    """The iterations of stage 2 after which textures grow, ascending.

    Raises:
      ValueError: if `upscale_at` holds something else than ascending fractions of the stage.
    """
    if not config.is_enabled:
        return ()
    fractions = config.upscale_at
    if fractions is None:
        fractions = EARLY_EVENTS if num_iterations < PAPER_ITERATIONS else (1 / 60, 1 / 30)
    if any(not 0 < fraction < 1 for fraction in fractions) or list(fractions) != sorted(set(fractions)):
        raise ValueError(f"texture.upscale_at must be ascending fractions between 0 and 1; got {fractions}")
    return tuple(max(1, round(fraction * num_iterations)) for fraction in fractions)
