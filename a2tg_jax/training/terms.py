"""Loss terms: a stage minimises their weighted sum.

A term is a frozen dataclass registered as a pytree, whose numbers are traced; `Term` makes one of any function.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

from a2tg_jax.core.cameras import Camera
from a2tg_jax.events import event, static
from a2tg_jax.model import Model
from a2tg_jax.rasterize.render_types import RenderOutput
from a2tg_jax.training.losses import mean_opacity, mean_scale, normal_consistency, photometric_loss


class Target(NamedTuple):
    """Target that a render is compared with."""

    camera: Camera
    image: Array
    """[H, W, 3] photograph, composed over the background."""
    background: Array
    """[3]."""
    mask: Array | None = None
    """[H, W] bool, True at pixels that count; None: all. Excluded pixels of photograph and render are black."""
    depth: Array | None = None
    """[H, W] depth map as given, NaN where unknown; None unless a term of the stage has `has_depths`."""
    progress: Array | float = 1.0
    """Share of the stage that is done."""


LossFunction = Callable[[Model, Target, RenderOutput], Array]


@event
class Term:
    """Function of model, target and render, times a weight."""

    function: LossFunction = static()
    weight: float = 1.0
    has_geometry: bool = static(default=False)
    """Whether the function reads depth, normals or distortion, which are composited only on demand."""

    def __call__(self, model: Model, target: Target, output: RenderOutput) -> Array:
        return self.weight * self.function(model, target, output)


@event
class Photometric:
    """(1 − w)·L1 + w·(1 − SSIM), the loss of 3DGS."""

    ssim_weight: float = 0.2

    has_geometry = False

    def __call__(self, model: Model, target: Target, output: RenderOutput) -> Array:
        return photometric_loss(output.color, target.image, ssim_weight=self.ssim_weight)


def l1(model: Model, target: Target, output: RenderOutput) -> Array:
    """Return the mean absolute difference."""
    return photometric_loss(output.color, target.image, ssim_weight=0)


def normals(model: Model, target: Target, output: RenderOutput) -> Array:
    """Normal consistency of 2DGS."""
    return normal_consistency(output.normal, output.depth, output.alpha, target.camera)


def distortion(model: Model, target: Target, output: RenderOutput) -> Array:
    """Depth distortion of 2DGS."""
    return jnp.mean(output.distortion)


def opacity(model: Model, target: Target, output: RenderOutput) -> Array:
    """Return the mean opacity of the live splats as their appearance has it (3DGS-MCMC; BBSplat: the mean alpha)."""
    return mean_opacity(model.appearance.opacities(model.gaussians, model.params, model.layout), model.live_count)


def scale(model: Model, target: Target, output: RenderOutput) -> Array:
    """Return the mean scale of the live Gaussians (3DGS-MCMC)."""
    return mean_scale(model.gaussians, model.live_count)
