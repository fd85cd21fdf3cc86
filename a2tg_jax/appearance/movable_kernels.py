"""The appearance of SuperGaussians: four kernels that move over the splat, each with a colour and an opacity.

Kernel i has a centre (x_i, y_i) in standard deviations, a sharpness k_i, an opacity o_i and a colour c_i; 28 numbers
per splat. With the weights w_i = exp(−k_i·|(u, v) − (x_i, y_i)|²) + 10⁻⁴ the splat shows

    α = mean_i(o_i·w_i)·exp(−ρ/2),   colour = SH colour + mean_i(c_i·w_i)

The Gaussian's own opacity takes no part. (u, v) are always those of the hit; the authors' program takes offsets in
pixels instead where the low-pass filter decides.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from a2tg_jax.appearance.base import Appearance
from a2tg_jax.appearance.copies import LARGEST_OPACITY, share
from a2tg_jax.appearance.rule import Factor, PlainRule, Residual, gaussian_cutoff
from a2tg_jax.core.cameras import Camera
from a2tg_jax.core.gaussians import Gaussians, logit
from a2tg_jax.core.pytree import pytree

NUM_KERNELS = 4
LEAST_WEIGHT = 1e-4
INITIAL_CENTERS = ((-1.0, -1.0), (1.0, -1.0), (-1.0, 1.0), (1.0, 1.0))
INITIAL_SHARPNESS = 0.1
LARGEST_INITIAL_OPACITY = 0.999
FLOATS_PER_KERNEL = 7
PUBLISHED_FLOATS = 16
"""Floats of a splat's kernels by the authors' memory figures, which imply 74 floats per splat."""


@pytree
class MovableKernelParams:
    """Kernels of N splats."""

    centers: Array
    """[N, 4, 2] centres in standard deviations."""
    sharpness: Array
    """[N, 4] sharpness, not negative; a negative one acts as 0."""
    logit_opacities: Array
    """[N, 4] logits of the opacities."""
    colors: Array
    """[N, 4, 3] colours of either sign."""

    @property
    def opacities(self) -> Array:
        """[N, 4] opacities in (0, 1)."""
        return jax.nn.sigmoid(self.logit_opacities)


@pytree(kw_only=True)
class MovableKernelsRule(PlainRule):
    """Appearance rule: colour residual and opacity from four kernels."""

    kernels: MovableKernelParams

    def numbers(self, gaussians: Gaussians, camera: Camera) -> Array:
        """Return [N, 28]: x, y, k, o and the colour of each kernel."""
        kernels = self.kernels
        sharpness = jnp.where(kernels.sharpness >= 0, kernels.sharpness, 0.0)
        columns = [kernels.centers, sharpness[..., None], kernels.opacities[..., None], kernels.colors]
        return jnp.concatenate(columns, axis=2).reshape(gaussians.num, -1)

    def opacities(self, gaussians: Gaussians) -> Array:
        return jnp.ones(gaussians.num, gaussians.means.dtype)

    def shade(
        self, numbers: tuple[Array, ...], values: tuple[Array, ...], u: Array, v: Array
    ) -> tuple[Residual, Factor]:
        totals = [jnp.zeros_like(u)] * 4
        for first in range(0, len(numbers), FLOATS_PER_KERNEL):
            x, y, sharpness, *shown = numbers[first : first + FLOATS_PER_KERNEL]
            weight = jnp.exp(-sharpness * ((u - x) * (u - x) + (v - y) * (v - y))) + LEAST_WEIGHT
            totals = [total + weight * number for total, number in zip(totals, shown, strict=True)]
        opacity, red, green, blue = (total * (1 / NUM_KERNELS) for total in totals)
        return (red, green, blue), opacity

    def cutoff(self, opacities: Array) -> Array:
        # No weight exceeds that at the kernel's centre.
        return gaussian_cutoff(opacities * jnp.mean(self.kernels.opacities, axis=1) * (1 + LEAST_WEIGHT))


@dataclasses.dataclass(frozen=True)
class MovableKernels(Appearance):
    """Four movable kernels per splat: `params` are `MovableKernelParams`, there is no layout."""

    max_alpha: float = 0.99
    """Upper limit of alpha."""

    def allocate(self, key: Array, gaussians: Gaussians) -> tuple[MovableKernelParams, tuple[()]]:
        """Return colourless kernels around the mean. Together they are as opaque there as the Gaussian, up to 0.82."""
        num, dtype = gaussians.num, gaussians.means.dtype
        centers = jnp.asarray(INITIAL_CENTERS, dtype)
        weight_at_mean = float(np.exp(-2 * INITIAL_SHARPNESS)) + LEAST_WEIGHT
        opacities = jnp.minimum(gaussians.opacities / weight_at_mean, LARGEST_INITIAL_OPACITY)
        params = MovableKernelParams(
            centers=jnp.broadcast_to(centers[None], (num, NUM_KERNELS, 2)),
            sharpness=jnp.full((num, NUM_KERNELS), INITIAL_SHARPNESS, dtype),
            logit_opacities=jnp.broadcast_to(logit(opacities)[:, None], (num, NUM_KERNELS)),
            colors=jnp.zeros((num, NUM_KERNELS, 3), dtype),
        )
        return params, ()

    def rule(self, params: MovableKernelParams, layout: tuple[()]) -> MovableKernelsRule:
        return MovableKernelsRule(max_alpha=self.max_alpha, kernels=params)

    def project(self, params: MovableKernelParams) -> MovableKernelParams:
        """Return kernels with sharpness of at least 0."""
        return dataclasses.replace(params, sharpness=jnp.maximum(params.sharpness, 0.0))

    def num_floats(self, layout: tuple[()], num: int) -> int:
        """Return 27 per splat, beside the Gaussian's own: its opacity is not trained."""
        return (NUM_KERNELS * FLOATS_PER_KERNEL - 1) * num

    def num_published_floats(self, layout: tuple[()], num: int) -> int:
        return PUBLISHED_FLOATS * num

    def share(
        self, gaussians: Gaussians, params: MovableKernelParams, layout: tuple[()], num_shares: Array
    ) -> tuple[Gaussians, MovableKernelParams]:
        """Share the mean opacity of the kernels like that of a Gaussian; all kernels fade by one factor."""
        before = self.opacities(gaussians, params, layout)
        logits, log_scales = share(logit(before), gaussians.log_scales, num_shares)
        faded = params.opacities * (jax.nn.sigmoid(logits) / before)[:, None]
        is_shared = (num_shares > 1)[:, None]
        logits = jnp.where(is_shared, logit(jnp.minimum(faded, LARGEST_OPACITY)), params.logit_opacities)
        return (
            dataclasses.replace(gaussians, log_scales=log_scales),
            dataclasses.replace(params, logit_opacities=logits),
        )

    def opacities(self, gaussians: Gaussians, params: MovableKernelParams, layout: tuple[()]) -> Array:
        """Return the mean opacity [N] of the kernels, which bounds that of the splat to 10⁻⁴ of it."""
        return jnp.mean(params.opacities, axis=1)

    def limit_opacities(
        self, gaussians: Gaussians, params: MovableKernelParams, layout: tuple[()], most: Array
    ) -> tuple[Gaussians, MovableKernelParams]:
        """Limit the opacity of every kernel to `most`."""
        limit = logit(jnp.asarray(most, params.logit_opacities.dtype))
        return gaussians, dataclasses.replace(params, logit_opacities=jnp.minimum(params.logit_opacities, limit))
