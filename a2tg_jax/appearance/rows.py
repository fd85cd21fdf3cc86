"""Rows of an appearance for densification: they change places, share their opacity, or fade."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

from a2tg_jax.appearance.copies import share
from a2tg_jax.core.gaussians import Gaussians, logit
from a2tg_jax.core.spread_arrays import rows_moved


class MovableRows:
    """Rows that densification moves. The defaults suit parameters with one row per Gaussian."""

    @property
    def has_own_opacities(self) -> bool:
        """Whether splats are exactly as opaque as their Gaussians."""
        return type(self).opacities is MovableRows.opacities

    def gather(self, params: Any, layout: Any, rows: Array) -> Any:
        """Return parameters, or moments of them, whose row i is the former row rows[i] of N; traceable."""
        return jax.tree.map(lambda x: rows_moved(x, rows), params)

    def clear(self, params: Any, layout: Any, is_cleared: Array) -> Any:
        """Return moments with the marked rows [N] at zero; traceable."""
        zeroed = lambda x: jnp.where(is_cleared.reshape(-1, *[1] * (x.ndim - 1)), jnp.zeros_like(x), x)  # noqa: E731
        return jax.tree.map(zeroed, params)

    def share(self, gaussians: Gaussians, params: Any, layout: Any, num_shares: Array) -> tuple[Gaussians, Any]:
        """Return each row as one of num_shares [N] coincident copies that together look like it; traceable."""
        opacities, scales = share(gaussians.logit_opacities, gaussians.log_scales, num_shares)
        return dataclasses.replace(gaussians, logit_opacities=opacities, log_scales=scales), params

    def opacities(self, gaussians: Gaussians, params: Any, layout: Any) -> Array:
        """Return the opacities [N] that densification compares with its thresholds; traceable."""
        return gaussians.opacities

    def limit_opacities(self, gaussians: Gaussians, params: Any, layout: Any, most: Array) -> tuple[Gaussians, Any]:
        """Return Gaussians and parameters of splats no more opaque than `most`; traceable."""
        limited = jnp.minimum(gaussians.logit_opacities, logit(jnp.asarray(most, gaussians.means.dtype)))
        return dataclasses.replace(gaussians, logit_opacities=limited), params
