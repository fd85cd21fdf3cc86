"""A lower limit of the exponents of kernels: long tails take long to draw."""

import dataclasses

import jax.numpy as jnp

from a2tg_jax.appearance.exponents import LARGEST_LOG_EXPONENT, MOST_SHARE
from a2tg_jax.core.checks import check_number
from a2tg_jax.core.optim import AdamState
from a2tg_jax.core.pytree import pytree
from a2tg_jax.events import Change, Now, StepEvent
from a2tg_jax.model import Model


@pytree
class LimitExponents(StepEvent):
    """Lower limit of the exponents of kernels (`Appearance.exponents`), after every iteration."""

    least: float = 0.6
    """Smallest exponent of a kernel, 0 to 1. Smaller ones have longer tails, which take longer to draw; up to 1/e it
    limits nothing."""

    num_keys = 0

    def check_options(self) -> None:
        check_number("least", self.least, least=0, most=1)

    def apply(self, now: Now, model: Model, moments: AdamState, state: tuple[()]) -> Change:
        if (shapes := model.appearance.shapes) is None:
            raise ValueError("LimitExponents needs kernels with exponents, such as Appearance(exponents=Exponents())")
        share = jnp.log(jnp.asarray(self.least, shapes.dtype)) / LARGEST_LOG_EXPONENT
        least = jnp.arctanh(jnp.clip(share, -MOST_SHARE, MOST_SHARE))
        appearance = model.appearance.with_shapes(jnp.maximum(shapes, least))
        return Change(dataclasses.replace(model, appearance=appearance), moments, state)
