"""A sky for the start of training: Gaussians on a distant sphere, in directions without points (host).

Each view is divided into cells. A cell is empty if no point of the scene projects near it. A direction belongs to the
sky if at least a quarter of the views that look there see an empty cell.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from scipy.spatial import cKDTree

from a2tg_jax.core.camera_paths import vertical_of
from a2tg_jax.core.cameras import Camera
from a2tg_jax.core.gaussians import Gaussians, sh_of_colors
from a2tg_jax.core.geometry import fibonacci
from a2tg_jax.core.numerics import evenly_chosen
from a2tg_jax.data.scene import Scene, View

DISTANCE = 10.0
"""Radius of the sphere, in distances of the far points from the cameras' mean."""
FAR_SHARE = 0.99
"""Share of the points that are no farther than the far points."""
CELLS = 24
"""Number of cells along the shorter side of a view."""
REACH = 1.5
"""Smallest distance of points from an empty cell, in cells."""
LEAST_SHARE = 0.25
"""Smallest share of the views that look in a direction of the sky and see an empty cell there."""
MOST_POINTS = 50_000
"""Number of points beyond which evenly chosen ones represent all."""
LEAST_EMPTY = 0.01
"""Smallest share of empty cells."""
LOWEST = -0.2
"""Smallest sine of the angle of the sky above the horizon; hills and buildings may end below it."""
NOWHERE = 9.0
"""Coordinate of cells without a ray, far from all unit directions."""
NUMS_TRIED = 20_000, 200_000
"""Number of directions all around that find the sky; the second if too few of the first are in it."""
LEAST_FOUND = 5
"""Smallest number of these that must be in the sky."""
NEAR = 3.0
"""Largest distance of a direction of the sky from one of those found, in spacings of these."""
MOST_TRIED = 2_000_000
"""Largest number of directions all around, of which those in the sky are taken."""
MORE = 1.02
"""Factor by which more directions are tried than are likely to be enough."""


class Cells(NamedTuple):
    """C cells of one view."""

    center: np.ndarray
    """[3] position of the camera."""
    rays: np.ndarray
    """[C, 3] unit directions of the cells' centres in the world; `NOWHERE` without a ray."""
    spacing: float
    """Largest distance of neighbours among these."""
    is_bare: np.ndarray
    """[C] whether the cell has a ray, is above the ground, and no point projects near."""
    is_empty: np.ndarray
    """[C] whether it is bare, and all of its pixels count by the view's mask and alpha channel."""


def cells_of(view: View, alpha: np.ndarray | None, points: np.ndarray, up: np.ndarray) -> Cells:
    """Return the cells of a view, given its alpha channel [H, W], if any, the scene's points, and the vertical."""
    camera = view.camera
    rays, spacing = cell_rays(camera)
    counts = np.ones(view.picture.size, bool) if view.mask is None else view.mask.read()
    counts = counts if alpha is None else counts & (alpha == 255)
    bare = is_bare(camera, (rays, spacing), points, up)
    is_whole = _cell_means(counts[..., None], camera)[:, 0] == 1
    return Cells(np.asarray(camera.center, np.float64), rays, spacing, bare, bare & is_whole)


def sky_of(scene: Scene, num: int, *, opacity: float, sh_degree: int) -> Gaussians:
    """Return Gaussians of the sky, evenly spread over the directions that training views see without points.

    They face the cameras' mean, are as wide as their spacing, and have the mean colour of the photographs there.

    Args:
      scene: its training photographs are each read once.
      num: number of Gaussians.
      opacity: of each.
      sh_degree: highest degree of spherical harmonics, 0 to 3; those above 0 are 0.

    Raises:
      ValueError: if no training view sees a sky.
    """
    up, cells, colors_of_cells = _up_of(scene), [], []
    for view in scene.train:
        pixels = view.picture.read()
        cells.append(cells_of(view, pixels[..., 3] if view.has_alpha else None, scene.points, up))
        colors_of_cells.append(_cell_means(pixels[..., :3], view.camera) / 255)
    check_shares(cells, num)
    trees = [cKDTree(view.rays) for view in cells]

    def votes(positions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        # Whether positions [M, 3] are sky, and the mean colours [M, 3] of the empty cells that they are seen in.
        num_looking, num_empty = np.zeros((2, len(positions)))
        sums = np.zeros((len(positions), 3))
        for view, tree, colors in zip(cells, trees, colors_of_cells, strict=True):
            reach = REACH / 2 * view.spacing
            distances, at = tree.query(_units(positions - view.center), distance_upper_bound=reach)
            # Beyond the reach, distances of `query` are infinite.
            rows = np.flatnonzero(np.isfinite(distances))
            num_looking[rows] += 1
            rows = rows[view.is_empty[at[rows]]]
            num_empty[rows] += 1
            sums[rows] += colors[at[rows]]
        is_sky = (num_empty > 0) & (num_empty >= LEAST_SHARE * num_looking)
        return is_sky, sums / np.maximum(num_empty, 1)[:, None]

    center, radius = sphere(scene)
    directions, spacing = even_directions(num, lambda directions: votes(center + radius * directions)[0])
    means = center + radius * directions
    facing = directions * np.where(directions[:, 2:] < 0, -1, 1)  # Splats have two sides.
    x, y, z = facing.T
    # The shortest turn from +z to f, (1 + z, ẑ × f); z >= 0 keeps it away from 0.
    quats = np.stack([1 + z, -y, x, np.zeros(num)], axis=1)
    return Gaussians(
        means=jnp.asarray(means, jnp.float32),
        quats=jnp.asarray(quats / np.linalg.norm(quats, axis=1, keepdims=True), jnp.float32),
        log_scales=jnp.full((num, 2), np.log(radius * spacing), jnp.float32),
        logit_opacities=jnp.full(num, np.log(opacity / (1 - opacity)), jnp.float32),
        sh=jnp.asarray(sh_of_colors(votes(means)[1], sh_degree), jnp.float32),
    )


def check_sky(scene: Scene, num: int) -> None:
    """Raise ValueError if the training views show no sky, or masks or alpha channels leave it out. Of the photographs,
    those with an alpha channel are read."""
    up = _up_of(scene)
    check_shares([cells_of(view, view.alpha, scene.points, up) for view in scene.train], num)


def check_shares(views: Sequence[Cells], num: int) -> None:
    """Raise ValueError unless enough cells of the views are empty for `num` Gaussians."""
    num_cells = sum(has_ray(view.rays).sum() for view in views)
    bare = sum(view.is_bare.sum() for view in views) / num_cells
    empty = sum(view.is_empty.sum() for view in views) / num_cells
    if bare < LEAST_EMPTY:
        raise ValueError(
            f"sky_gaussians is {num:,}, but the training views show no sky: {bare:.1%} of them is above the horizon "
            f"and without points, less than {LEAST_EMPTY:.0%}: leave out sky_gaussians"
        )
    if empty < LEAST_EMPTY:
        raise ValueError(
            f"sky_gaussians is {num:,}, but masks or alpha channels leave the sky out: {bare:.1%} of the training "
            f"views is above the horizon and without points, and {empty:.1%} counts: leave out sky_gaussians, or take "
            "masks that keep the sky"
        )


def _up_of(scene: Scene) -> np.ndarray:
    """Return the vertical [3] of the training cameras."""
    return vertical_of(np.stack([np.asarray(view.camera.viewmat, np.float64) for view in scene.train]))


def sphere(scene: Scene) -> tuple[np.ndarray, float]:
    """Return the centre [3] and the radius of the sphere, in the normalised world."""
    center = np.mean([np.asarray(view.camera.center, np.float64) for view in scene.train], axis=0)
    distances = np.linalg.norm(scene.points - center, axis=1)
    return center, DISTANCE * float(np.quantile(distances, FAR_SHARE))


def is_bare(camera: Camera, cells: tuple[np.ndarray, float], points: np.ndarray, up: np.ndarray) -> np.ndarray:
    """Return [C] whether a cell of a view has a ray, is above the ground, and no point [P, 3] projects near it; given
    the view's `cell_rays` and vertical [3]."""
    rays, spacing = cells
    towards = _units(evenly_chosen(points, MOST_POINTS) - np.asarray(camera.center, np.float64))
    is_far = cKDTree(towards).query(rays)[0] > REACH * spacing
    return has_ray(rays) & is_far & (rays @ up > LOWEST)


def has_ray(rays: np.ndarray) -> np.ndarray:
    """Return [C] whether `cell_rays` [C, 3] are directions."""
    return np.any(rays != NOWHERE, axis=1)


def cell_rays(camera: Camera) -> tuple[np.ndarray, float]:
    """Return unit directions [C, 3] of the cells' centres in the world, and the largest distance of neighbours.

    Cells of a lens that is no pinhole, whose centres have no ray, are `NOWHERE`.
    """
    step = _cell_side(camera)
    rows, columns = (step * np.arange(side // step) + step // 2 for side in (camera.height, camera.width))
    if camera.rays is None:
        x, y = np.meshgrid(columns + 0.5, rows + 0.5)
    else:
        x, y = np.moveaxis(np.asarray(camera.rays, np.float64)[np.ix_(rows, columns)], -1, 0)
    pixels = np.stack([x, y, np.ones_like(x)], axis=-1)
    # Rays are rows here: K⁻¹·p and Rcᵀ·r, transposed.
    to_world = np.linalg.inv(np.asarray(camera.K, np.float64)).T @ np.asarray(camera.viewmat, np.float64)[:3, :3]
    rays = _units(pixels @ to_world)
    gaps = [np.linalg.norm(np.diff(rays, axis=axis), axis=-1).ravel() for axis in (0, 1)]
    spacing = float(np.max(np.concatenate(gaps), initial=0.0, where=np.isfinite(np.concatenate(gaps))))
    return np.where(np.isfinite(rays), rays, NOWHERE).reshape(-1, 3), spacing


def _cell_side(camera: Camera) -> int:
    """Return the side of a cell in pixels."""
    return max(1, min(camera.height, camera.width) // CELLS)


def _cell_means(image: np.ndarray, camera: Camera) -> np.ndarray:
    """Return the mean [C, channels] of an image [H, W, channels] over each cell."""
    step = _cell_side(camera)
    rows, columns = camera.height // step, camera.width // step
    blocks = image[: rows * step, : columns * step].reshape(rows, step, columns, step, -1)
    return blocks.mean(axis=(1, 3)).reshape(rows * columns, -1)


def _units(vectors: np.ndarray) -> np.ndarray:
    """Return vectors [..., 3] of length 1; 0 of 0."""
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-30)


def even_directions(num: int, is_sky: Callable[[np.ndarray], np.ndarray]) -> tuple[np.ndarray, float]:
    """Return evenly spread unit directions [num, 3] that are sky, and the angle between neighbours.

    `is_sky` returns [M] bool for directions [M, 3]. It is called for `NUMS_TRIED` directions and those near the sky.

    Raises:
      ValueError: if there is nearly no sky, or it is too small for that many.
    """
    for tried in NUMS_TRIED:
        coarse = fibonacci(tried)
        coarse = coarse[is_sky(coarse)]
        if len(coarse) >= LEAST_FOUND:
            break
    else:
        raise ValueError(
            "sky_gaussians: too few training views see the same part of a sky, or it is tiny: leave out sky_gaussians"
        )
    near, share = cKDTree(coarse), len(coarse) / tried
    reach, found = NEAR * _spacing(tried), np.zeros((0, 3))
    while len(found) < num:
        total = int(MORE * num / share) + 1
        if total > MOST_TRIED:
            raise ValueError(
                f"sky_gaussians is {num:,}, but the sky that training views share is small, with room for about "
                f"{int(share * MOST_TRIED / MORE):,}: lower sky_gaussians"
            )
        found = fibonacci(total)
        found = found[np.isfinite(near.query(found, distance_upper_bound=reach)[0])]
        found = found[is_sky(found)]
        # Falls in each round, so that the loop ends.
        share = min(max(len(found), 1) / total, share / MORE)
    # Directions that are left out make room for wider gaps.
    return evenly_chosen(found, num), _spacing(total) * float(np.sqrt(len(found) / num))


def _spacing(num: int) -> float:
    """Return the angle between neighbours of `num` directions all around."""
    return float(np.sqrt(4 * np.pi / num))
