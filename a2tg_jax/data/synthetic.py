"""The built-in scenes, ray-traced by numpy at exact cameras: a still life in a round brick room, and a box on a floor,
both covered with coloured cells.

The patterns of the still life have details of about 4 to 10 pixels, finer than one or two thousand Gaussians can show
without textures. The cells are 2 to 4 pixels wide: a Gaussian for each costs 52 bytes, 232 with view dependence, and a
texel 16.
"""

import dataclasses
import functools
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from scipy.ndimage import maximum_filter, minimum_filter

from a2tg_jax import Picture, Scene
from a2tg_jax.data import patterns
from a2tg_jax.data.assembly import PointCloud, Shot, assemble_scene, check_test_every, every_kth
from a2tg_jax.data.camera_paths import intrinsics, looking
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

TARGET = np.array([0.0, 0.1, 0.45])
"""Point of the still life that all cameras look at."""
DOWN = np.array([0.0, 0.0, -1.0])
DISTANCE = 2.4
"""Distance of the cameras from the target."""
FIELD_OF_VIEW = np.deg2rad(58.0)
"""Field of view across the longer side of an image of the still life."""
BOX_TARGET = np.array([0.0, 0.0, 0.12])
FLOOR_RADIUS = 1.0
BOX_SIDE = 0.72
CELLS_A_METRE = 24
TEXELS_A_CELL = 16
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
    """Make the built-in still life: pinhole views on a closed curve over an arc, and points on the surfaces they see.

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
    return _made("synthetic", seed, num_views, (width, height), num_points, downscale, test_every)


def cells_scene(
    seed: int = 0,
    *,
    num_views: int = 32,
    width: int = 160,
    height: int = 160,
    num_points: int = 2500,
    downscale: int = 1,
    test_every: int = 8,
) -> Scene:
    """Make the built-in scene that needs textures: pinhole views from all around a box on a round floor, both covered
    with square cells of random colours, and points on the surfaces they see.

    A cell is 2 to 4 pixels wide at the default size, so that a texel shows it for far fewer bytes than a Gaussian. The
    background is black, the default of `RenderSettings`.

    Args:
      seed: random seed for colours, light and points; the arrangement is always the same.
      num_views: number of views, at least 2.
      width: width of the images in pixels, before `downscale`.
      height: height of the images in pixels, likewise.
      num_points: points sampled evenly over the surfaces in the images, instead of a sparse reconstruction; at least 2.
      downscale: k >= 1; images have 1/k of the size.
      test_every: every k-th view is a test view; 0 keeps none.

    Returns:
      The scene in its normalised world. The default takes a second on one core.

    Raises:
      ValueError: if an argument is out of its range.

    Examples:
      >>> scene = a2tg.cells_scene(width=48, height=48, num_views=12)
      >>> len(scene.train), len(scene.test), scene.test[0].image.shape
      (10, 2, (48, 48, 3))
    """
    return _made("cells", seed, num_views, (width, height), num_points, downscale, test_every)


def _made(
    name: str,
    seed: int,
    num_views: int,
    full_size: tuple[int, int],
    num_points: int,
    downscale: int,
    test_every: int,
) -> Scene:
    """Return a built-in scene. Same arguments as `synthetic_scene`."""
    width, height = full_size
    if num_views < 2 or num_points < 2 or downscale < 1 or min(width, height) < downscale:
        raise ValueError(
            f"the {name} scene needs at least 2 views, 2 points and images of a pixel; "
            f"got num_views={num_views}, num_points={num_points}, {width}x{height}, downscale={downscale}"
        )
    check_test_every(test_every)
    arrangement = ARRANGEMENTS[name]
    rng = np.random.default_rng(seed)
    surfaces, rng.bit_generator.state = _lit_surfaces(name, seed)
    size = round(width / downscale), round(height / downscale)
    K = intrinsics(*size, arrangement.field_of_view)
    centers = arrangement.camera_path(num_views)
    viewmats = [looking(center, arrangement.target - center, DOWN) for center in centers]
    shots = [
        Shot(f"view_{index:03d}.png", viewmat, K, Picture.of(render(surfaces, viewmat, K, *size)))
        for index, viewmat in enumerate(viewmats)
    ]
    cloud = sample_points(surfaces, shots, num_points, rng)
    return assemble_scene(name, *every_kth(shots, test_every), cloud, source=f"the {name} scene")


@functools.lru_cache(maxsize=1)
def _lit_surfaces(name: str, seed: int) -> tuple[tuple[Surface, ...], Any]:
    """Return the surfaces of a built-in scene, and the state of its generator after them; neither depends on size or
    views."""
    rng = np.random.default_rng(seed)
    return tuple(light(ARRANGEMENTS[name].surfaces(rng), rng)), rng.bit_generator.state


def still_life(rng: np.random.Generator) -> list[tuple[ParametricSurface, np.ndarray]]:
    """Return shapes and their colours: a room, a round podium, and the objects on it. Lengths are about metres."""
    wall = patterns.bricks(rng, 320, 2560, (14, 33))
    motto = "A2TG - ADAPTIVE ANISOTROPIC TEXTURED GAUSSIANS -"
    text = patterns.text_mask(motto, 64, 2560, 50, repeat=True)
    wall[142:206] = patterns.mix(patterns.SLATE, patterns.CREAM, text)
    rim = patterns.checks(2, 120, patterns.INK, patterns.GOLD, texels=16)
    letters = "A2TGA"
    colors = (patterns.CORAL, patterns.TEAL, patterns.LEAF, patterns.SKY, patterns.GOLD)
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


def celled_box(rng: np.random.Generator) -> list[tuple[ParametricSurface, np.ndarray]]:
    """Return a floor and a box on it, and their colours."""
    along_floor = round(2 * FLOOR_RADIUS * CELLS_A_METRE)
    along_box = round(BOX_SIDE * CELLS_A_METRE)
    return [
        (Disc((0, 0, 0), FLOOR_RADIUS), patterns.cells(rng, along_floor, along_floor, texels=TEXELS_A_CELL)),
        (
            # A few millimetres above the floor, which it would otherwise not shade under itself.
            Block((0, 0, BOX_SIDE / 2 + 0.005), BOX_SIDE / 2, 0.3),
            patterns.cells(rng, along_box, 5 * along_box, texels=TEXELS_A_CELL),
        ),
    ]


def camera_path(num_views: int) -> np.ndarray:
    """Return camera centres [V, 3] evenly along a closed figure of eight in front of the target, above its height."""
    phase = 2 * np.pi * (np.arange(num_views) + 0.5) / num_views  # half a step off the crossing
    azimuth = -0.5 * np.pi + np.deg2rad(40.0) * np.sin(phase)
    elevation = np.deg2rad(26.0) + np.deg2rad(11.0) * np.sin(2 * phase + 0.6)
    return _on_sphere(TARGET, azimuth, elevation)


def circular_path(num_views: int) -> np.ndarray:
    """Return camera centres [V, 3] evenly around the box, which rise and sink twice a turn."""
    azimuth = 2 * np.pi * (np.arange(num_views) + 0.5) / num_views
    elevation = np.deg2rad(42.0) + np.deg2rad(10.0) * np.sin(2 * azimuth + 0.6)
    return _on_sphere(BOX_TARGET, azimuth, elevation)


def _on_sphere(target: np.ndarray, azimuth: np.ndarray, elevation: np.ndarray) -> np.ndarray:
    """Return points [V, 3] at DISTANCE from the target."""
    outward = [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
    return target + DISTANCE * np.stack(outward, axis=-1)


@dataclasses.dataclass(frozen=True)
class Arrangement:
    """What a built-in scene shows, and from where."""

    surfaces: Callable[[np.random.Generator], list[tuple[ParametricSurface, np.ndarray]]]
    """Function that returns shapes and their colours; only these depend on the generator."""
    camera_path: Callable[[int], np.ndarray]
    """Function from a number of cameras to their centres [V, 3]."""
    target: np.ndarray
    """Point that all cameras look at."""
    field_of_view: float
    """Across the longer side of an image, in radians."""


ARRANGEMENTS: Mapping[str, Arrangement] = {
    "synthetic": Arrangement(still_life, camera_path, TARGET, FIELD_OF_VIEW),
    "cells": Arrangement(celled_box, circular_path, BOX_TARGET, np.deg2rad(49.0)),
}
BUILT_IN: Mapping[str, Callable[..., Scene]] = {
    # Small enough to train in minutes on two cores.
    "synthetic": functools.partial(synthetic_scene, width=208, height=156),
    "cells": cells_scene,
}
"""Built-in scenes by their names as the path of a scene, in the size of runs."""


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
    points = []
    colors = []
    missing = count
    while missing:
        shares = np.bincount(rng.integers(len(shots), size=missing), minlength=len(shots))
        for shot, share in zip(shots, shares, strict=True):
            pixels = shot.picture.read()
            height, width = shot.picture.size
            column = rng.integers(width, size=share)
            row = rng.integers(height, size=share)
            directions = _directions(shot.viewmat, shot.K, column + 0.5, row + 0.5)
            places = trace_rays(surfaces, _center(shot.viewmat), directions)[1].T
            is_hit = np.isfinite(places).all(axis=1)  # Instead of pixels of the background, others are drawn.
            points.append(places[is_hit])
            colors.append(pixels[row, column][is_hit])
            missing -= int(np.count_nonzero(is_hit))
    return PointCloud(np.concatenate(points), np.concatenate(colors))


def exact_points(scene: Scene) -> np.ndarray:
    """Return the points [P, 3] on the exact surfaces that the training views of a built-in scene see, in the original
    world.
    """
    # Only colours depend on the seed.
    shapes = [shape for shape, _ in ARRANGEMENTS[scene.name].surfaces(np.random.default_rng(0))]
    inverse = scene.transform.inverse()
    points = []
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
