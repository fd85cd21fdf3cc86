"""Loss terms: a stage minimises their weighted sum.

A term is a frozen dataclass registered as a pytree, whose numbers are traced; `Term` makes one of any function.
Here are the terms of the paper and its baselines, one that ignores what moves, and depth priors.
"""

import functools
from collections.abc import Callable
from typing import Literal

import jax
import jax.numpy as jnp
from jax import Array

from a2tg_jax.base.named_fields import NamedFields
from a2tg_jax.core.cameras import Camera
from a2tg_jax.core.numerics import safe_divide
from a2tg_jax.core.pytree import pytree, static
from a2tg_jax.model import Model
from a2tg_jax.rasterize.render_types import RenderOutput
from a2tg_jax.training.losses import live_mean, normal_consistency, photometric_loss, photometric_parts
from a2tg_jax.training.returned import check_scalar


@pytree
class Target(NamedFields):
    """Target that a render is compared with."""

    camera: Camera
    """The view."""
    image: Array
    """[H, W, 3] photograph, composed over the background."""
    background: Array
    """[3]."""
    mask: Array | None = None
    """[H, W] bool, True at pixels that count; None: all. Excluded pixels of photograph and render are black."""
    progress: Array | float = 1.0
    """Share of the stage that is done."""
    depth_map: Array | None = None
    """`depth`, or None unless a term of the stage has `has_depths`."""

    @property
    def depth(self) -> Array:
        """[H, W] depth map, divided by its largest magnitude, NaN where unknown. Raises ValueError if not loaded."""
        if self.depth_map is None:
            raise ValueError(
                "target.depth was not loaded: use has_depths=True, as in Term(function, has_depths=True) for a custom "
                "loss term"
            )
        return self.depth_map


LossFunction = Callable[[Model, Target, RenderOutput], Array]


@pytree
class Term(NamedFields):
    """Function of model, target and render, times a weight.

    Examples:
      >>> def roughness(model, target, output):
      ...     return jnp.mean(jnp.abs(jnp.diff(output.depth, axis=0)))
      >>> a2tg.Term(roughness, weight=0.1, has_geometry=True).name
      'roughness'
    """

    function: LossFunction = static()
    """Function of the model, the `Target` and the `RenderOutput`; a scalar."""
    weight: float = 1.0
    """Weight of the function's value in the loss."""
    has_geometry: bool = static(default=False)
    """Whether the function reads `output.depth`, `normal` or `distortion`, which are rendered only on demand: unless a
    term of the stage needs them, reading them raises ValueError."""
    has_depths: bool = static(default=False)
    """Whether the function reads `target.depth`, the depth map of the photograph."""

    def __call__(self, model: Model, target: Target, output: RenderOutput) -> Array:
        value = self.function(model, target, output)
        check_scalar(f"the loss function {getattr(self.function, '__name__', self.function)!r}", value)
        return self.weight * value

    @property
    def name(self) -> str:
        """Name in the history: the function's."""
        return getattr(self.function, "__name__", type(self.function).__name__).strip("<>")  # of <lambda>


@pytree
class Photometric:
    """(1 − w)·L1 + w·(1 − SSIM), the loss of 3DGS."""

    ssim_weight: float = 0.2

    has_ssim = True

    def parts(self, model: Model, target: Target, output: RenderOutput) -> dict[str, Array]:
        return photometric_parts(output.color, target.image, ssim_weight=self.ssim_weight)

    def __call__(self, model: Model, target: Target, output: RenderOutput) -> Array:
        return functools.reduce(jnp.add, self.parts(model, target, output).values())


def l1(model: Model, target: Target, output: RenderOutput) -> Array:
    """Return the mean absolute difference."""
    return photometric_loss(output.color, target.image, ssim_weight=0)


def normals(model: Model, target: Target, output: RenderOutput) -> Array:
    """Return the normal consistency of 2DGS."""
    return normal_consistency(output.normal, output.depth, output.alpha, target.camera)


def distortion(model: Model, target: Target, output: RenderOutput) -> Array:
    """Return the depth distortion of 2DGS."""
    return jnp.mean(output.distortion)


def opacity(model: Model, target: Target, output: RenderOutput) -> Array:
    """Return the mean opacity of the live splats as their appearance has it (3DGS-MCMC; BBSplat: the mean alpha)."""
    return live_mean(model.appearance.opacities(model.gaussians), model.live_count)


def scale(model: Model, target: Target, output: RenderOutput) -> Array:
    """Return the mean scale, over both axes, of the live Gaussians (3DGS-MCMC)."""
    return live_mean(jnp.mean(model.gaussians.scales, axis=-1), model.live_count)


PATCHES = 32
"""Number of patches along the shorter side of a photograph."""
REACH = 1
"""Number of patches around one over which the residual is averaged."""


@pytree
class RobustPhotometric(Photometric):
    """The photometric loss over inliers: patches without an outlying residual (`inliers`).

    Passers-by, cars and shadows are in few photographs, so the model cannot show them, and their residual stays large
    over whole patches. Each step finds them from its own residual, as in RobustNeRF (Sabour et al., 2023).
    """

    share: float = 0.3
    """Largest share of a photograph that is left out."""
    factor: float = 4.0
    """Least residual of what is left out, as a multiple of the photograph's median."""
    start: float = 0.25
    """Share of the stage after which something is left out; earlier it would be what is not learned yet."""
    has_ssim: bool = static(default=True)
    """Whether to compute SSIM. Without it, images smaller than its window can be trained on."""

    def parts(self, model: Model, target: Target, output: RenderOutput) -> dict[str, Array]:
        residual = jnp.mean(jnp.abs(output.color - target.image), axis=-1)
        counts = inliers(residual, self.share, self.factor, target.mask) | (target.progress < self.start)
        color = jnp.where(counts[..., None], output.color, jnp.zeros_like(output.color))
        image = jnp.where(counts[..., None], target.image, jnp.zeros_like(target.image))
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

    def sums_around(image: Array) -> Array:
        # Sums over square patches, which the right and lower edges may cut off; then over each one's neighbours.
        zero = jnp.zeros((), image.dtype)
        padding = ((0, -height % side), (0, -width % side))
        patches = jax.lax.reduce_window(image, zero, jax.lax.add, (side, side), (side, side), padding)
        around = (2 * REACH + 1,) * 2
        reach = ((REACH, REACH),) * 2
        return jax.lax.reduce_window(patches, zero, jax.lax.add, around, (1, 1), reach)

    sums = sums_around(jax.lax.stop_gradient(residual) * counts)
    nums = sums_around(counts)
    # NaN: patches without pixels that count are no part of the quantiles, and pass as inliers.
    patches = jnp.where(nums > 0, sums / jnp.maximum(nums, 1), jnp.nan)
    quantiles = jnp.stack([jnp.asarray(0.5, residual.dtype), 1 - jnp.asarray(share, residual.dtype)])
    middle, high = jnp.nanquantile(patches, quantiles)
    # Not `<=`, which is False for NaN.
    is_fine = ~(patches > jnp.maximum(high, factor * middle))
    is_inlier = jnp.repeat(jnp.repeat(is_fine, side, axis=0), side, axis=1)
    return is_inlier[:height, :width]


DepthKind = Literal["inverse", "depth"]
"""Meaning of depth maps: inverse depth up to scale and shift (monocular networks), or depth up to scale (sensors,
networks of metric depth, of which 0 is unknown)."""
LEAST_ALPHA = 0.5
"""Least rendered alpha of pixels that are compared."""


@pytree
class DepthPrior:
    """Mean absolute difference of inverse depths after scale and shift of least squares (`depth_loss`)."""

    weight: float
    kind: DepthKind = static(default="inverse")

    name = "depth"
    has_geometry = True
    has_depths = True

    def __call__(self, model: Model, target: Target, output: RenderOutput) -> Array:
        prior = target.depth if self.kind == "inverse" else safe_divide(jnp.ones_like(target.depth), target.depth)
        counts = jnp.isfinite(prior) if self.kind == "inverse" else target.depth > 0
        if target.mask is not None:
            counts = counts & target.mask
        return self.weight * depth_loss(output.depth, output.alpha, prior, counts, has_shift=self.kind == "inverse")


def depth_loss(depth: Array, alpha: Array, prior: Array, counts: Array, *, has_shift: bool = True) -> Array:
    """Mean |s·prior + t − alpha/depth| over the pixels that count and are covered.

    s ≥ 0 and t, which is 0 without a shift, are the least squares solution of this view. No gradient goes through them.
    The loss is 0 if no pixel counts.

    Args:
      depth: [H, W] rendered depth Σ z·α·T, not divided by alpha.
      alpha: [H, W] rendered alpha.
      prior: [H, W] inverse depth up to scale and shift.
      counts: [H, W] bool, the pixels in which the prior is known.
      has_shift: whether there is a shift.
    """
    counts = counts & (alpha > LEAST_ALPHA) & (depth > 0)
    # Before any product, because 0·NaN is NaN.
    inverse = jnp.where(counts, safe_divide(alpha, depth), 0.0)
    prior = jnp.where(counts, prior, 0.0)
    scale, shift = jax.lax.stop_gradient(scale_and_shift(prior, inverse, counts, has_shift=has_shift))
    error = jnp.where(counts, jnp.abs(scale * prior + shift - inverse), 0.0)
    return jnp.sum(error) / jnp.maximum(jnp.sum(counts), 1).astype(error.dtype)


def scale_and_shift(prior: Array, inverse: Array, counts: Array, *, has_shift: bool = True) -> tuple[Array, Array]:
    """Return s ≥ 0 and t that minimise Σ (s·prior + t − inverse)² over the pixels that count.

    Without a shift, t is 0; with one, s is 0 where all values of the prior are equal.
    """
    weights = counts.astype(prior.dtype)
    num = jnp.maximum(jnp.sum(weights), 1)
    mean_prior = mean_inverse = jnp.zeros((), prior.dtype)
    if has_shift:
        mean_prior = jnp.sum(weights * prior) / num
        mean_inverse = jnp.sum(weights * inverse) / num
    # Centred on the means, which leaves t out of the equation of s, and cancels less in float32.
    centered = weights * (prior - mean_prior)
    scale = safe_divide(jnp.sum(centered * (inverse - mean_inverse)), jnp.sum(centered * centered))
    scale = jnp.maximum(scale, 0)
    return scale, mean_inverse - scale * mean_prior
