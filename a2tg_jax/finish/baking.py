"""Plain Gaussians instead of textured ones, for programs without textures.

Textures shrink where that changes pictures least, until a splat per texel makes few enough splats. Each textured
Gaussian then becomes a grid of smaller ones in its plane: texel j of an axis takes the Gaussian with the mass, mean and
variance of w_j(u)·exp(−u²/2), w_j being the texel's bilinear kernel. The kernels add up to 1, so that the smaller
Gaussians add up to about the large one. At each of their centres, their optical depths −log(1 − alpha) add up to the
depth of the textured splat with its kernel; a splat of one texel becomes the Gaussian nearest to its kernel. Splats
smaller than a pixel are still drawn a pixel wide. Training on pictures of the textured model, without photographs,
therefore follows.
"""

import dataclasses
import functools
import math
from collections.abc import Iterable, Iterator, Sequence

import jax
import jax.numpy as jnp
import numpy as np

from a2tg_jax import (
    Camera,
    Exponents,
    Gaussians,
    Gaussians2d,
    Model,
    Progress,
    Renderer,
    Scene,
    Similarity,
    Texture,
    TextureOptions,
    TextureRegion,
    Textures,
    View,
    fit_stage,
)
from a2tg_jax.appearance.parts import MAX_DEGREE, nearest_gaussians
from a2tg_jax.base.even_spacing import evenly_chosen
from a2tg_jax.core.budget import bytes_per_gaussian
from a2tg_jax.core.gaussians import logit
from a2tg_jax.core.origin import Color
from a2tg_jax.core.sh import NUM_BASES, SH_C0
from a2tg_jax.data.assembly import scene_scale
from a2tg_jax.data.capture_geometry import camera_centers, matrices_of, without_outlying
from a2tg_jax.finish.shrinking import fewest_texels, texel_weights
from a2tg_jax.host.training_bar import ProgressBar
from a2tg_jax.model import plain_gaussians

MOST_VIEWS = 12
"""Largest number of views, evenly chosen, for measuring where texels and spherical harmonics matter."""
LEAST_ALPHA = 1 / 255
"""Smallest alpha of a splat; fainter splats are dropped."""
MOST_ALPHA = 0.99
"""Largest alpha of a splat; larger ones are clipped."""
SAME_PSNR = 38.0
"""PSNR in dB against the full model above which higher degrees of spherical harmonics are dropped."""


def bake(
    model: Model,
    cameras: Sequence[Camera],
    *,
    growth: float,
    iterations: int,
    progress: bool = False,
) -> Model:
    """Return a plain model that looks like a textured one (host).

    Args:
      model: model of any appearance. Textures become a splat per texel or fewer; other appearances are reduced to
        their Gaussians, or the ones nearest to their kernels.
      cameras: views that the new model is trained on.
      growth: largest ratio of the bytes of all floats to the model's. If Gaussians differ in degree, the common
        degree is lowered until one splat for each fits.
      iterations: number of iterations on pictures of the model; 0: no training. A single splat is not trained.
      progress: show a progress bar.

    Raises:
      ValueError: if there are no cameras or no Gaussians, or the growth is less than 1.
    """
    if not cameras or not growth >= 1:
        raise ValueError(f"baking needs cameras and a growth of at least 1; got {len(cameras)} and {growth}")
    model = model.live
    if not model.num:
        raise ValueError("the model has no Gaussians to bake: give another model")
    # Splitting renders each view several times, for which some of them suffice; training uses all.
    baked = split_splats(model, evenly_chosen(cameras, MOST_VIEWS), growth)
    if iterations == 0 or baked.num == 1:
        return baked
    return distill(baked, model, cameras, iterations=iterations, progress=progress)


def split_splats(model: Model, cameras: Sequence[Camera], growth: float) -> Model:
    """Return a plain model with a splat per texel or fewer, without training. Arguments as in `bake`."""

    def fitting(highest: int) -> tuple[int, int]:
        """Return the highest degree at which a splat for each Gaussian is within the growth, and how many are."""
        # Degree 0 always fits: no Gaussian of the model is smaller.
        for degree in range(highest, -1, -1):
            most = int(growth * model.num_bytes / bytes_per_gaussian(degree))
            if most >= model.num or degree == 0:
                break
        return degree, most

    # Subclasses of Appearance may show their textures in another way.
    options = model.appearance.texture_options if model.appearance.is_portable else None
    if options is None or model.textures is None:
        whole = plain_gaussians(model)
        degree, _ = fitting(whole.sh_degree)
        return as_plain(dataclasses.replace(whole, sh=whole.sh[:, : NUM_BASES[degree]]), model)
    degree, most = fitting(least_degree(model, cameras))
    assert model.appearance.texture is not None
    weights = texel_weights(model, cameras, model.background)
    tables = fewest_texels(model.appearance.texture.shown(), weights, most)
    whole = dataclasses.replace(model.gaussians, sh=jnp.asarray(model.sh[:, : NUM_BASES[degree]]))
    pieces = []
    for ids, texels in tables:
        parents = whole[ids]
        size = texels.shape[1:3]
        shapes = None if model.appearance.shapes is None else np.asarray(model.appearance.shapes)[ids]
        # A single splat cannot imitate a kernel by a grid: it takes the nearest Gaussian.
        if shapes is not None and size == (1, 1):
            parents = nearest_gaussians(parents, shapes)
            shapes = None
        axes = [kernels(side, options) for side in size]
        at_centers = [_weights(means, side, options) for (means, _), side in zip(axes, size, strict=True)]
        shown = np.einsum("ntsc,tv,su->nvuc", texels, *at_centers)
        if options.outside == "identity":
            shares_v, shares_u = (shares_inside(side, options) for side in size)
            neutral = np.asarray(Textures.padding)
            shown = neutral + (shares_v[:, None] * shares_u)[..., None] * (shown - neutral)
        pieces.append(_grid(parents, shapes, shown, *axes))
    joined: Gaussians = jax.tree.map(lambda *parts: jnp.concatenate(parts), *pieces)
    # Fainter splats are skipped by every renderer, and would only take bytes.
    is_seen = np.asarray(joined.opacities) >= LEAST_ALPHA
    return as_plain(joined[is_seen if is_seen.any() else slice(None)], model)


def as_plain(gaussians: Gaussians, model: Model) -> Model:
    """Return a plain model with another model's background and origin."""
    return Model(gaussians, background=model.background, origin=model.origin)


def least_degree(model: Model, cameras: Sequence[Camera]) -> int:
    """Return the lowest degree of spherical harmonics at which pictures stay about the same (host)."""
    highest = model.gaussians.sh_degree if model.appearance.bands is None else MAX_DEGREE
    wanted = list(pictures(model, cameras)) if highest else []
    for degree in range(highest):
        sh = np.array(model.sh)
        sh[:, NUM_BASES[degree] :] = 0
        if likeness(pictures(model.with_sh(sh), cameras), wanted) > SAME_PSNR:
            return degree
    return highest


Kernels = tuple[np.ndarray, np.ndarray]
"""Means and scales of Gaussians along an axis that add up to exp(−u²/2), one for each of n texels."""


@functools.cache
def kernels(num: int, options: TextureOptions) -> Kernels:
    """Return the Gaussians along an axis for `num` texels."""
    u, masses = _masses(num, options)
    means = masses @ u
    # Variance: E[u²] − E[u]².
    return means, np.sqrt(masses @ (u * u) - means**2)


def shares_inside(num: int, options: TextureOptions) -> np.ndarray:
    """Return the shares [num] of the Gaussians along an axis that are within the extent."""
    u, masses = _masses(num, options)
    return masses @ (np.abs(u) <= options.extent)


def _masses(num: int, options: TextureOptions) -> tuple[np.ndarray, np.ndarray]:
    """Return points of an axis, and the share of each [num, Q] of w_j(u)·exp(−u²/2) for `num` texels."""
    # Steps of 1/400, as exp(−u²/2) is below 2·10⁻⁸ beyond ±6, and as many over the texture, however small it is.
    u = np.unique(np.concatenate([np.linspace(-end, end, 4801) for end in (6.0, options.extent)]))
    # Texels far outside weigh nothing, and have a place and a size nevertheless.
    masses = _weights(u, num, options) * (np.exp(-0.5 * u * u) + 1e-20) * np.gradient(u)
    return u, masses / masses.sum(axis=1, keepdims=True)


def _weights(u: np.ndarray, num: int, options: TextureOptions) -> np.ndarray:
    """Return the bilinear weights [num, Q] of texels at points of an axis."""
    line = TextureRegion(jnp.int32(0), jnp.int32(1), jnp.int32(num))
    place, _ = Texture(options=options).position(line, jnp.asarray(u), jnp.asarray(u))
    # Clamped coordinates give the outer texels all of the edge, so that the weights add up to 1.
    return np.maximum(0.0, 1 - np.abs(np.asarray(place, np.float64)[None] - np.arange(num)[:, None]))


def _grid(parents: Gaussians, shapes: np.ndarray | None, texels: np.ndarray, v: Kernels, u: Kernels) -> Gaussians:
    """Return n·Tv·Tu Gaussians for n that show textures [n, Tv, Tu, 4] at their centres."""
    tv, tu = texels.shape[1:3]
    places, scales = (
        np.stack(np.broadcast_arrays(along_u[None, :], along_v[:, None]), -1).reshape(-1, 2)
        for along_u, along_v in zip(u, v, strict=True)
    )
    rho = v[0][:, None] ** 2 + u[0][None, :] ** 2
    if shapes is None:
        falloff = np.exp(-0.5 * rho)
    else:
        falloff = np.asarray(Exponents(jnp.asarray(shapes)[:, None, None]).falloff(jnp.asarray(rho)[None]), float)
    shown = np.asarray(parents.opacities, np.float64)[:, None, None] * texels[..., 3] * falloff
    # Overlapping alphas multiply as 1 − alpha: their optical depths −log(1 − alpha) add up.
    depths = -np.log1p(-np.clip(shown, 0, MOST_ALPHA))
    # Each Gaussian reaches the others' centres: the inverse of these shares, axis by axis, gives its own depth.
    unmixed = [
        np.linalg.inv(np.exp(-0.5 * ((means[:, None] - means[None, :]) / widths[None, :]) ** 2))
        for means, widths in (v, u)
    ]
    # The shares are products over the two axes, so that two small inverses suffice.
    unmixed_depths = np.einsum("vw,nwx,xu->nvu", unmixed[0], depths, unmixed[1].T)
    # The inverse may give negative depths next to opaque texels.
    alphas = np.clip(1 - np.exp(-np.maximum(unmixed_depths, 0)), 1e-6, MOST_ALPHA).reshape(-1)
    axes = np.asarray(parents.rotations)[:, :, :2] * np.asarray(parents.scales)[:, None, :]
    means = np.asarray(parents.means)[:, None] + np.einsum("nxk,pk->npx", axes, places)
    several = functools.partial(np.repeat, repeats=tv * tu, axis=0)
    sh = several(np.asarray(parents.sh))
    # RGB residuals add to the colour; Y₀ = SH_C0 does not depend on the direction.
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


# Training on pictures of another model


def distill(
    model: Model, wanted: Model, cameras: Sequence[Camera], *, iterations: int, progress: bool = False
) -> Model:
    """Return a plain model trained on pictures of another model in its world; the number of Gaussians stays.

    Both are rendered over black or white, whichever is nearer to the other model's background. Each iteration renders
    one view.
    """
    # Only the second stage runs: it does not change the number of Gaussians.
    system = Gaussians2d(
        stage1_iterations=1, stage2_iterations=iterations, sh_degree=model.gaussians.sh_degree,
        background="white" if np.mean(wanted.background) > 0.5 else "black",
    )  # fmt: skip
    scene = drawn_scene(wanted, cameras, system.background_color)
    start = dataclasses.replace(model, origin=None)
    trained = fit_stage(scene, system, 1, start, progress=Progress(ProgressBar if progress else None, "bake")).model
    return dataclasses.replace(trained, origin=wanted.origin)


def drawn_scene(model: Model, cameras: Sequence[Camera], background: Color) -> Scene:
    """Return a scene whose photographs are pictures of a model over a background (host)."""
    drawn = (np.rint(255 * image).astype(np.uint8) for image in pictures(model, cameras, background))
    views = tuple(View(str(index), *pair) for index, pair in enumerate(zip(cameras, drawn, strict=True)))
    points = np.asarray(model.gaussians.means, np.float32)
    world = Similarity(1.0, np.eye(3), np.zeros(3)) if model.origin is None else model.origin.transform
    centers = camera_centers(matrices_of(without_outlying(cameras)))
    # Cameras in one place have no extent: the distance of the points is used instead.
    scale = scene_scale(centers) or float(np.median(np.linalg.norm(points - centers[0], axis=1)))
    return Scene("drawn", views, (), points, np.zeros_like(points), world, scale)


def pictures(model: Model, cameras: Sequence[Camera], background: Color | None = None) -> Iterator[np.ndarray]:
    """Yield the pictures [H, W, 3] of a model over its own background or another, clipped to [0, 1] (host)."""
    renderer = Renderer(model, cameras=cameras, background=background, has_geometry=False)
    for camera in cameras:
        yield np.clip(np.asarray(renderer(camera).color), 0, 1)


def likeness(images: Iterable[np.ndarray], wanted: Iterable[np.ndarray]) -> float:
    """Return the PSNR in dB between pictures, from the mean of their squared errors; at most 100."""
    error = np.mean([np.mean((x - y) ** 2) for x, y in zip(images, wanted, strict=True)])
    return -10 * math.log10(max(float(error), 1e-10))
