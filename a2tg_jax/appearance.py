"""Appearance rules: what a splat shows at (u, v). The compositor is given one and knows nothing else about it.

B splats of a block, P pixels of a tile; u and v are [B, P], in standard deviations of the splat. A rule holds its
parameters, turns splat indices into the rows that a block needs, and samples those rows. It must be a pytree whose
float leaves, `params`, are differentiable; what it knows besides (layouts, options) takes no part in differentiation.
"""

import dataclasses
from typing import Any, Protocol

import jax
import jax.numpy as jnp
from jax import Array


class AppearanceRule(Protocol):
    """What the compositor asks of a rule. `params` is any pytree of float arrays."""

    @property
    def params(self) -> Any:
        """The differentiable parameters."""
        ...

    def rows(self, params: Any, ids: Array) -> Any:
        """What `sample` needs of the splats `ids` [B]: a pytree with leading axis B; floats are differentiated."""
        ...

    def sample(self, rows: Any, u: Array, v: Array) -> tuple[tuple[Array, Array, Array] | None, Array | None]:
        """Colour residuals (three [B, P]) and alpha factors [B, P] at (u, v); None stands for 0 and for 1."""
        ...

    def falloff(self, rho: Array) -> Array:
        """The kernel at squared distance rho [B, P]; exp(−rho/2) for a Gaussian."""
        ...

    def add_rows(self, total: Any, ids: Array, rows: Any) -> Any:
        """The transpose of `rows`: `total` (like `params`) with the cotangents of rows of `ids` [G·B] added."""
        ...

    def cutoff(self, params: Any, opacities: Array) -> Array:
        """[N] squared distance rho beyond which the splat shows less than 1/255; not positive where it never does."""
        ...


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class PlainAppearance:
    """Plain 2DGS: the splat's own colour, weighted by its Gaussian."""

    @property
    def params(self) -> tuple[()]:
        return ()

    def rows(self, params, ids):
        return ()

    def sample(self, rows, u, v):
        return None, None

    def falloff(self, rho: Array) -> Array:
        return jnp.exp(-0.5 * rho)

    def add_rows(self, total, ids, rows):
        return total

    def cutoff(self, params, opacities: Array) -> Array:
        return gaussian_cutoff(opacities)


FEW = 16
"""Up to so many rows are read and written one after the other, which is in place in a loop; more are gathered."""


def gaussian_cutoff(peak: Array) -> Array:
    """r² = 2·ln(255·peak), where peak·exp(−r²/2) = 1/255; peaks that are not positive give a negative r²."""
    return 2 * jnp.log(jnp.maximum(255 * peak, 1e-6))


def add_at(total: Array, ids: Array, rows: Array) -> Array:
    """total [N, ...] with rows [R, ...] added at ids [R]; few rows one after the other, in place and in order."""
    if ids.shape[0] > FEW:
        return total.at[ids].add(rows)
    for position in range(ids.shape[0]):
        at = (ids[position],) + (jnp.zeros_like(ids[position]),) * (total.ndim - 1)
        old = jax.lax.dynamic_slice(total, at, (1, *total.shape[1:]))
        total = jax.lax.dynamic_update_slice(total, old + rows[position : position + 1], at)
    return total
