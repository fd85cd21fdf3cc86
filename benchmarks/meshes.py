"""Time and memory of meshes: splats on the surfaces of the built-in scene, seen by a few large views.

    python -m benchmarks.meshes --resolution 1024
    python -m benchmarks.meshes --texture

Seconds are those of the processor, over all cores; the first view, which compiles, is left out of the medians. What
larger voxels take, which fill holes, `a2tg mesh --no-fill-holes` does not. Textures need
`pip install 'a2tg-jax[mesh]'`.
"""

import argparse
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import a2tg_jax as a2tg
from a2tg_jax.core.cameras import resize_camera
from a2tg_jax.core.similarity import transform_gaussians
from a2tg_jax.data.synthetic import exact_points, still_life
from a2tg_jax.mesh.extract import (
    GRID_BYTES,
    LEAST_TO_FILL,
    LEAST_WEIGHT,
    common_sphere,
    surface_of,
    voxels_of_levels,
)
from a2tg_jax.mesh.fusion import BlockGrid, Space, fill, fuse, rendered_depth
from a2tg_jax.renderer import Renderer
from benchmarks.timing import memory_peak

SMALL = (160, 106)
"""Width and height of the views that place the splats."""
SIDE, LOGIT_OPACITY = 0.006, 2.0
"""Standard deviation of a splat in metres, and its opacity."""
FACES = 100_000
ATLAS = 2048


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--num", type=int, default=500_000, help="number of splats")
    parser.add_argument("--views", type=int, default=5)
    parser.add_argument("--size", type=int, nargs=2, default=(1600, 1060), metavar=("WIDTH", "HEIGHT"))
    parser.add_argument("--resolution", type=int, default=512)
    parser.add_argument("--texture", action="store_true", help="simplify and texture the mesh, too")
    args = parser.parse_args()
    a2tg.configure_cpu()
    model = model_on_surfaces(args.num, args.views, *args.size)
    for name, told in measure(model, args.resolution, args.texture):
        print(f"{name}: {told}", flush=True)


def model_on_surfaces(num: int, num_views: int, width: int, height: int) -> a2tg.Model:
    """Return opaque splats of random colours on the surfaces of the built-in scene, with views of this size."""
    rng = np.random.default_rng(0)
    scene = a2tg.synthetic_scene(num_views=100, width=SMALL[0], height=SMALL[1], num_points=50)
    points = rng.permutation(exact_points(scene))[:num]
    normals = normals_at(points)
    half = np.stack([1 + normals[:, 2], -normals[:, 1], normals[:, 0], np.zeros(len(points))], -1) + 1e-6
    sh = np.zeros((len(points), 16, 3), np.float32)
    sh[:, 0] = rng.normal(size=(len(points), 3)) / 2
    gaussians = a2tg.Gaussians(
        jnp.asarray(points, jnp.float32),
        jnp.asarray(half / np.linalg.norm(half, axis=1, keepdims=True), jnp.float32),
        jnp.full((len(points), 2), np.log(SIDE), jnp.float32),
        jnp.full(len(points), LOGIT_OPACITY, jnp.float32),
        jnp.asarray(sh),
    )
    chosen = scene.train[:: max(1, len(scene.train) // num_views)][:num_views]
    cameras = [resize_camera(view.camera, width, height) for view in chosen]
    origin = a2tg.Origin.of_cameras(cameras, transform=scene.transform)
    return a2tg.Model(transform_gaussians(gaussians, scene.transform), origin=origin)


def normals_at(points: np.ndarray) -> np.ndarray:
    """Return the unit normals [P, 3] of the built-in scene at points [P, 3] on its surfaces."""
    shapes = [shape for shape, _ in still_life(np.random.default_rng(0))]
    nearest = np.full(len(points), np.inf)
    normals = np.zeros(points.shape)
    for shape in shapes:
        place, normal = shape.place(*shape.locate(points.T.astype(np.float32)))
        distance = np.linalg.norm(place - points.T, axis=0)
        is_nearer = distance < nearest
        nearest[is_nearer], normals[is_nearer] = distance[is_nearer], normal.T[is_nearer]
    return normals


def measure(model: a2tg.Model, resolution: int, has_texture: bool):
    """Yield what was measured, with its name."""
    assert model.origin is not None
    cameras = model.origin.cameras
    center, radius = common_sphere(model.origin.viewmats)
    spaces = [Space.of(center, radius, side, False) for side in voxels_of_levels(radius / resolution, radius)]
    grids = [BlockGrid(GRID_BYTES) for _ in spaces]
    renderer = Renderer(model, cameras=cameras)
    depths_of = jax.jit(rendered_depth)
    times = []
    for camera in cameras:
        rendered, depths = seconds(lambda camera=camera: jax.block_until_ready(depths_of(renderer(camera), camera)))
        fused = []
        for grid, space in zip(grids, spaces, strict=True):
            taken, _ = seconds(lambda grid=grid, space=space, depths=depths: fuse(grid, depths, space))
            fused.append(taken)
        times.append((rendered, fused[0], sum(fused[1:])))
    names = ("render with depths", "fusing", "fusing into larger voxels")
    for name, column in zip(names, np.median(times[1:] or times, axis=0), strict=True):
        yield f"{name}, each view", f"{column:.2f} s"
    yield "voxels", f"{grids[0].num_bytes / 1e6:.0f} MB"
    filling = 0.0
    for level in reversed(range(len(grids) - 1)):
        least = LEAST_TO_FILL if level else LEAST_WEIGHT
        taken, _ = seconds(lambda at=level, least=least: fill(grids[at], grids[at + 1], least, LEAST_TO_FILL))
        filling += taken
    yield "filling", f"{filling:.2f} s"
    yield "voxels with larger ones, filled", f"{sum(grid.num_bytes for grid in grids) / 1e6:.0f} MB"
    cubes, mesh = seconds(lambda: surface_of(grids[0], spaces[0], LEAST_WEIGHT))
    yield "marching cubes", f"{cubes:.2f} s"
    yield "triangles", f"{mesh.num_faces:,}"
    yield "peak memory", f"{memory_peak() / 1e9:.2f} GB"
    if not has_texture:
        return
    taken, small = seconds(lambda: a2tg.simplify_mesh(mesh, FACES))
    yield f"simplifying to {FACES:,} faces", f"{taken:.1f} s"
    pictures = [(camera, np.asarray(renderer(camera).color), None) for camera in cameras]
    asked = [time.process_time()]

    def shown():
        for picture in pictures:
            asked.append(time.process_time())
            yield picture
        asked.append(time.process_time())

    a2tg.texture_mesh(small, shown(), size=ATLAS)
    unwrapping, *each = np.diff(asked)
    yield "unwrapping", f"{unwrapping:.1f} s"
    yield "texture, each view", f"{np.median(each):.2f} s"


def seconds(function: Callable[[], Any]) -> tuple[float, Any]:
    """Return processor seconds of a call, and its result."""
    start = time.process_time()
    result = function()
    return time.process_time() - start, result


if __name__ == "__main__":
    main()
