"""A lower limit of the exponents of kernels: long tails take long to draw."""

import dataclasses

import jax.numpy as jnp

from a2tg_jax.appearance.shaped import LARGEST_LOG_EXPONENT
from a2tg_jax.core.optim import AdamState
from a2tg_jax.events import Change, Now, StepEvent, event
from a2tg_jax.model import Model


@event
class LimitExponents(StepEvent):
    """Lower limit of the exponents of kernels (`Shaped`), after every iteration."""

    least: float = 0.6
    """Smallest exponent, above 1/e, that of all shapes, and at most 1. Smaller ones have longer tails."""

    reads_whole = False
    num_keys = 0

    def apply(self, now: Now, model: Model, moments: AdamState, state: tuple[()]) -> Change:
        shapes = model.appearance.shapes(model.params)
        if shapes is None:
            raise ValueError("LimitExponents wants kernels with shapes, such as Shaped(Plain()) or Shaped(Textured())")
        least = jnp.arctanh(jnp.log(jnp.asarray(self.least, shapes.dtype)) / LARGEST_LOG_EXPONENT)
        params = model.appearance.with_shapes(model.params, jnp.maximum(shapes, least))
        return Change(dataclasses.replace(model, params=params), moments, state)
