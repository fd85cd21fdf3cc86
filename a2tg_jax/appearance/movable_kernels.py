"""The appearance of SuperGaussians: four kernels that move over the splat, each with a colour and an opacity.

Kernel i has a centre (x_i, y_i) in standard deviations, a sharpness k_i, an opacity o_i and a colour c_i; 28 numbers
per splat. With the weights w_i = exp(−k_i·|(u, v) − (x_i, y_i)|²) + 10⁻⁴ the splat shows

    α = mean_i(o_i·w_i)·exp(−ρ/2),   colour = SH colour + mean_i(c_i·w_i)

The Gaussian's own opacity takes no part. (u, v) always belong to the hit; the authors' program takes offsets in
pixels instead where the low-pass filter decides.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from a2tg_jax.appearance.base import Appearance, gaussian_cutoff
from a2tg_jax.appearance.parts import Factor, Residual
from a2tg_jax.core.cameras import Camera
from a2tg_jax.core.gaussians import LARGEST_OPACITY, Gaussians, logit, share
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
class MovableKernels(Appearance):
    """Four movable kernels per splat."""

    centers: Array = None  # type: ignore[assignment]  # of templates only
    """[N, 4, 2] centres in standard deviations."""
    sharpness: Array = None  # type: ignore[assignment]  # of templates only
    """[N, 4] sharpness, not negative; a negative one acts as 0."""
    logit_opacities: Array = None  # type: ignore[assignment]  # of templates only
    """[N, 4] logits of the opacities."""
    colors: Array = None  # type: ignore[assignment]  # of templates only
    """[N, 4, 3] colours of either sign."""

    replaced_floats = 1

    @property
    def kernel_opacities(self) -> Array:
        """[N, 4] opacities of the kernels, in (0, 1)."""
        return jax.nn.sigmoid(self.logit_opacities)

    def numbers(self, gaussians: Gaussians, camera: Camera) -> Array:
        """Return [N, 28]: x, y, k, o and the colour of each kernel."""
        # Not `jnp.maximum`, which halves the gradient at 0, where `project` puts kernels.
        sharpness = jnp.where(self.sharpness >= 0, self.sharpness, 0.0)
        columns = [self.centers, sharpness[..., None], self.kernel_opacities[..., None], self.colors]
        return jnp.concatenate(columns, axis=2).reshape(gaussians.num, -1)

    def peak_opacities(self, gaussians: Gaussians) -> Array:
        return jnp.ones(gaussians.num, gaussians.means.dtype)

    def shade(
        self, numbers: tuple[Array, ...], values: tuple[Array, ...], u: Array, v: Array
    ) -> tuple[Residual, Factor]:
        totals = [jnp.zeros_like(u)] * 4
        for first in range(0, len(numbers), FLOATS_PER_KERNEL):
            x, y, sharpness, *opacity_and_color = numbers[first : first + FLOATS_PER_KERNEL]
            weight = jnp.exp(-sharpness * ((u - x) * (u - x) + (v - y) * (v - y))) + LEAST_WEIGHT
            totals = [total + weight * number for total, number in zip(totals, opacity_and_color, strict=True)]
        opacity, red, green, blue = (total * (1 / NUM_KERNELS) for total in totals)
        return (red, green, blue), opacity

    def cutoff(self, opacities: Array) -> Array:
        # A weight is largest at the kernel's centre.
        return gaussian_cutoff(opacities * jnp.mean(self.kernel_opacities, axis=1) * (1 + LEAST_WEIGHT))

    def allocate(self, key: Array, gaussians: Gaussians) -> "MovableKernels":
        """Return colourless kernels around the mean. Together they are as opaque there as the Gaussian, up to 0.82."""
        num = gaussians.num
        dtype = gaussians.means.dtype
        centers = jnp.asarray(INITIAL_CENTERS, dtype)
        # The mean is at a squared distance of 2 from each initial centre.
        weight_at_mean = float(np.exp(-2 * INITIAL_SHARPNESS)) + LEAST_WEIGHT
        opacities = jnp.minimum(gaussians.opacities / weight_at_mean, LARGEST_INITIAL_OPACITY)
        return dataclasses.replace(
            self,
            centers=jnp.broadcast_to(centers[None], (num, NUM_KERNELS, 2)),
            sharpness=jnp.full((num, NUM_KERNELS), INITIAL_SHARPNESS, dtype),
            logit_opacities=jnp.broadcast_to(logit(opacities)[:, None], (num, NUM_KERNELS)),
            colors=jnp.zeros((num, NUM_KERNELS, 3), dtype),
        )

    def project(self) -> "MovableKernels":
        """Return kernels with sharpness of at least 0."""
        return dataclasses.replace(self, sharpness=jnp.maximum(self.sharpness, 0.0))

    def num_published_floats(self, num: int) -> int:
        return PUBLISHED_FLOATS * num

    def opacities(self, gaussians: Gaussians) -> Array:
        """Return the mean opacity [N] of the kernels, which bounds the opacity of the splat to 10⁻⁴ of it."""
        return jnp.mean(self.kernel_opacities, axis=1)

    def share(self, gaussians: Gaussians, num_shares: Array) -> tuple[Gaussians, "MovableKernels"]:
        """Share the mean opacity of the kernels like a Gaussian's opacity; all kernels fade by one factor."""
        opacities = self.opacities(gaussians)
        logits, log_scales = share(logit(opacities), gaussians.log_scales, num_shares)
        faded = self.kernel_opacities * (jax.nn.sigmoid(logits) / opacities)[:, None]
        is_shared = (num_shares > 1)[:, None]
        logits = jnp.where(is_shared, logit(jnp.minimum(faded, LARGEST_OPACITY)), self.logit_opacities)
        return (
            dataclasses.replace(gaussians, log_scales=log_scales),
            dataclasses.replace(self, logit_opacities=logits),
        )

    def limit_opacities(self, gaussians: Gaussians, most: Array) -> tuple[Gaussians, "MovableKernels"]:
        """Limit the opacity of every kernel to `most`."""
        limit = logit(jnp.asarray(most, self.logit_opacities.dtype))
        return gaussians, dataclasses.replace(self, logit_opacities=jnp.minimum(self.logit_opacities, limit))
