"""Plain Gaussians in place of textured ones, for programs that know no textures.

Textures shrink where that changes pictures least, until a given number of splats suffices for a splat per texel. Each
textured Gaussian then becomes a grid of smaller ones in its plane: texel j of an axis takes the Gaussian with the mass,
mean and variance of w_j(u)·exp(−u²/2), w_j being the texel's bilinear kernel. These kernels add up to 1, so that the
smaller Gaussians add up to about the large one. Their opacities and colours are fitted to its alpha and colour in its
own plane, for alphas of splats that overlap multiply instead.
"""

import dataclasses
import functools
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from a2tg_jax.appearance import Plain
from a2tg_jax.appearance.textured import texel_coordinates
from a2tg_jax.core.cameras import Camera
from a2tg_jax.core.gaussians import SH_C0, Gaussians, floats_per_gaussian, logit, rotation_matrices
from a2tg_jax.core.jit import Jitted
from a2tg_jax.core.optim import adam_init, adam_update
from a2tg_jax.finish.shrinking import can_shrink, halved, taken, texel_weights_of
from a2tg_jax.io.ply import plain_gaussians
from a2tg_jax.model import Model

MOST_GROWTH = 2.0
"""Largest ratio of the bytes after baking to those before."""
REACH, SAMPLES = 3.6, 24
"""Half the side of the square that is fitted, in standard deviations, and samples along it."""
FIT_STEPS, FIT_RATE = 120, 0.05
LEAST_ALPHA, MOST_ALPHA = 1e-4, 0.99


class Kernels(NamedTuple):
    """Gaussians along an axis that add up to exp(−u²/2), one for each of n texels."""

    means: np.ndarray
    scales: np.ndarray
    peaks: np.ndarray


def bake(model: Model, cameras: Sequence[Camera], *, growth: float = MOST_GROWTH) -> Model:
    """Return a plain model that looks like a textured one (host).

    Args:
      model: of `Textured` with signed RGB, or of `Banded` around it. Of other appearances the Gaussians are taken.
      cameras: views by which it is judged where texels matter.
      growth: largest ratio of the bytes of all floats to those of the model.

    Raises:
      ValueError: if there are no cameras, or the growth is less than 1.
    """
    if not cameras or not growth >= 1:
        raise ValueError(f"baking needs cameras and a growth of at least 1; got {len(cameras)} and {growth}")
    model = model.live
    if not can_shrink(model):
        return dataclasses.replace(
            _as_plain(plain_gaussians(dataclasses.replace(model, origin=None))), origin=model.origin
        )
    num_floats = floats_per_gaussian(3 if model.bands is not None else model.gaussians.sh_degree)
    most = max(int(growth * model.num_bytes / (4 * num_floats)), model.num)
    model = _with_few_texels(model, cameras, most)
    return dataclasses.replace(_as_plain(_split(model)), origin=model.origin)


def _as_plain(gaussians: Gaussians) -> Model:
    return Model(gaussians, appearance=Plain())


def _with_few_texels(model: Model, cameras: Sequence[Camera], most: int) -> Model:
    """Return the model with smaller textures, so that a splat per texel makes at most so many splats."""
    while True:
        weights = texel_weights_of(model, cameras, model.background)
        step = halved(model, weights)
        before, after = _splats(model), np.maximum(step.layout.sizes.prod(axis=1), 1)
        is_single = before == 1
        too_many = int(before.sum()) - most
        saved = before - after
        order = np.argsort(np.where(saved > 0, step.cost / np.maximum(saved, 1), np.inf), kind="stable")
        reached = np.cumsum(saved[order])
        count = 0 if too_many <= 0 else int(np.searchsorted(reached, too_many)) + 1
        chosen = is_single & (model.textures[1].sizes.prod(axis=1) == 1)  # type: ignore[index]
        chosen[order[:count]] |= saved[order[:count]] > 0
        if not chosen.any():
            return model
        model = taken(model, step, chosen)


def _splats(model: Model) -> np.ndarray:
    """Return the number of splats [N] that each Gaussian will become."""
    assert model.textures is not None
    num: np.ndarray = np.maximum(model.textures[1].sizes.prod(axis=1), 1)
    return num


@functools.cache
def kernels(num: int, convention: str) -> Kernels:
    """Return the Gaussians along an axis for `num` texels."""
    u = np.linspace(-6, 6, 4801)
    place = np.asarray(texel_coordinates(jnp.asarray(u), jnp.asarray(float(num)), convention), np.float64)
    weights = np.maximum(0.0, 1 - np.abs(place[None] - np.arange(num)[:, None])) * np.exp(-0.5 * u * u)
    masses = weights.sum(axis=1)
    means = weights @ u / masses
    scales = np.sqrt(weights @ (u * u) / masses - means**2)
    return Kernels(means, scales, masses * (u[1] - u[0]) / (np.sqrt(2 * np.pi) * scales))


def _split(model: Model) -> Gaussians:
    """Return the Gaussians of all splats: those without a texture as they are, the others in a grid."""
    assert model.textures is not None and model.appearance.texture_options is not None
    textures, layout = model.textures
    whole = dataclasses.replace(model.gaussians, sh=jnp.asarray(model.sh))
    convention = model.appearance.texture_options.uv
    pieces = []
    for index, (tv, tu) in enumerate(layout.resolutions):
        ids = np.flatnonzero(np.asarray(layout.bucket) == index)
        if not len(ids):
            continue
        own = whole[ids]
        if tv * tu <= 1:
            pieces.append(own)
            continue
        texels = jnp.asarray(textures.buckets[index])[np.asarray(layout.row)[ids]]
        pieces.append(_grid(own, texels, kernels(tv, convention), kernels(tu, convention), convention))
    joined: Gaussians = jax.tree.map(lambda *parts: jnp.concatenate(parts), *pieces)
    return joined


def _grid(parents: Gaussians, texels: Array, v: Kernels, u: Kernels, convention: str) -> Gaussians:
    """Return n·Tv·Tu Gaussians in place of n with textures [n, Tv, Tu, 4]."""
    tv, tu = texels.shape[1:3]
    places = jnp.asarray(np.stack(np.broadcast_arrays(u.means[None, :], v.means[:, None]), -1).reshape(-1, 2))
    scales = jnp.asarray(np.stack(np.broadcast_arrays(u.scales[None, :], v.scales[:, None]), -1).reshape(-1, 2))
    peaks = jnp.asarray((v.peaks[:, None] * u.peaks[None, :]).reshape(-1))
    alphas, colors = _jitted()(parents.opacities, texels, places, scales, peaks, convention)
    axes = rotation_matrices(parents.quats)[:, :, :2] * parents.scales[:, None, :]
    means = parents.means[:, None] + jnp.einsum("nxk,pk->npx", axes, places)
    several = functools.partial(jnp.repeat, repeats=tv * tu, axis=0)
    sh = several(parents.sh).at[:, 0].add(colors.reshape(-1, 3) / SH_C0)
    dtype = parents.means.dtype
    return Gaussians(
        means=means.reshape(-1, 3).astype(dtype),
        quats=several(parents.quats),
        log_scales=(parents.log_scales[:, None] + jnp.log(scales)).reshape(-1, 2).astype(dtype),
        logit_opacities=logit(alphas.reshape(-1)).astype(dtype),
        sh=sh.astype(dtype),
    )


@functools.cache
def _jitted() -> Jitted[..., tuple[Array, Array]]:
    return Jitted(_fitted, static_argnums=(5,))


def _fitted(
    opacities: Array, texels: Array, places: Array, scales: Array, peaks: Array, convention: str
) -> tuple[Array, Array]:
    """Return opacities [n, P] and colours [n, P, 3] of splats whose picture in the plane is that of textures."""
    num, tv, tu, _ = texels.shape
    line = jnp.linspace(-REACH, REACH, SAMPLES)
    u, v = (axis.reshape(-1) for axis in jnp.meshgrid(line, line))
    wanted_alpha, wanted_color = _shown(opacities, texels, u, v, convention)
    falloff = jnp.exp(-0.5 * (((u - places[:, :1]) / scales[:, :1]) ** 2 + ((v - places[:, 1:]) / scales[:, 1:]) ** 2))

    def picture(raw: tuple[Array, Array]) -> tuple[Array, Array]:
        alphas, colors = jax.nn.sigmoid(raw[0])[:, :, None] * falloff, raw[1]
        depths = -jnp.log1p(-jnp.minimum(alphas, MOST_ALPHA))
        total = jnp.sum(depths, axis=1)
        mean = jnp.einsum("npq,npc->nqc", depths, colors) / jnp.maximum(total, 1e-6)[..., None]
        alpha = 1 - jnp.exp(-total)
        return alpha, alpha[..., None] * mean

    def loss(raw: tuple[Array, Array]) -> Array:
        alpha, color = picture(raw)
        return jnp.sum((alpha - wanted_alpha) ** 2) + jnp.sum((color - wanted_color) ** 2)

    flat = texels.reshape(num, tv * tu, 4)
    start = logit(jnp.clip(opacities[:, None] * flat[..., 3] * peaks, LEAST_ALPHA, MOST_ALPHA)), flat[..., :3]

    def step(carry: Any, _: None) -> tuple[Any, None]:
        raw, state = carry
        updated = adam_update(raw, jax.grad(loss)(raw), state, (FIT_RATE, 0.2 * FIT_RATE), eps=1e-12)
        return (updated.params, updated.state), None

    ((alphas, colors), _), _ = jax.lax.scan(step, (start, adam_init(start)), None, length=FIT_STEPS)
    return jnp.clip(jax.nn.sigmoid(alphas), LEAST_ALPHA, MOST_ALPHA), colors


def _shown(opacities: Array, texels: Array, u: Array, v: Array, convention: str) -> tuple[Array, Array]:
    """Return alpha [n, Q] and premultiplied residual [n, Q, 3] of textured splats at points of their plane."""
    weights = [
        jnp.maximum(
            0.0, 1 - jnp.abs(texel_coordinates(x, jnp.asarray(float(size)), convention) - jnp.arange(size)[:, None])
        )
        for x, size in ((v, texels.shape[1]), (u, texels.shape[2]))
    ]
    looked_up = jnp.einsum("ntsc,tq,sq->nqc", texels, *weights)
    alpha = opacities[:, None] * jnp.exp(-0.5 * (u * u + v * v)) * looked_up[..., 3]
    return alpha, alpha[..., None] * looked_up[..., :3]
