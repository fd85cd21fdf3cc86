"""A lower limit of the exponents of kernels: long tails take long to draw."""

import dataclasses

import jax.numpy as jnp

from a2tg_jax.appearance.shaped import LARGEST_LOG_EXPONENT, MOST_SHARE
from a2tg_jax.core.optim import AdamState
from a2tg_jax.core.pytree import pytree
from a2tg_jax.events import Change, Now, StepEvent
from a2tg_jax.model import Model


@pytree
class LimitExponents(StepEvent):
    """Lower limit of the exponents of kernels (`Shaped`), after every iteration."""

    least: float = 0.6
    """Smallest exponent, 0 to 1. Smaller ones have longer tails; up to 1/e it limits nothing."""

    reads_whole = False
    num_keys = 0

    def apply(self, now: Now, model: Model, moments: AdamState, state: tuple[()]) -> Change:
        shapes = model.appearance.shapes(model.params)
        if shapes is None:
            raise ValueError("LimitExponents wants kernels with shapes, such as Shaped(Plain()) or Shaped(Textured())")
        share = jnp.log(jnp.asarray(self.least, shapes.dtype)) / LARGEST_LOG_EXPONENT
        least = jnp.arctanh(jnp.clip(share, -MOST_SHARE, MOST_SHARE))
        params = model.appearance.with_shapes(model.params, jnp.maximum(shapes, least))
        return Change(dataclasses.replace(model, params=params), moments, state)
