"""Mesh extraction from a model: depths of views, their fusion, marching cubes, and cleaning (host)."""

import dataclasses
import time
from collections.abc import Iterator, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from a2tg_jax import Camera, Model, Renderer, RenderSettings, back_project
from a2tg_jax.base.named_fields import NamedFields
from a2tg_jax.base.text import counted
from a2tg_jax.core.cameras import checked_cameras
from a2tg_jax.data.capture_geometry import camera_centers, outlying_cameras, subject_of
from a2tg_jax.host.optional import optional
from a2tg_jax.host.progress_bars import progress_over
from a2tg_jax.mesh.fusion import (
    NOTHING,
    SIDE,
    TRUNCATION,
    VOXELS,
    BlockGrid,
    GridFullError,
    RenderedDepth,
    Space,
    fill,
    fuse,
    rendered_depth,
)
from a2tg_jax.mesh.triangles import Mesh, largest_clusters
from a2tg_jax.model import check_is_model

MARCHING_CUBES = "skimage.measure", "a mesh needs scikit-image", "train"
RESOLUTION = 512
"""Largest default number of voxels along the radius."""
GRID_BYTES = 4 * 10**9
"""Default memory budget of the voxels."""
LARGEST_VOXEL = 0.125
"""Largest voxel, in radii."""
MOST_LEVELS = 4
"""Largest number of grids, each with voxels twice as large, from which unknown voxels of the finer ones are filled."""
LONGEST_TRUNCATION = 0.25
"""Largest truncation of a coarser grid, in radii: longer ones would mix both sides of the subject."""
RADII = 2.0
"""Default radius, in median distances of the cameras from the centre."""
ONE_PLACE = 1e-6
"""Largest radius, relative to the distance from the origin, of cameras that are in one place, up to float32."""
LEAST_WEIGHT = 0.05
LEAST_TO_FILL = 0.3
"""Larger voxels up to this weight do not fill smaller ones: their surface would be less accurate than none."""
MOST_CLUSTERS = 50
"""Default number of connected parts to keep, as in 2DGS."""
LEAST_FACES = 50
"""Default number of faces of the smallest of them, as in 2DGS."""
BRICK = 16
"""Blocks along a side of a brick; marching cubes run brick by brick."""
MOST_SAMPLED = 100_000
"""About how many pixels of all views are checked for a missing surface."""
SAME = 1e-3
"""Largest distance in voxels between two bricks' copies of a shared vertex."""


@dataclasses.dataclass(frozen=True, eq=False)
class MeshResult(NamedFields):
    """A mesh, and figures of its extraction."""

    mesh: Mesh
    """The mesh, in the world of the model."""
    center: np.ndarray
    """[3] centre of the space that was fused."""
    radius: float
    """Radius of that space, in units of the model's world."""
    voxel: float
    """Side of a voxel within the radius."""
    num_views: int
    """Number of views fused."""
    num_dropped: int
    """Number of small connected parts that cleaning removed."""
    missing: float
    """Share of the pixels of the views, of those with a depth within the radius, where the mesh has no surface."""
    missing_near: float
    """The same share of those whose depth is within half the radius: by default the cameras' median distance from the
    centre, within which the subject is."""
    num_bytes: int
    """Bytes of the voxel grid."""
    seconds: float
    """Time of the extraction."""


def extract_mesh(
    model: Model,
    cameras: Sequence[Camera] | None = None,
    *,
    resolution: int | None = None,
    voxel: float | None = None,
    center: np.ndarray | None = None,
    radius: float | None = None,
    unbounded: bool = False,
    fill_holes: bool = True,
    least_weight: float = LEAST_WEIGHT,
    most_clusters: int = MOST_CLUSTERS,
    least_faces: int = LEAST_FACES,
    max_bytes: int = GRID_BYTES,
    settings: RenderSettings = RenderSettings(),  # noqa: B008 - frozen
    progress: bool = False,
) -> MeshResult:
    """Return the surface of a model as triangles, by fusion of rendered depths and marching cubes (2DGS).

    The depths of each view are fused into a truncated signed distance function on sparse voxels. A depth is the mean of
    the splats on a ray, with less weight if they are far apart. Where it is too uncertain for these voxels, larger ones
    fill the surface (`fill_holes`). Small connected parts are removed.

    Args:
      model: a model of any appearance.
      cameras: the views to fuse, as pinholes: rays of a lens have no effect. None takes the model's training views.
      resolution: number of voxels along the radius; None: 512, but no voxel smaller than a pixel at the centre.
      voxel: side of a voxel in units of the model's world, instead of the resolution.
      center: [3] centre of the space to fuse, in the model's world; None is the point nearest to all optical axes.
      radius: radius of that space; None is twice the cameras' median distance from the centre.
      unbounded: extend the space beyond the radius, with voxels that grow in proportion to their distance.
      fill_holes: fill the surface by larger voxels where depths are too uncertain; False: leave holes, for surfaces
        that are a little more accurate.
      least_weight: voxels up to this weight have no surface. One view with a sharp depth has a weight of 1.
      most_clusters: largest number of connected parts to keep.
      least_faces: smallest number of triangles in a part.
      max_bytes: memory budget of the voxels. Extraction also needs memory for one view and for the mesh.
      settings: static options of the renderer.
      progress: show a progress bar.

    Returns:
      The mesh in the world of the model, with vertex colours, and figures of the extraction.

    Raises:
      ValueError: if the model is empty or has no cameras, if an argument is out of its range, if the voxels need more
        memory than `max_bytes`, if there is no surface within the radius, or if scikit-image is not installed.

    Examples:
      >>> cameras = [view.camera for view in scene.train]
      >>> result = a2tg.extract_mesh(model, cameras, resolution=24, least_faces=1)
      >>> [path.name for path in a2tg.save_mesh("scene.glb", result.mesh)]
      ['scene.glb']
    """
    start = time.perf_counter()
    check_is_model(model)
    if cameras is None:
        cameras = [] if model.origin is None else model.origin.training_cameras
    # Any pinhole camera will do, since depths are rendered: rays of a lens are left out.
    cameras = [dataclasses.replace(camera, rays=None) for camera in checked_cameras(cameras)]
    if not model.num or not cameras:
        what = "the model has no Gaussians" if not model.num else "there are no cameras"
        raise ValueError(f"a mesh needs views of some Gaussians; {what}")
    check_lengths(resolution, voxel, radius)
    optional(*MARCHING_CUBES)  # It is used only after the views are fused, which takes minutes.
    if not 0 < max_bytes < np.inf:
        raise ValueError(f"max_bytes must be positive and finite; got {max_bytes}")
    if most_clusters < 1:
        raise ValueError(f"most_clusters must be at least 1; got {most_clusters}")
    renderer = Renderer(model, cameras=cameras, settings=settings)
    depths_of = jax.jit(rendered_depth)
    common_center, common_radius = common_sphere([camera.viewmat for camera in cameras], center)
    if common_radius <= ONE_PLACE * np.linalg.norm(common_center):  # The centre is at the median depth of the first.
        depth = np.asarray(depths_of(renderer(cameras[0]), cameras[0]).depth)
        has_depth = (depth > 0) & (depth < NOTHING)
        middle = float(np.median(depth[has_depth])) if has_depth.any() else 1.0
        common_center = common_center + middle * np.asarray(cameras[0].viewmat, float)[2, :3]
        common_radius = RADII * middle
    center = common_center if center is None else np.asarray(center, np.float64)
    if radius is None:
        radius = common_radius
    if resolution is not None:
        voxel = radius / resolution
    elif voxel is None:
        # Voxels smaller than pixels hold no more detail, and have holes.
        voxel = min(max(radius / RESOLUTION, _pixel_at(center, cameras)), LARGEST_VOXEL * radius)
    if voxel > LARGEST_VOXEL * radius:
        raise ValueError(
            f"a voxel is {voxel / radius:.2g} of the radius, which is too large to show a surface: raise `resolution`, "
            f"lower `voxel` to {LARGEST_VOXEL:g} of the radius at most, or raise `radius`"
        )
    sides = voxels_of_levels(voxel, radius) if fill_holes else [voxel]
    spaces = [Space.of(center, radius, side, unbounded) for side in sides]
    # A level takes at most a third of the bytes that the one before takes.
    shares = 1 / 3.0 ** np.arange(len(sides))
    grids = [BlockGrid(int(share * max_bytes)) for share in shares / shares.sum()]
    seen: list[np.ndarray] = []
    try:
        for camera in progress_over(cameras, "fusing", "view", is_shown=progress):
            depths = depths_of(renderer(camera), camera)
            for grid, space in zip(grids, spaces, strict=True):
                fuse(grid, depths, space)
            seen.append(_sampled(depths, spaces[0], MOST_SAMPLED // len(cameras)))
        least_of_coarse = max(least_weight, LEAST_TO_FILL)
        for level in reversed(range(len(grids) - 1)):
            least = least_of_coarse if level else least_weight
            fill(grids[level], grids[level + 1], least, least_of_coarse)
    except GridFullError:
        raise GridFullError(
            f"a resolution of {radius / voxel:.0f} voxels along the radius takes more than {max_bytes / 1e9:.3g} GB: "
            "lower `resolution` or `radius`, or raise `max_memory` (max_bytes in Python)"
        ) from None
    num_bytes = sum(grid.num_bytes for grid in grids)
    surface = surface_of(grids[0], spaces[0], least_weight)
    mesh, num_dropped = largest_clusters(surface, most_clusters, least_faces)
    if not mesh.num_faces:
        if num_dropped:
            raise ValueError(
                f"there are only small parts of a surface; {counted(num_dropped, 'part')} had fewer than {least_faces} "
                "faces: raise `resolution`, lower `voxel` (in Python also least_faces), or train from more views"
            )
        raise ValueError(
            "there is no surface within the radius around the point that the cameras look at: give a larger `radius`, "
            "or `unbounded`"
        )
    points = np.concatenate(seen)
    distances, _ = cKDTree(mesh.vertices).query(points)
    is_missing = distances > TRUNCATION * voxel
    is_near = np.linalg.norm(points - center, axis=1) < radius / RADII
    missing, near = (float(np.mean(some)) if len(some) else 0.0 for some in (is_missing, is_missing[is_near]))
    seconds = time.perf_counter() - start
    return MeshResult(mesh, center, radius, voxel, len(cameras), num_dropped, missing, near, num_bytes, seconds)


def voxels_of_levels(voxel: float, radius: float) -> list[float]:
    """Return the sides of voxels of all levels, the smallest first."""
    sides = [voxel]
    while len(sides) < MOST_LEVELS and 2 * TRUNCATION * sides[-1] <= LONGEST_TRUNCATION * radius:
        sides.append(2 * sides[-1])
    return sides


def _pixel_at(center: np.ndarray, cameras: Sequence[Camera]) -> float:
    """Return the median size of a pixel of the cameras at a point [3], in units of the world."""
    sizes = []
    for camera in cameras:
        distance = np.linalg.norm(np.asarray(camera.center, np.float64) - center)
        sizes.append(distance / float(camera.K[0, 0]))
    return float(np.median(sizes))


def _sampled(depths: RenderedDepth, space: Space, num: int) -> np.ndarray:
    """Return about `num` points [P, 3] of a view with a depth within the space."""
    points = np.asarray(back_project(depths.depth, depths.camera)).reshape(-1, 3)
    chosen = np.arange(0, len(points), max(1, len(points) // max(num, 1)))
    has_depth = np.asarray(depths.depth).reshape(-1)[chosen] > 0
    return points[chosen][has_depth & np.asarray(space.contains(jnp.asarray(points[chosen])))]


def check_lengths(resolution: int | None, voxel: float | None, radius: float | None) -> None:
    """Raise ValueError unless the lengths are positive, and at most one gives the voxel size."""
    if resolution is not None and voxel is not None:
        raise ValueError("`resolution` and `voxel` both set the size of voxels: leave one out")
    if resolution is not None and not 1 <= resolution <= 100_000:
        raise ValueError(f"resolution must be in 1..100000 voxels along the radius; got {resolution}")
    for name, value in (("voxel", voxel), ("radius", radius)):
        if value is not None and not 0 < value < np.inf:
            raise ValueError(f"{name} must be positive and finite; got {value}")


def common_sphere(viewmats: ArrayLike, center: ArrayLike | None = None) -> tuple[np.ndarray, float]:
    """Return centre [3] and radius of the sphere that cameras [V, 4, 4] look at.

    The centre is the point nearest to all optical axes unless it is given, the radius twice the median distance of the
    cameras from it. Cameras far from all others do not count.
    """
    matrices = np.asarray(viewmats, np.float64)
    matrices = matrices[~outlying_cameras(matrices)]
    centers = camera_centers(matrices)
    if center is None:
        center = subject_of(matrices)
    center = np.asarray(center, np.float64)
    return center, float(RADII * np.median(np.linalg.norm(centers - center, axis=1)))


# Marching cubes over sparse voxels


def surface_of(grid: BlockGrid, space: Space, least_weight: float = 0.0) -> Mesh:
    """Return the surface of fused views where the mean signed distance is zero, with colours. Voxels up to the least
    weight are unknown, and their cells have no surface."""
    parts = list(_parts(grid, least_weight))
    if not parts:
        return Mesh(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32), np.zeros((0, 3), np.uint8))
    of_vertices, of_faces, of_colors = zip(*parts, strict=True)
    # Faces of a brick count its own vertices from 0.
    ends = np.cumsum([len(vertices) for vertices in of_vertices])
    starts = [0, *ends[:-1]]
    faces = np.concatenate([faces + start for faces, start in zip(of_faces, starts, strict=True)])
    vertices = np.concatenate(of_vertices)
    colors = np.concatenate(of_colors)
    # Vertices shared by two bricks are merged, and faces that collapse are dropped.
    side = BRICK * SIDE
    # Only vertices on the faces of bricks can be shared: the tree stays small.
    on_border = np.flatnonzero((np.abs(vertices - side * np.rint(vertices / side)) < SAME).any(axis=1))
    pairs = on_border[cKDTree(vertices[on_border]).query_pairs(SAME, output_type="ndarray")] if len(on_border) else []
    if len(pairs):
        graph = coo_matrix((np.ones(len(pairs), bool), tuple(np.transpose(pairs))), [len(vertices)] * 2)
        _, labels = connected_components(graph, directed=False)
        # Labels are 0 to n − 1, so that they are the new indices.
        _, first = np.unique(labels, return_index=True)
        a, b, c = labels[faces].T
        vertices = vertices[first]
        colors = colors[first]
        faces = labels[faces][(a != b) & (b != c) & (a != c)]
    positions = np.asarray(space.positions(jnp.asarray(vertices, jnp.float32)))
    return Mesh(positions, faces.astype(np.int32), colors)


def _parts(grid: BlockGrid, least_weight: float) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Yield vertices in voxels, faces and colours of each brick that has a surface."""
    marching_cubes = optional(*MARCHING_CUBES).marching_cubes
    # The last cells of a brick need the first voxels of the next ones.
    blocks = np.stack(np.meshgrid(*[np.arange(BRICK + 1)] * 3, indexing="ij"), -1).reshape(-1, 3)
    for brick in np.unique(grid.coordinates // BRICK, axis=0):
        rows = grid.find(brick * BRICK + blocks)
        places = np.flatnonzero(rows >= 0)
        rows = rows[places]
        weight = grid.weight[rows]
        known = weight > least_weight
        # 1, a truncation in front of any surface, where nothing is known.
        mean = np.where(known, grid.distance[rows] / np.where(known, weight, 1.0), 1.0)
        distance = _dense(mean.astype(np.float32), places, 1.0)
        is_known = _dense(known, places, False)
        for axis in range(3):  # A cell is known if its eight corners are; the mask has it at its last corner.
            is_known &= np.roll(is_known, 1, axis)
            is_known[(slice(None),) * axis + (0,)] = False
        # scikit-image raises if the level is outside of the range.
        if not is_known.any() or not distance.min() < 0 < distance.max():
            continue
        try:
            # descent: distances fall towards the inside.
            vertices, faces, _, _ = marching_cubes(distance, 0.0, mask=is_known, gradient_direction="descent")
        except RuntimeError:  # No cell has a surface.
            continue
        color = np.rint(255 * np.clip(grid.color[rows].astype(np.float32), 0, 1)).astype(np.uint8)
        nearest = tuple(np.rint(vertices).astype(int).T)
        # float64: indices of far bricks leave float32 too few digits to match borders.
        yield vertices.astype(np.float64) + brick * (BRICK * SIDE), faces, _dense(color, places, 0)[nearest]


def _dense(values: np.ndarray, places: np.ndarray, empty: float) -> np.ndarray:
    """Return blocks of values [B, VOXELS, ...] as one array of a brick's voxels and the first ones of the next."""
    num = BRICK + 1
    channels = values.shape[2:]
    whole = np.full((num**3, VOXELS, *channels), empty, values.dtype)
    whole[places] = values
    whole = whole.reshape(num, num, num, SIDE, SIDE, SIDE, *channels)
    # [bx, by, bz, x, y, z] → [bx, x, by, y, bz, z]: blocks become neighbours.
    whole = whole.transpose(0, 3, 1, 4, 2, 5, *range(6, whole.ndim)).reshape(*[num * SIDE] * 3, *channels)
    end = BRICK * SIDE + 1
    return whole[:end, :end, :end]
