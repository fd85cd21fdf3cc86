"""Extraction of a mesh from a model: depths of views, their fusion, marching cubes, and cleaning (host)."""

import dataclasses
import functools
import time
from collections.abc import Callable, Sequence

import jax
import numpy as np

from a2tg_jax.core.cameras import Camera
from a2tg_jax.host.progress_bars import progress_over
from a2tg_jax.host.text import counted
from a2tg_jax.mesh.blocks import BlockGrid, GridFullError
from a2tg_jax.mesh.depth_maps import RenderedDepth, rendered_depth
from a2tg_jax.mesh.fusion import fuse
from a2tg_jax.mesh.marching import surface_of
from a2tg_jax.mesh.space import RADII, Space, common_sphere
from a2tg_jax.mesh.triangles import Mesh, largest_clusters
from a2tg_jax.model import Model, check_is_model
from a2tg_jax.rasterize.render_types import RenderSettings
from a2tg_jax.renderer import Renderer

RESOLUTION = 512
"""Default number of voxels along the radius."""
GRID_BYTES = 4 * 10**9
"""Default memory budget of the voxels."""
LEAST_WEIGHT = 0.05
MOST_CLUSTERS, LEAST_FACES = 50, 50
"""Default of the connected parts that are kept, as in 2DGS."""


class NoSurfaceError(ValueError):
    """The views have no surface within the space, or all its parts are small."""

    def __init__(self, radius: float, num_dropped: int, least_faces: int):
        """Keep the radius in units of the model's world, and how many parts had fewer than the least faces."""
        self.radius, self.num_dropped, self.least_faces = radius, num_dropped, least_faces
        what, advice = self.told(), "give a larger radius, or unbounded"
        if num_dropped:
            advice = "raise the resolution, or lower least_faces"
        super().__init__(f"{what}: {advice}")

    def told(self, scale: float = 1.0) -> str:
        """Return what happened, with lengths divided by `scale`."""
        if self.num_dropped:
            parts = counted(self.num_dropped, "part")
            return f"there are only small parts of a surface; {parts} had fewer than {self.least_faces} faces"
        return f"there is no surface within {self.radius / scale:.3g} units of the point that the cameras look at"


@dataclasses.dataclass(frozen=True, eq=False)
class MeshResult:
    """A mesh, and how it was made."""

    mesh: Mesh
    """The mesh, in the world of the model."""
    center: np.ndarray
    """[3] centre of the space that was fused."""
    radius: float
    """Its radius, in units of the model's world."""
    voxel: float
    """Side of a voxel within the radius."""
    num_views: int
    """Number of views fused."""
    num_dropped: int
    """Number of small connected parts that cleaning removed."""
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
    least_weight: float = LEAST_WEIGHT,
    most_clusters: int = MOST_CLUSTERS,
    least_faces: int = LEAST_FACES,
    max_bytes: int = GRID_BYTES,
    settings: RenderSettings = RenderSettings(),  # noqa: B008 - frozen
    progress: bool = False,
) -> MeshResult:
    """Return the surface of a model as triangles, by fusion of rendered depths and marching cubes (2DGS).

    Each view is rendered, and its depths are fused into a truncated signed distance function on sparse voxels. A depth
    is the mean of the splats that a ray meets. It counts less where they lie apart, in inverse proportion to its
    variance. Small connected parts are removed.

        result = a2tg.extract_mesh(model, resolution=256)
        a2tg.save_mesh("scene.glb", result.mesh, model.origin.transform)

    Args:
      model: a model of any appearance.
      cameras: the views to fuse; None takes the training views that the model was trained on.
      resolution: number of voxels along the radius, 512 by default.
      voxel: side of a voxel in units of the model's world, in place of the resolution.
      center: [3] centre of the space; None is the point nearest to all optical axes.
      radius: radius of the space in units of the model's world; None is twice the median distance of the cameras from
        the centre.
      unbounded: go on beyond the radius, with voxels that grow in proportion to their distance.
      least_weight: voxels of no larger weight have no surface. One view of a sharp depth has a weight of 1.
      most_clusters: largest number of connected parts to keep.
      least_faces: smallest number of triangles of a part.
      max_bytes: memory budget of the voxels. Beside them, extraction needs memory for one view and for the mesh.
      settings: static options of the renderer.
      progress: show a progress bar.

    Returns:
      The mesh in the world of the model, with colours of its vertices, and figures of the extraction.

    Raises:
      ValueError: if the model is empty or has no cameras, if an argument is out of its range, if the voxels need more
        memory than `max_bytes`, or if there is no surface within the radius.
    """
    start = time.perf_counter()
    check_is_model(model)
    cameras = training_cameras(model) if cameras is None else list(cameras)
    if not model.num or not cameras:
        what = "the model has no Gaussians" if not model.num else "there are no cameras"
        raise ValueError(f"a mesh needs views of some Gaussians; {what}")
    check_lengths(resolution, voxel, radius)
    if not 0 < max_bytes < np.inf:
        raise ValueError(f"max_bytes must be positive and finite; got {max_bytes}")
    if most_clusters < 1:
        raise ValueError(f"most_clusters must be at least 1; got {most_clusters}")
    renderer = Renderer(model, cameras=cameras, settings=settings)
    if center is None or radius is None:
        center, radius = _sphere(renderer, cameras, center, radius)
    voxel = radius / (resolution or RESOLUTION) if voxel is None else voxel
    space = Space.of(center, radius, voxel, unbounded)
    grid = _fused(renderer, cameras, space, max_bytes, progress)
    mesh, num_dropped = largest_clusters(surface_of(grid, space, least_weight), most_clusters, least_faces)
    if not mesh.num_faces:
        raise NoSurfaceError(radius, num_dropped, least_faces)
    seconds = time.perf_counter() - start
    return MeshResult(mesh, np.asarray(center), radius, voxel, len(cameras), num_dropped, grid.num_bytes, seconds)


def _fused(renderer: Renderer, cameras: Sequence[Camera], space: Space, max_bytes: int, progress: bool) -> BlockGrid:
    """Return the voxels of all views."""
    grid = BlockGrid(max_bytes)
    for index, camera in enumerate(progress_over(cameras, "fusing", "view", is_shown=progress)):
        try:
            fuse(grid, _depths(renderer, camera), space)
        except GridFullError:
            raise GridFullError(
                f"a resolution of {float(space.radius / space.voxel):.0f} voxels along the radius takes more than "
                f"{max_bytes / 1e9:.3g} GB after {index + 1} of {len(cameras)} views: lower the resolution or the "
                "radius, or raise max_bytes"
            ) from None
    return grid


def training_cameras(model: Model) -> list[Camera]:
    """Return the cameras that the model was trained on."""
    if model.origin is None:
        return []
    pairs = list(zip(model.origin.cameras, model.origin.is_test, strict=True))
    return [camera for camera, is_test in pairs if not is_test] or [camera for camera, _ in pairs]


def check_lengths(resolution: int | None, voxel: float | None, radius: float | None) -> None:
    """Raise ValueError unless numbers of the space are positive, and at most one says their size."""
    if resolution is not None and voxel is not None:
        raise ValueError("resolution and voxel both say the size of voxels; give one of them")
    if resolution is not None and not 1 <= resolution <= 100_000:
        raise ValueError(f"resolution must lie in 1..100000 voxels along the radius; got {resolution}")
    for name, value in (("voxel", voxel), ("radius", radius)):
        if value is not None and not 0 < value < np.inf:
            raise ValueError(f"{name} must be positive and finite; got {value}")


def _depths(renderer: Renderer, camera: Camera) -> RenderedDepth:
    return _jitted_depths()(renderer(camera), camera)


def _sphere(
    renderer: Renderer, cameras: Sequence[Camera], center: np.ndarray | None, radius: float | None
) -> tuple[np.ndarray, float]:
    """Return centre and radius that the cameras tell, where they are not given.

    Cameras at one place look at what lies at the median depth of the first.
    """
    viewmats = np.stack([np.asarray(camera.viewmat, np.float64) for camera in cameras])
    own, reach = common_sphere(viewmats)
    if not reach:
        depth = np.asarray(_depths(renderer, cameras[0]).depth)
        middle = float(np.median(depth[depth > 0])) if (depth > 0).any() else 1.0
        own, reach = own + middle * viewmats[0, 2, :3], RADII * middle
    return (own if center is None else np.asarray(center, np.float64)), reach if radius is None else radius


@functools.cache
def _jitted_depths() -> Callable[..., RenderedDepth]:
    return jax.jit(rendered_depth)
