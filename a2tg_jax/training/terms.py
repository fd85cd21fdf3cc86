"""Loss terms: a stage minimises their weighted sum.

A term is a frozen dataclass registered as a pytree, whose numbers are traced; `Term` makes one of any function.
"""

import functools
from collections.abc import Callable
from typing import TypeVar

import jax.numpy as jnp
from jax import Array

from a2tg_jax.core.cameras import Camera
from a2tg_jax.core.pytree import pytree, static
from a2tg_jax.data.observations import ObservedPoints
from a2tg_jax.model import Model
from a2tg_jax.rasterize.render_types import RenderOutput
from a2tg_jax.training.losses import mean_opacity, mean_scale, normal_consistency, photometric_loss, photometric_parts
from a2tg_jax.training.returned import check_scalar

T = TypeVar("T")


@pytree
class Target:
    """Target that a render is compared with."""

    camera: Camera
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
    observed: ObservedPoints | None = None
    """`points`, or None unless a term of the stage has `has_points`."""

    @property
    def depth(self) -> Array:
        """[H, W] depth map, divided by its largest magnitude, NaN where unknown. Raises ValueError if not loaded."""
        return _loaded("depth", self.depth_map, "has_depths")

    @property
    def points(self) -> ObservedPoints:
        """Points [S] that the photograph observed. Raises ValueError if they were not loaded."""
        return _loaded("points", self.observed, "has_points")


def _loaded(name: str, value: T | None, flag: str) -> T:
    if value is None:
        advice = f"say {flag}=True, as in Term(function, {flag}=True) for a custom loss term"
        raise ValueError(f"target.{name} was not loaded: {advice}")
    return value


LossFunction = Callable[[Model, Target, RenderOutput], Array]


@pytree
class Term:
    """Function of model, target and render, times a weight.

    Example:
        def roughness(model, target, output):
            return jnp.mean(jnp.abs(jnp.diff(output.depth, axis=0)))

        Term(roughness, weight=0.1, has_geometry=True)
    """

    function: LossFunction = static()
    weight: float = 1.0
    has_geometry: bool = static(default=False)
    """Whether the function reads `output.depth`, `normal` or `distortion`, which are rendered only on demand: unless a
    term of the stage asks for them, reading them raises ValueError."""
    has_depths: bool = static(default=False)
    """Whether the function reads `target.depth`, the depth map of the photograph."""
    has_points: bool = static(default=False)
    """Whether the function reads `target.points`, the points that the photograph observed."""

    def __call__(self, model: Model, target: Target, output: RenderOutput) -> Array:
        value = self.function(model, target, output)
        check_scalar(f"the loss function {getattr(self.function, '__name__', self.function)!r}", value)
        return self.weight * value

    @property
    def name(self) -> str:
        """Name in the history: that of the function."""
        return getattr(self.function, "__name__", type(self.function).__name__).strip("<>")


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
    """Normal consistency of 2DGS."""
    return normal_consistency(output.normal, output.depth, output.alpha, target.camera)


def distortion(model: Model, target: Target, output: RenderOutput) -> Array:
    """Depth distortion of 2DGS."""
    return jnp.mean(output.distortion)


def opacity(model: Model, target: Target, output: RenderOutput) -> Array:
    """Return the mean opacity of the live splats as their appearance has it (3DGS-MCMC; BBSplat: the mean alpha)."""
    return mean_opacity(model.appearance.opacities(model.gaussians), model.live_count)


def scale(model: Model, target: Target, output: RenderOutput) -> Array:
    """Return the mean scale of the live Gaussians (3DGS-MCMC)."""
    return mean_scale(model.gaussians, model.live_count)
