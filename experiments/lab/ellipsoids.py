"""3D Gaussian splatting (Kerbl et al., 2023) as an appearance: ellipsoids, projected by EWA splatting.

The 2D covariance of a splat is Σ' = J·W·Σ·Wᵀ·Jᵀ + 0.3·I in pixels², with the camera's rotation W and the Jacobian J of
the perspective projection at the mean. With a Cholesky factor A of Σ' and the projected mean c, pixels are
A·(u, v) + c: a homography without perspective, for which u² + v² is the squared distance of Mahalanobis.
"""

import dataclasses
from typing import Any, ClassVar, Self

import jax.numpy as jnp
from jax import Array

import a2tg_jax as a2tg
from a2tg_jax.events import Now
from a2tg_jax.mcmc import Noise, densify_times, perturb
from a2tg_jax.rasterize.render_types import RenderOutput
from a2tg_jax.systems.baselines import Gaussians2dMcmc
from a2tg_jax.systems.two_stages import grown_by_mcmc, pruned
from a2tg_jax.training.losses import live_mean
from a2tg_jax.training.stage import Stage
from a2tg_jax.training.terms import Target, Term, opacity

LOW_PASS = 0.3
"""Variance in pixels² that is added to both axes on the screen."""
MOST_TANGENT = 1.3
"""Limit of the tangents in the Jacobian, as a multiple of those at the image's border."""


@a2tg.pytree(kw_only=True)
class Ellipsoids(a2tg.Appearance):
    """Gaussians with a third axis."""

    log_thickness: Array | None = None
    """[N] logarithms of the standard deviations along the third axis."""

    has_low_pass = False  # That of 2DGS; the covariance has its own.

    def homographies(self, gaussians: a2tg.Gaussians, camera: a2tg.Camera) -> tuple[Array, Array]:
        if camera.rays is not None:
            raise ValueError("ellipsoids are drawn by cameras without distortion only; undistort the photographs")
        _, normals = super().homographies(gaussians, camera)
        axes = gaussians.rotations * self.scales(gaussians)[:, None, :]
        to_camera = camera.viewmat[:3, :3]
        K = camera.K
        in_camera = jnp.sum(to_camera[None, :, :, None] * axes[:, None, :, :], axis=2)  # [N, 3, 3]: columns are axes
        x, y, z = (jnp.sum(gaussians.means * to_camera[i][None], axis=1) + camera.viewmat[i, 3] for i in range(3))
        z = jnp.where(z > 1e-6, z, jnp.asarray(1e-6, z.dtype))
        # The Jacobian's limits are centred on the image, as in the authors' program of 2023.
        at_border = MOST_TANGENT * jnp.array([0.5 * camera.width, 0.5 * camera.height], z.dtype) / jnp.diagonal(K)[:2]
        tangents = [jnp.clip(w / z, -most, most) for w, most in ((x, at_border[0]), (y, at_border[1]))]
        rows = [(in_camera[:, i] - tangents[i][:, None] * in_camera[:, 2]) * (K[i, i] / z)[:, None] for i in range(2)]
        squares = [jnp.sum(row * row, axis=1) for row in rows]
        xy = jnp.sum(rows[0] * rows[1], axis=1)
        normal = jnp.cross(*rows)
        along = jnp.sqrt(squares[0] + LOW_PASS)
        # The root of the determinant, a sum of squares: yy − xy²/xx would cancel for long splats, to 0 or less.
        determinant = jnp.sum(normal * normal, axis=1) + LOW_PASS * (squares[0] + squares[1] + LOW_PASS)
        across = jnp.sqrt(determinant) / along
        none = jnp.zeros_like(z)
        M = [z * along, none, K[0, 0] * x + K[0, 2] * z, z * (xy / along), z * across, K[1, 1] * y + K[1, 2] * z]
        return jnp.stack([*M, none, none, z], axis=1).reshape(-1, 3, 3), normals

    def scales(self, gaussians: a2tg.Gaussians) -> Array:
        """Return the standard deviations [N, 3]."""
        return jnp.concatenate([gaussians.scales, jnp.exp(self.log_thickness)[:, None]], axis=1)

    def allocate(self, key: Array, gaussians: a2tg.Gaussians) -> Self:
        """Return the appearance of spheres."""
        return dataclasses.replace(self, log_thickness=jnp.mean(gaussians.log_scales, axis=1))

    def share(self, gaussians: a2tg.Gaussians, num_shares: Array) -> tuple[a2tg.Gaussians, Self]:
        shared, _ = super().share(gaussians, num_shares)
        ratio = shared.log_scales[:, 0] - gaussians.log_scales[:, 0]
        return shared, dataclasses.replace(self, log_thickness=self.log_thickness + ratio)


@a2tg.pytree
class EllipsoidNoise(Noise):
    """Exploration noise with the covariance of the ellipsoids (`mcmc.perturb`)."""

    def apply(self, now: Now, model: a2tg.Model, moments: Any, state: tuple[()]) -> a2tg.Change:
        scales = model.appearance.scales(model.gaussians)
        gaussians = perturb(now.keys[0], model.gaussians, model.live_count, now.rate_of_means, scales)
        return a2tg.Change(dataclasses.replace(model, gaussians=gaussians), moments, state)


def mean_scale(model: a2tg.Model, target: Target, output: RenderOutput) -> Array:
    """Return the mean scale, over all three axes, of the live Gaussians (3DGS-MCMC)."""
    return live_mean(jnp.mean(model.appearance.scales(model.gaussians), axis=-1), model.live_count)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Gaussians3dMcmc(Gaussians2dMcmc):
    """3DGS-MCMC with the options of plain 2D Gaussians by MCMC."""

    weight: float = 0.0
    """Weight of the mean opacity, and of the mean scale, in the loss (0.01 in 3DGS-MCMC)."""

    name: ClassVar[str] = "gaussians-3d-mcmc"

    def stages(self) -> tuple[Stage, ...]:
        _, growth = grown_by_mcmc(self.densify, self.budget_cap(1))
        pruning = pruned(self.prune, self.stage1_iterations, densify_times(self.stage1_iterations))
        events = EllipsoidNoise(), growth, *pruning
        first = self.growing_stage(events, Ellipsoids(), {"log_thickness": self.rates.log_scales})
        stages = self.continued(first)
        if not self.weight:
            return stages
        weights = Term(opacity, self.weight), Term(mean_scale, self.weight)
        return tuple(dataclasses.replace(stage, losses=(*stage.losses, *weights)) for stage in stages)
