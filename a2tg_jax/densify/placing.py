"""New Gaussians where pictures are wrong, on the surface that is rendered there.

Splitting and MCMC make new Gaussians of old ones, close to these. Here pixels of training views are drawn in proportion
to their error, and each gets a Gaussian: at the rendered depth, in the plane of the rendered surface, with a standard
deviation of one pixel, and of its colour in the photograph. After ConeGS (Baranowski et al., 2025), where depths come
from another model.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import ArrayLike

from a2tg_jax.appearance import allocate_appearance
from a2tg_jax.base.checks import check_fields
from a2tg_jax.base.even_spacing import evenly_chosen
from a2tg_jax.core.cameras import back_project
from a2tg_jax.core.gaussians import Gaussians, no_rows, sh_of_colors
from a2tg_jax.core.optim import AdamState
from a2tg_jax.core.origin import Color
from a2tg_jax.core.pytree import pytree, static
from a2tg_jax.core.table import is_table, map_rows
from a2tg_jax.events import Change, Due, FractionsEvent, clear_moments
from a2tg_jax.model import Model
from a2tg_jax.rasterize.render_types import RenderOutput
from a2tg_jax.render import jitted_render
from a2tg_jax.scene import View, counted_pixels, view_image

# Chosen in experiments/NOTEBOOK.md, "New Gaussians where pictures are wrong".
MOST_VIEWS = 48
"""Largest number of training views in which errors are measured, evenly chosen and the same each time."""
OPACITY = 0.3
"""Opacity of new Gaussians."""
LEAST_ALPHA = 0.5
"""Least alpha of a pixel that can get a Gaussian; with less, its depth is not of a surface."""


@pytree
class PlaceByError(FractionsEvent):
    """Event that adds Gaussians on the rendered surface, at pixels drawn in proportion to their error.

    After ConeGS (Baranowski et al., 2025). Errors are measured in up to 48 views over the background of training (black
    where that is random), with the cameras of the scene, not refined ones, and without exposures.

    Examples:
      >>> a2tg.PlaceByError(share=0.1, at=(0.25, 0.5)).times(1000)
      (250, 500)
    """

    share: float = 0.1
    """Number of Gaussians to add each time, as a share of those that exist; 0: none."""
    at: tuple[float, ...] = static(default=(0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8))
    """Fractions of the stage at which Gaussians are added."""
    cap: int = static(default=500_000)
    """Largest number of Gaussians, at most the rows that densification has allocated."""

    def check_options(self) -> None:
        super().check_options()
        check_fields(self, "share", least=0, most=1)
        check_fields(self, "cap", least=2)

    def apply(self, due: Due, model: Model, moments: AdamState, state: object) -> Change:
        if any(map(is_table, jax.tree.leaves(model.appearance, is_leaf=is_table))):
            raise ValueError("share must be 0 in a stage whose Gaussians have textures or differ in degree")
        num = model.num
        num_added = round(num * float(self.share))
        room = min(self.cap, model.num_rows) - num
        if not num_added:
            return Change(model, moments, state, unused=f"share of {num:,} Gaussians is less than one: raise it")
        if room <= 0:
            reason = "share adds no Gaussian, because there are as many as the cap allows; prune some before"
            return Change(model, moments, state, unused=reason)
        added = gaussians_at_errors(model, due, min(num_added, room))
        if not added.num:
            reason = "share adds no Gaussian, because views are right wherever a surface is drawn and masks count"
            return Change(model, moments, state, unused=reason)
        key = jax.random.fold_in(jax.random.key(due.seed), due.index)
        appearance = allocate_appearance(model.appearance.template, key, added)
        rows = np.arange(num, num + added.num)

        def replaced(old: Array, new: ArrayLike) -> Array:
            changed = np.array(old)
            changed[rows] = new
            return jax.device_put(changed)

        present = model.gaussians, model.appearance
        gaussians, appearance = map_rows(replaced, replaced, present, (added, appearance))
        is_new = np.isin(np.arange(model.num_rows), rows)
        moments = jax.jit(clear_moments)(model, moments, is_new)
        num_live = jax.device_put(np.asarray(num + added.num, np.int32))
        model = dataclasses.replace(model, gaussians=gaussians, appearance=appearance, num_live=num_live)
        return Change(model, moments, state)


def gaussians_at_errors(model: Model, due: Due, num: int) -> Gaussians:
    """Return `num` Gaussians at pixels of some views, drawn in proportion to the mean difference of their colours
    (host). Pixels that masks exclude, or that show no surface, are left out. If no pixel is wrong there are none.

    Raises:
      ValueError: if there are no views.
    """
    from scipy.spatial.transform import Rotation  # Not at import of the package, which would take 0.2 s longer.

    views = evenly_chosen(due.views, MOST_VIEWS)
    settings = due.render_settings(model, views)
    rng = np.random.default_rng((due.seed, due.index))
    dtype = model.gaussians.means.dtype
    behind = jnp.asarray(due.background, dtype)
    totals = []
    drawn = []
    for view in views:
        camera = jax.tree.map(lambda leaf: jnp.asarray(leaf, dtype), view.camera)
        output, _ = jitted_render()(
            model.gaussians, camera, model.appearance, behind, settings, num_live=model.num_live
        )
        total, pixels = _drawn_pixels(view, due.background, jax.tree.map(np.asarray, output), num, rng)
        totals.append(total)
        drawn.append(pixels)
    if not sum(totals):
        return no_rows(0, model.gaussians.sh.shape[1], dtype)
    view_of = rng.choice(len(totals), num, p=np.asarray(totals) / sum(totals))
    # Each Gaussian takes a pixel of a view that is drawn by its share of the error; every view has drawn `num` pixels.
    chosen = [np.stack(column)[view_of, np.arange(num)] for column in zip(*drawn, strict=True)]
    points, normals, colors, sizes = chosen
    arrays = (
        points,
        Rotation.from_matrix(_axes(normals, rng)).as_quat(scalar_first=True),
        np.log(sizes)[:, None].repeat(2, axis=1),
        np.full(num, np.log(OPACITY / (1 - OPACITY))),
        sh_of_colors(colors, model.gaussians.sh_degree),
    )
    return Gaussians(*jax.device_put([array.astype(dtype) for array in arrays]))


def _drawn_pixels(
    view: View, background: Color, output: RenderOutput, num: int, rng: np.random.Generator
) -> tuple[float, tuple[np.ndarray, ...]]:
    """Return the sum of the errors of a view, and of `num` pixels that are drawn in proportion to them: points [P, 3],
    normals [P, 3], colours [P, 3] and widths [P]."""
    photograph = view_image(view, background)
    is_usable = counted_pixels([view])[0, ..., 0] & (output.alpha >= LEAST_ALPHA)
    is_usable &= np.isfinite(output.color).all(axis=2)  # Training reports NaN itself.
    if view.camera.rays is not None:
        is_usable &= np.isfinite(np.asarray(view.camera.rays)).all(axis=2)
    errors = np.where(is_usable, np.abs(output.color - photograph).mean(axis=2), 0).astype(np.float64)
    sums = np.cumsum(errors)
    pixels = np.searchsorted(sums, rng.random(num) * sums[-1], side="right").clip(0, errors.size - 1)
    depth = output.depth / np.maximum(output.alpha, LEAST_ALPHA)
    points = np.asarray(jax.jit(back_project)(depth, view.camera)).reshape(-1, 3)[pixels]
    K = np.asarray(view.camera.K, np.float64)
    sizes = np.asarray(depth, np.float64).ravel()[pixels] / np.sqrt(K[0, 0] * K[1, 1])
    normals = np.asarray(output.normal, np.float64).reshape(-1, 3)[pixels]
    return sums[-1], (points, normals, photograph.reshape(-1, 3)[pixels], sizes)


def _axes(normals: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return rotations [P, 3, 3] whose third axis is along a normal [P, 3], turned at random around it."""
    across = np.cross(normals, rng.normal(size=normals.shape))
    axes = np.stack([across, np.cross(normals, across), normals], axis=-1)
    return np.asarray(axes / np.linalg.norm(axes, axis=1, keepdims=True))
