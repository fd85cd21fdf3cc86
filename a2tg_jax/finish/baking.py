"""Plain Gaussians in place of textured ones, for programs that know no textures.

Textures shrink where that changes pictures least, until a splat per texel makes few enough splats. Each textured
Gaussian then becomes a grid of smaller ones in its plane: texel j of an axis takes the Gaussian with the mass, mean and
variance of w_j(u)·exp(−u²/2), w_j being the texel's bilinear kernel. The kernels add up to 1, so that the smaller
Gaussians add up to about the large one. Their opacities are such that their optical depths −log(1 − alpha) add up to
that of the textured splat at each of their centres, with the kernel that it has; a splat of one texel becomes the
Gaussian nearest to its kernel. Splats smaller than a pixel are still drawn a pixel wide. Training on pictures of the
textured model, without photographs, therefore follows (`distilling`).
"""

import dataclasses
import functools
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from a2tg_jax.appearance.parts import MAX_DEGREE, curves_of, falloff_of, nearest_gaussians, texel_coordinates
from a2tg_jax.core.budget import BYTES_PER_FLOAT
from a2tg_jax.core.cameras import Camera
from a2tg_jax.core.gaussians import SH_C0, Gaussians, floats_per_gaussian, logit, rotation_matrices
from a2tg_jax.core.sh import NUM_BASES
from a2tg_jax.finish.distilling import distill, likeness, pictures
from a2tg_jax.finish.shrinking import texel_weights_of
from a2tg_jax.finish.texel_choice import Tables, fewest_texels
from a2tg_jax.io.other_programs import plain_gaussians
from a2tg_jax.model import Model

MOST_GROWTH = 2.0
"""Largest ratio of the bytes after baking to those before."""
ITERATIONS = 500
MOST_VIEWS = 12
"""Largest number of views, evenly chosen, by which it is judged where texels and spherical harmonics matter."""
LEAST_ALPHA, MOST_ALPHA = 1 / 255, 0.99
"""Alphas of splats: fainter ones are left out, others are at most so opaque."""
SAME_PSNR = 38.0
"""PSNR in dB beside the whole model above which higher degrees of spherical harmonics are left out."""


class Kernels(NamedTuple):
    """Gaussians along an axis that add up to exp(−u²/2), one for each of n texels."""

    means: np.ndarray
    scales: np.ndarray


def bake(
    model: Model,
    cameras: Sequence[Camera],
    *,
    growth: float = MOST_GROWTH,
    iterations: int = ITERATIONS,
    progress: bool = False,
) -> Model:
    """Return a plain model that looks like a textured one (host).

    Args:
      model: of any appearance. Textures become a splat per texel or fewer; of other appearances the Gaussians are
        taken, those nearest to kernels of other shapes.
      cameras: views that the new model is trained on.
      growth: largest ratio of the bytes of all floats to those of the model. If the Gaussians differ in their degree,
        the common one is lowered until one splat for each fits.
      iterations: of training on pictures of the model; 0: none.
      progress: show a progress bar.

    Raises:
      ValueError: if there are no cameras, or the growth is less than 1.
    """
    if not cameras or not growth >= 1:
        raise ValueError(f"baking needs cameras and a growth of at least 1; got {len(cameras)} and {growth}")
    model = model.live
    baked = split_splats(model, cameras[:: -(-len(cameras) // MOST_VIEWS)], growth)
    return distill(baked, model, cameras, iterations=iterations, progress=progress) if iterations else baked


def split_splats(model: Model, cameras: Sequence[Camera], growth: float) -> Model:
    """Return a plain model with a splat per texel or fewer, without training. Arguments as in `bake`."""
    options = model.appearance.texture_options if model.appearance.is_portable else None
    if options is None or model.textures is None:
        whole = plain_gaussians(model)
        degree = fitting_degree(model, whole.sh_degree, growth)
        return as_plain(dataclasses.replace(whole, sh=whole.sh[:, : NUM_BASES[degree]]), model)
    degree = fitting_degree(model, least_degree(model, cameras), growth)
    assert model.appearance.texture is not None
    weights = texel_weights_of(model, cameras, model.background)
    shown = model.appearance.texture.shown()
    tables = fewest_texels(shown, weights, most_splats(model, degree, growth))
    whole = dataclasses.replace(model.gaussians, sh=jnp.asarray(model.sh[:, : NUM_BASES[degree]]))
    return as_plain(_split(whole, model.appearance.shapes, tables, options.uv), model)


def as_plain(gaussians: Gaussians, model: Model) -> Model:
    """Return a plain model of Gaussians with background and origin of another."""
    return Model(gaussians, background=model.background, origin=model.origin)


def most_splats(model: Model, degree: int, growth: float) -> int:
    """Return how many plain splats of a degree take at most `growth` times the bytes of a model (host)."""
    return int(growth * model.num_bytes / (BYTES_PER_FLOAT * floats_per_gaussian(degree)))


def fitting_degree(model: Model, highest: int, growth: float) -> int:
    """Return the highest degree, at most `highest`, in which a splat for each Gaussian stays within the growth (host).

    Degree 0 always does: no Gaussian of the model takes less.
    """
    return max((d for d in range(highest + 1) if most_splats(model, d, growth) >= model.num), default=0)


def least_degree(model: Model, cameras: Sequence[Camera]) -> int:
    """Return the lowest degree of spherical harmonics with which pictures stay about the same (host)."""
    highest = model.gaussians.sh_degree if model.appearance.bands is None else MAX_DEGREE
    if highest == 0:
        return 0
    wanted = list(pictures(model, cameras))
    for degree in range(highest):
        sh = np.array(model.sh)
        sh[:, NUM_BASES[degree] :] = 0
        if likeness(pictures(model.with_sh(sh), cameras), wanted) > SAME_PSNR:
            return degree
    return highest


@functools.cache
def kernels(num: int, convention: str) -> Kernels:
    """Return the Gaussians along an axis for `num` texels."""
    u = np.linspace(-6, 6, 4801)
    weights = _weights(u, num, convention) * np.exp(-0.5 * u * u)
    masses = weights.sum(axis=1)
    means = weights @ u / masses
    return Kernels(means, np.sqrt(weights @ (u * u) / masses - means**2))


def _weights(u: np.ndarray, num: int, convention: str) -> np.ndarray:
    """Return the bilinear weights [num, Q] of texels at points of an axis."""
    place = np.asarray(texel_coordinates(jnp.asarray(u), jnp.asarray(float(num)), convention), np.float64)
    found: np.ndarray = np.maximum(0.0, 1 - np.abs(place[None] - np.arange(num)[:, None]))
    return found


def _split(gaussians: Gaussians, shapes: Array | None, tables: Tables, convention: str) -> Gaussians:
    """Return the Gaussians of all splats, given the shapes [N] of their kernels if they are not Gaussians."""
    pieces = []
    for ids, texels in (_looked_up(*table, convention) for table in tables):
        parents, own, size = gaussians[ids], None, texels.shape[1:3]
        if shapes is not None:
            own = np.asarray(shapes)[ids]
            parents, own = (nearest_gaussians(parents, own), None) if size == (1, 1) else (parents, own)
        pieces.append(_grid(parents, own, texels, kernels(size[0], convention), kernels(size[1], convention)))
    joined: Gaussians = jax.tree.map(lambda *parts: jnp.concatenate(parts), *pieces)
    is_seen = np.asarray(joined.opacities) >= LEAST_ALPHA
    return joined[is_seen if is_seen.any() else slice(None)]


def _looked_up(ids: np.ndarray, texels: np.ndarray, convention: str) -> tuple[np.ndarray, np.ndarray]:
    """Return textures [n, Tv, Tu, 4] at the centres of their splats in place of the texels."""
    v, u = (_weights(kernels(size, convention).means, size, convention) for size in texels.shape[1:3])
    found: np.ndarray = np.einsum("ntsc,tv,su->nvuc", texels, v, u)
    return ids, found


def _falloff(shapes: np.ndarray | None, rho: np.ndarray) -> np.ndarray:
    """Return kernels of shapes [n] at squared distances [Tv, Tu], that of a Gaussian without shapes."""
    if shapes is None:
        return np.exp(-0.5 * rho)
    return np.asarray(falloff_of(curves_of(jnp.asarray(shapes)[:, None, None]), jnp.asarray(rho)[None]), np.float64)


def _grid(parents: Gaussians, shapes: np.ndarray | None, texels: np.ndarray, v: Kernels, u: Kernels) -> Gaussians:
    """Return n·Tv·Tu Gaussians in place of n that show textures [n, Tv, Tu, 4] at their centres."""
    tv, tu = texels.shape[1:3]
    places, scales = (
        np.stack(np.broadcast_arrays(own_u[None, :], own_v[:, None]), -1).reshape(-1, 2)
        for own_u, own_v in zip(u, v, strict=True)
    )
    opacities = np.asarray(parents.opacities, np.float64)[:, None, None]
    shown = opacities * texels[..., 3] * _falloff(shapes, v.means[:, None] ** 2 + u.means[None, :] ** 2)
    depths = -np.log1p(-np.clip(shown, 0, MOST_ALPHA))
    own = np.einsum("vw,nwx,xu->nvu", _unmixed(v), depths, _unmixed(u).T)
    alphas = np.clip(1 - np.exp(-np.maximum(own, 0)), 1e-6, MOST_ALPHA).reshape(-1)
    axes = np.asarray(rotation_matrices(parents.quats))[:, :, :2] * np.asarray(parents.scales)[:, None, :]
    means = np.asarray(parents.means)[:, None] + np.einsum("nxk,pk->npx", axes, places)
    several = functools.partial(np.repeat, repeats=tv * tu, axis=0)
    sh = several(np.asarray(parents.sh))
    sh[:, 0] += texels[..., :3].reshape(-1, 3) / SH_C0
    log_scales = np.asarray(parents.log_scales)[:, None] + np.log(scales)
    dtype = parents.means.dtype
    return Gaussians(
        means=jnp.asarray(means.reshape(-1, 3), dtype),
        quats=jnp.asarray(several(np.asarray(parents.quats))),
        log_scales=jnp.asarray(log_scales.reshape(-1, 2), dtype),
        logit_opacities=jnp.asarray(logit(jnp.asarray(alphas)), dtype),
        sh=jnp.asarray(sh, dtype),
    )


def _unmixed(axis: Kernels) -> np.ndarray:
    """Return the inverse of the matrix of each Gaussian of an axis at the centre of each."""
    apart = (axis.means[:, None] - axis.means[None, :]) / axis.scales[None, :]
    inverse: np.ndarray = np.linalg.inv(np.exp(-0.5 * apart**2))
    return inverse
