"""A photometric loss that leaves out what moves: pixels whose residual is too large for the rest of the photograph.

Passers-by, cars and shadows are on a few photographs only, so that the model cannot show them: where they are, the
residual stays large over whole patches. The mask is found anew in each step, from the residual of that step alone, as
in RobustNeRF (Sabour et al., 2023).
"""

import functools

import jax
import jax.numpy as jnp
from jax import Array

from a2tg_jax.core.pytree import pytree, static
from a2tg_jax.model import Model
from a2tg_jax.rasterize.render_types import RenderOutput
from a2tg_jax.training.losses import photometric_parts
from a2tg_jax.training.terms import Target

PATCHES = 32
"""Number of patches along the shorter side of a photograph."""
REACH = 1
"""Number of patches around one over which the residual is averaged."""


@pytree
class RobustPhotometric:
    """The photometric loss over inliers: patches without an outlying residual (`inliers`)."""

    ssim_weight: float = 0.2
    share: float = 0.3
    """Largest share of a photograph that is left out."""
    factor: float = 4.0
    """Least residual of what is left out, as a multiple of the photograph's median."""
    start: float = 0.25
    """Share of the stage after which something is left out; before, much is outlying that is not learned yet."""
    has_ssim: bool = static(default=True)
    """Whether to compute SSIM. Without it, images smaller than its window can be trained on."""

    def __call__(self, model: Model, target: Target, output: RenderOutput) -> Array:
        return functools.reduce(jnp.add, self.parts(model, target, output).values())

    def parts(self, model: Model, target: Target, output: RenderOutput) -> dict[str, Array]:
        residual = jnp.mean(jnp.abs(output.color - target.image), axis=-1)
        counts = inliers(residual, self.share, self.factor, target.mask) | (target.progress < self.start)
        color, image = (jnp.where(counts[..., None], x, jnp.zeros_like(x)) for x in (output.color, target.image))
        return photometric_parts(color, image, ssim_weight=self.ssim_weight if self.has_ssim else 0)


def inliers(residual: Array, share: Array | float, factor: Array | float, mask: Array | None = None) -> Array:
    """Return [H, W] bool, False at pixels of patches with an outlying residual; no gradient goes through it.

    The residual of a patch is the mean over the patch and its neighbours. It is outlying if it is larger than the
    quantile 1 − `share` of all patches and than `factor` times their median.

    Args:
      residual: [H, W] not negative.
      share: largest share of outlying patches, in [0, 1].
      factor: of the median.
      mask: [H, W] bool, pixels that count; the others are no part of quantile and median. None: all count.
    """
    height, width = residual.shape
    side = max(1, min(height, width) // PATCHES)
    counts = jnp.ones_like(residual) if mask is None else mask.astype(residual.dtype)
    sums, nums = (_around(_patch_sums(x, side)) for x in (jax.lax.stop_gradient(residual) * counts, counts))
    patches = jnp.where(nums > 0, sums / jnp.maximum(nums, 1), jnp.nan)
    quantiles = jnp.stack([jnp.asarray(0.5, residual.dtype), 1 - jnp.asarray(share, residual.dtype)])
    middle, high = jnp.nanquantile(patches, quantiles)
    is_fine = ~(patches > jnp.maximum(high, factor * middle))
    found = jnp.repeat(jnp.repeat(is_fine, side, axis=0), side, axis=1)
    return found[:height, :width]


def _patch_sums(image: Array, side: int) -> Array:
    """Return the sums over square patches; those at the right and lower edges may be cut off."""
    zero = jnp.zeros((), image.dtype)
    sums: Array = jax.lax.reduce_window(image, zero, jax.lax.add, (side, side), (side, side), _padding(image, side))
    return sums


def _padding(image: Array, side: int) -> tuple[tuple[int, int], tuple[int, int]]:
    return (0, -image.shape[0] % side), (0, -image.shape[1] % side)


def _around(patches: Array) -> Array:
    """Return the sums over each patch and its neighbours."""
    side = 2 * REACH + 1
    zero = jnp.zeros((), patches.dtype)
    reach = (REACH, REACH), (REACH, REACH)
    sums: Array = jax.lax.reduce_window(patches, zero, jax.lax.add, (side, side), (1, 1), reach)
    return sums
