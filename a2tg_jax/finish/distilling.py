"""Training of a plain model on pictures of another model, in place of photographs."""

import dataclasses
import math
from collections.abc import Iterable, Iterator, Sequence

import numpy as np

from a2tg_jax.core.cameras import Camera
from a2tg_jax.core.origin import Color
from a2tg_jax.core.similarity import Similarity, camera_centers
from a2tg_jax.data.assembly import scene_scale
from a2tg_jax.data.scene import Scene, View
from a2tg_jax.model import Model
from a2tg_jax.renderer import Renderer
from a2tg_jax.systems.baselines import Gaussians2d
from a2tg_jax.training import fit_stage
from a2tg_jax.training.fitting import BACKGROUNDS
from a2tg_jax.training.stage import Background


def distill(
    model: Model, wanted: Model, cameras: Sequence[Camera], *, iterations: int, progress: bool = False
) -> Model:
    """Return a plain model after training on pictures of another one; the number of Gaussians stays.

    Both are drawn over black or white, whichever is nearer to the other model's background.

    Args:
      model: of plain Gaussians, in the world of the other.
      wanted: any model.
      cameras: views to draw, at least one.
      iterations: each draws one view.
      progress: show a progress bar.
    """
    highest = model.gaussians.sh_degree
    behind: Background = "white" if np.mean(wanted.background) > 0.5 else "black"
    system = Gaussians2d(stage1_iterations=1, stage2_iterations=iterations, sh_degree=highest, background=behind)
    scene, start = drawn_scene(wanted, cameras, BACKGROUNDS[behind]), dataclasses.replace(model, origin=None)
    trained = fit_stage(scene, system, 1, start, progress=progress, title="bake").model
    return dataclasses.replace(trained, origin=wanted.origin)


def pictures(model: Model, cameras: Sequence[Camera], background: Color | None = None) -> Iterator[np.ndarray]:
    """Yield the pictures [H, W, 3] of a model over its own background or another, clipped to [0, 1] (host)."""
    renderer = Renderer(model, cameras=cameras, background=background, has_geometry=False)
    for camera in cameras:
        yield np.clip(np.asarray(renderer(camera).color), 0, 1)


def likeness(found: Iterable[np.ndarray], wanted: Iterable[np.ndarray]) -> float:
    """Return the PSNR in dB of pictures beside others, from the mean of their squared errors; at most 100."""
    error = np.mean([np.mean((x - y) ** 2) for x, y in zip(found, wanted, strict=True)])
    return -10 * math.log10(max(float(error), 1e-10))


def drawn_scene(model: Model, cameras: Sequence[Camera], background: Color) -> Scene:
    """Return a scene whose photographs are pictures of a model over a background (host)."""
    drawn = (np.rint(255 * image).astype(np.uint8) for image in pictures(model, cameras, background))
    views = tuple(
        View(str(index), camera, image) for index, (camera, image) in enumerate(zip(cameras, drawn, strict=True))
    )
    points = np.asarray(model.gaussians.means, np.float32)
    world = Similarity(1.0, np.eye(3), np.zeros(3)) if model.origin is None else model.origin.transform
    centers = camera_centers(np.array([camera.viewmat for camera in cameras], np.float64))
    # Cameras in one place have no extent: the distance of what they see takes its place.
    scale = scene_scale(centers) or float(np.median(np.linalg.norm(points - centers[0], axis=1)))
    return Scene("drawn", views, (), points, np.zeros_like(points), world, scale)
