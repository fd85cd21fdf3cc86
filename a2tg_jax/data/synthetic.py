"""The built-in scene: a still life in a round brick room, ray-traced by numpy at exact cameras.

Its patterns have details of about 4 to 10 pixels, finer than one or two thousand Gaussians can show without textures.
"""

import functools
from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.ndimage import maximum_filter, minimum_filter

from a2tg_jax.core.cameras import intrinsics, looking
from a2tg_jax.data import patterns
from a2tg_jax.data.assembly import PointCloud, Shot, assemble_scene, check_test_every, every_kth
from a2tg_jax.data.photo_store import Picture
from a2tg_jax.data.ray_tracing import (
    Ball,
    Block,
    Disc,
    ParametricSurface,
    Surface,
    Tube,
    light,
    nearest_hits,
    trace_rays,
)
from a2tg_jax.data.scene import Scene

TARGET = np.array([0.0, 0.1, 0.45])
"""Point that all cameras look at."""
DOWN = np.array([0.0, 0.0, -1.0])
DISTANCE = 2.4
"""Distance of the cameras from the target."""
FIELD_OF_VIEW = np.deg2rad(58.0)
"""Field of view across the longer side of the image."""
SAMPLE_OFFSETS = np.array([[-0.375, -0.125, 0.125, 0.375], [0.125, -0.375, 0.375, -0.125]])
"""Places [2, S] of a pixel's rays around its centre: a turned square, all different along x and along y."""


def synthetic_scene(
    seed: int = 0,
    *,
    num_views: int = 28,
    width: int = 320,
    height: int = 240,
    num_points: int = 2500,
    downscale: int = 1,
    test_every: int = 8,
) -> Scene:
    """Make the built-in scene: pinhole views on a closed curve over an arc, and points on the surfaces they see.

    Args:
      seed: random seed for patterns, light and points; the arrangement is always the same.
      num_views: number of views, at least 2.
      width: width of the images in pixels, before `downscale`.
      height: height of the images in pixels, likewise.
      num_points: points sampled evenly over the images, instead of a sparse reconstruction; at least 2.
      downscale: k >= 1; images have 1/k of the size.
      test_every: every k-th view is a test view; 0 keeps none.

    Returns:
      The scene in its normalised world. The default takes a few seconds on one core.

    Raises:
      ValueError: if an argument is out of its range.

    Examples:
      >>> scene = a2tg.synthetic_scene(width=48, height=36, num_views=12)
      >>> len(scene.train), len(scene.test), scene.test[0].image.shape
      (10, 2, (36, 48, 3))
    """
    if num_views < 2 or num_points < 2 or downscale < 1 or min(width, height) < downscale:
        raise ValueError(
            f"the synthetic scene needs at least 2 views, 2 points and images of a pixel; "
            f"got num_views={num_views}, num_points={num_points}, {width}x{height}, downscale={downscale}"
        )
    check_test_every(test_every)
    rng = np.random.default_rng(seed)
    surfaces, rng.bit_generator.state = _lit_surfaces(seed)
    size = round(width / downscale), round(height / downscale)
    K = intrinsics(*size, FIELD_OF_VIEW)
    viewmats = [looking(center, TARGET - center, DOWN) for center in camera_path(num_views)]
    shots = [
        Shot(f"view_{index:03d}.png", viewmat, K, Picture.of(render(surfaces, viewmat, K, *size)))
        for index, viewmat in enumerate(viewmats)
    ]
    cloud = sample_points(surfaces, shots, num_points, rng)
    return assemble_scene("synthetic", *every_kth(shots, test_every), cloud, source="the synthetic scene")


@functools.lru_cache(maxsize=1)
def _lit_surfaces(seed: int) -> tuple[tuple[Surface, ...], Any]:
    """Return the surfaces of a seed, and the state of its generator after them; neither depends on size or views."""
    rng = np.random.default_rng(seed)
    return tuple(light(still_life(rng), rng)), rng.bit_generator.state


def still_life(rng: np.random.Generator) -> list[tuple[ParametricSurface, np.ndarray]]:
    """Return shapes and their colours: a room, a round podium, and the objects on it. Lengths are about metres."""
    wall = patterns.bricks(rng, 320, 2560, (14, 33))
    motto = "A2TG - ADAPTIVE ANISOTROPIC TEXTURED GAUSSIANS -"
    text = patterns.text_mask(motto, 64, 2560, 50, repeat=True)
    wall[142:206] = patterns.mix(patterns.SLATE, patterns.CREAM, text)
    rim = patterns.checks(2, 120, patterns.INK, patterns.GOLD, texels=16)
    letters, colors = "A2TGA", (patterns.CORAL, patterns.TEAL, patterns.LEAF, patterns.SKY, patterns.GOLD)
    return [
        (Tube((0, 0, 0), 3.0, 2.4, is_inward=True), wall),
        (Disc((0, 0, 0), 3.0), patterns.planks(rng, 896, 26, 190)),
        (Tube((0, 0.1, 0), 1.15, 0.12), rim),
        (Disc((0, 0.1, 0.12), 1.15), patterns.mosaic(rng, 768, 25)),
        (Block((-0.50, -0.25, 0.38), 0.26, 0.45), patterns.letter_block(letters, 160, colors)),
        (Block((-0.47, -0.22, 0.82), 0.18, 0.05), patterns.letter_block(letters[::-1], 128, colors[::-1])),
        (Ball((0.55, 0.05, 0.50), 0.38), patterns.globe(256, 512, 44)),
        (Ball((0.05, -0.60, 0.30), 0.18), patterns.marble(rng, 128, 256)),
        (Tube((0.0, 0.70, 0.12), 0.20, 0.80), patterns.barber_pole(rng, 384, 384)),
        (Ball((0.0, 0.70, 1.07), 0.24), patterns.globe(160, 320, 24)),
    ]


def camera_path(num_views: int) -> np.ndarray:
    """Return camera centres [V, 3] evenly along a closed figure of eight in front of the target, above its height."""
    phase = 2 * np.pi * (np.arange(num_views) + 0.5) / num_views  # half a step off the crossing
    azimuth = -0.5 * np.pi + np.deg2rad(40.0) * np.sin(phase)
    elevation = np.deg2rad(26.0) + np.deg2rad(11.0) * np.sin(2 * phase + 0.6)
    outward = [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
    return TARGET + DISTANCE * np.stack(outward, axis=-1)


def render(surfaces: Sequence[Surface], viewmat: np.ndarray, K: np.ndarray, width: int, height: int) -> np.ndarray:
    """Return the image [height, width, 3] uint8 that a camera sees, the mean of a few rays a pixel (SAMPLE_OFFSETS)."""
    center = _center(viewmat)
    x, y = (grid.ravel() for grid in np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5))
    seen = nearest_hits([surface.shape for surface in surfaces], center, _directions(viewmat, K, x, y))[1]
    seen_grid = seen.reshape(height, width)
    is_inside = (maximum_filter(seen_grid, 3) == minimum_filter(seen_grid, 3)).ravel()
    # Most pixels and their neighbours see one surface, the only one that their rays then need to be tested against.
    groups: list[tuple[Sequence[Surface], np.ndarray]] = [(surfaces, ~is_inside)]
    groups += [([surface], is_inside & (seen == number)) for number, surface in enumerate(surfaces)]
    image = np.empty((width * height, 3), np.uint8)
    for candidates, is_member in groups:
        directions = _directions(viewmat, K, x[is_member], y[is_member])
        # Rays are linear in x and y, so one shift serves all pixels.
        shifts = _directions(viewmat, K, *(K[:2, 2:] + SAMPLE_OFFSETS)) - _directions(viewmat, K, *K[:2, 2:])
        samples = [trace_rays(candidates, center, directions + shift[:, None])[0] for shift in shifts.T]
        image[is_member] = np.rint(np.sum(samples, axis=0, dtype=np.uint16) / len(samples))
    return image.reshape(height, width, 3)


def sample_points(surfaces: Sequence[Surface], shots: list[Shot], count: int, rng: np.random.Generator) -> PointCloud:
    """Return surface points under `count` random pixels of the shots, with the colours of those pixels."""
    shares = np.bincount(rng.integers(len(shots), size=count), minlength=len(shots))
    points, colors = [], []
    for shot, share in zip(shots, shares, strict=True):
        pixels = shot.picture.read()
        height, width = shot.picture.size
        column, row = rng.integers(width, size=share), rng.integers(height, size=share)
        directions = _directions(shot.viewmat, shot.K, column + 0.5, row + 0.5)
        points.append(trace_rays(surfaces, _center(shot.viewmat), directions)[1].T)
        colors.append(pixels[row, column])
    is_hit = np.isfinite(np.concatenate(points)).all(axis=1)
    return PointCloud(np.concatenate(points)[is_hit], np.concatenate(colors)[is_hit])


def exact_points(scene: Scene) -> np.ndarray:
    """Return the points [P, 3] on the exact surfaces that the training views of a synthetic scene see, in the original
    world.
    """
    shapes = [shape for shape, _ in still_life(np.random.default_rng(0))]  # Only patterns depend on the seed.
    inverse, points = scene.transform.inverse(), []
    for camera in (view.camera for view in scene.train):
        viewmat = inverse.apply_to_viewmat(np.asarray(camera.viewmat, np.float64))
        x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
        rays = _directions(viewmat, np.asarray(camera.K, np.float64), x, y)
        depths = nearest_hits(shapes, _center(viewmat), rays)[0]
        points.append((_center(viewmat) + depths * rays).T[np.isfinite(depths)])
    return np.concatenate(points)


def _center(viewmat: np.ndarray) -> np.ndarray:
    """Return [3, 1] float32 position of a camera."""
    return (-viewmat[:3, :3].T @ viewmat[:3, 3:]).astype(np.float32)


def _directions(viewmat: np.ndarray, K: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return world directions [3, P] float32 of the rays through image points (x, y), any shape with P entries."""
    points = np.stack([x.ravel(), y.ravel(), np.ones(x.size)]).astype(np.float32)
    return (viewmat[:3, :3].T @ np.linalg.inv(K)).astype(np.float32) @ points
