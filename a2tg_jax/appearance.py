"""Appearance rules: what a splat shows at (u, v). The compositor is given one and knows nothing else about it.

A rule has a table of parameters [T, C], and a few integers per splat, its row. At (u, v), in standard deviations, it
says which entries of the table it reads (`lookup`), and what these make visible there (`shade`):

    residual, factor = rule.shade(row, rule.params[rule.lookup(row, u, v)], u, v)

`lookup`, `shade` and `falloff` are element-wise, on scalars or on arrays that broadcast. They may use nothing of the
rule but its static fields: everything else comes as an argument, and what is differentiated comes in `values`.
"""

import dataclasses
from typing import Protocol

import jax
import jax.numpy as jnp
from jax import Array

Values = tuple[tuple[Array, ...], ...]
"""For each index of a lookup the C numbers of that entry of the table."""


class AppearanceRule(Protocol):
    """What the compositor asks of a rule, a pytree that is hashable but for its arrays."""

    @property
    def params(self) -> Array:
        """[T, C] the differentiable parameters; T >= 1."""
        ...

    @property
    def rows(self) -> tuple[Array, ...]:
        """[N] int32 each: what the rule keeps of every splat."""
        ...

    def lookup(self, row: tuple[Array, ...], u: Array, v: Array) -> tuple[Array, ...]:
        """The entries of the table that are read at (u, v), int32; always equally many."""
        ...

    def shade(
        self, row: tuple[Array, ...], values: Values, u: Array, v: Array
    ) -> tuple[tuple[Array, Array, Array] | None, Array | None]:
        """Colour residuals and the alpha factor at (u, v); None stands for 0 and for 1."""
        ...

    def falloff(self, rho: Array) -> Array:
        """The kernel at squared distance rho; exp(−rho/2) for a Gaussian."""
        ...

    def cutoff(self, opacities: Array) -> Array:
        """[N] squared distance rho beyond which the splat shows less than 1/255; not positive where it never does."""
        ...

    @property
    def num_bytes(self) -> int:
        """Reported memory of the parameters, padding left out (host)."""
        ...


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class PlainAppearance:
    """Plain 2DGS: the splat's own colour, weighted by its Gaussian."""

    @property
    def params(self) -> Array:
        return jnp.zeros((1, 0), jnp.float32)

    @property
    def rows(self) -> tuple[Array, ...]:
        return ()

    def lookup(self, row, u, v):
        return ()

    def shade(self, row, values, u, v):
        return None, None

    def falloff(self, rho: Array) -> Array:
        return jnp.exp(-0.5 * rho)

    def cutoff(self, opacities: Array) -> Array:
        return gaussian_cutoff(opacities)

    @property
    def num_bytes(self) -> int:
        return 0


def gaussian_cutoff(peak: Array) -> Array:
    """r² = 2·ln(255·peak), where peak·exp(−r²/2) = 1/255; peaks that are not positive give a negative r²."""
    return 2 * jnp.log(jnp.maximum(255 * peak, 1e-6))
