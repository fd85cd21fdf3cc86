"""Appearances other than textures, for the oracle: float64 numpy, no code shared with the package.

Each one is a function of (scene, arrays, index) that gives the `Hits` and the `Shown` of one splat.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
from oracle import (
    DEFAULT_RULES,
    MIN_ALPHA,
    Float,
    Hits,
    Image,
    Rules,
    Scene,
    Shown,
    composite,
    homography,
    intersect,
    shown_layer,
    view_direction,
)

Show = Callable[[Scene, Any, int], tuple[Hits, Shown]]


def sigmoid(x):
    return 1 / (1 + np.exp(-np.asarray(x)))


def hits_of(scene: Scene, i: int, has_low_pass: bool = True) -> Hits:
    """Where the rays meet splat `i`."""
    return intersect(*homography(scene, i), scene.width, scene.height, DEFAULT_RULES.near, has_low_pass)


def render_appearance(scene: Scene, arrays: Any, show: Show, rules: Rules = DEFAULT_RULES) -> Image:
    """The image of splats of an appearance."""
    layers = [shown_layer(scene, i, rules, *show(scene, arrays, i)) for i in range(len(scene.means))]
    return composite(layers, scene.background)


def glossy(scene: Scene, arrays: dict[str, Float], i: int, has_low_pass: bool = True) -> tuple[Hits, Shown]:
    """A highlight about an axis, and the falloff (1 + ρ/2k)^(−k)."""
    hits = hits_of(scene, i, has_low_pass)
    axis = arrays["axes"][i] / np.linalg.norm(arrays["axes"][i])
    highlight = arrays["colors"][i] * np.exp(3 * (view_direction(scene, i) @ axis - 1))
    exponent = np.exp(arrays["log_exponents"][i])
    opacity = sigmoid(scene.logit_opacities[i])
    falloff = lambda rho: (1 + rho / (2 * exponent)) ** -exponent  # noqa: E731
    ones = np.ones_like(hits.u)
    residual = np.stack([highlight[0] * ones, highlight[1] * hits.u, highlight[2] * hits.v * hits.v], axis=-1)
    is_relevant = opacity * falloff(hits.closest_rho) >= 0.99 * MIN_ALPHA
    return hits, Shown(opacity * falloff(hits.rho), residual, np.inf, np.inf, is_relevant)


def painted(scene: Scene, arrays: dict[str, Float], i: int) -> tuple[Hits, Shown]:
    """Colours times 1 + w·tanh(W·(u, v, code)) of a network that splats share, plus its first output."""
    hits = hits_of(scene, i)
    opacity = sigmoid(scene.logit_opacities[i])
    inputs = np.stack([hits.u, hits.v, np.full_like(hits.u, arrays["codes"][i])], axis=-1)
    outputs = np.tanh(inputs @ arrays["first"].T) @ arrays["last"]
    is_relevant = opacity * np.exp(-hits.closest_rho / 2) >= 0.99 * MIN_ALPHA
    strength = opacity * np.exp(-hits.rho / 2)
    residual = outputs[..., :1] * np.ones(3)
    return hits, Shown(strength, residual, np.inf, np.inf, is_relevant, tint=1 + outputs)


def shaped(scene: Scene, arrays: dict[str, Float], i: int) -> tuple[Hits, Shown]:
    """A generalised Gaussian: the exponent of the falloff grows as (ρ + δ)^β, from 0 at ρ = 0 to 1 at ρ = 2."""
    hits = hits_of(scene, i)
    exponent = np.exp(np.tanh(arrays["shapes"][i]))
    delta = 0.02
    growth = lambda rho: (rho + delta) ** exponent - delta**exponent  # noqa: E731
    alpha = lambda rho: sigmoid(scene.logit_opacities[i]) * np.exp(-growth(rho) / growth(2.0))  # noqa: E731
    is_relevant = alpha(hits.closest_rho) >= 0.99 * MIN_ALPHA
    return hits, Shown(alpha(hits.rho), np.zeros((*hits.u.shape, 3)), np.inf, np.inf, is_relevant)


def movable(scene: Scene, arrays: dict[str, Float], i: int) -> tuple[Hits, Shown]:
    """SuperGaussians: four kernels, each 10⁻⁴ + exp(−k·distance²), of (u, v) at the hit."""
    hits = hits_of(scene, i)
    opacities = sigmoid(arrays["logit_opacities"][i])
    opacity = np.zeros_like(hits.u)
    residual = np.zeros((*hits.u.shape, 3))
    for kernel in range(4):
        offset = np.stack([hits.u, hits.v], axis=-1) - arrays["centers"][i, kernel]
        weight = np.exp(-arrays["sharpness"][i, kernel] * np.sum(offset**2, axis=-1)) + 1e-4
        opacity += opacities[kernel] * weight / 4
        residual += weight[..., None] * arrays["colors"][i, kernel] / 4
    is_relevant = np.mean(opacities) * np.exp(-hits.closest_rho / 2) >= 0.98 * MIN_ALPHA
    return hits, Shown(opacity * np.exp(-hits.rho / 2), residual, np.inf, np.inf, is_relevant)


def billboard(scene: Scene, arrays: dict[str, Float], i: int) -> tuple[Hits, Shown]:
    """BBSplat: an RGBA picture over u, v in [−1, 1], its outer texels at the ends, bilinear among zeros."""
    hits = hits_of(scene, i, has_low_pass=False)
    texels = arrays["texels"][i]
    side = len(texels)
    shown = np.concatenate([sigmoid(texels[..., :3]), texels[..., 3:]], axis=-1)
    padded = np.pad(shown, ((1, 2), (1, 2), (0, 0)))
    x, y = (np.clip((w + 1) / 2 * (side - 1), -1, side) for w in (hits.u, hits.v))
    column = np.floor(x).astype(int) + 1
    row = np.floor(y).astype(int) + 1
    fx = (x - np.floor(x))[..., None]
    fy = (y - np.floor(y))[..., None]
    above = (1 - fx) * padded[row, column] + fx * padded[row, column + 1]
    below = (1 - fx) * padded[row + 1, column] + fx * padded[row + 1, column + 1]
    texel = (1 - fy) * above + fy * below
    kink = np.minimum(abs(x - np.round(x)), abs(y - np.round(y)))
    is_relevant = hits.closest_rho <= 2 * (1 + 2 / (side - 1)) ** 2
    return hits, Shown(
        np.where(np.isfinite(hits.rho), texel[..., 3], 0.0), texel[..., :3] - 0.1, np.inf, kink, is_relevant
    )
