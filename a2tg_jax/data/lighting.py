"""Light of the synthetic scene, multiplied once into the images of its surfaces, so that every view sees the same."""

import numpy as np
from scipy.ndimage import zoom

from a2tg_jax.data.surfaces import ParametricSurface, Surface, nearest_hits

LAMP = np.array([[-1.7], [-1.9], [3.1]], np.float32)
"""Centre of a spherical lamp."""
LAMP_RADIUS = 0.35
NUM_LAMP_RAYS, NUM_SKY_RAYS = 8, 16
SKY_REACH = 0.8
"""Largest distance at which a surface darkens a point."""
SKY_LIGHT, LAMP_LIGHT = 0.48, 0.68
TEXELS_PER_SAMPLE = 8
"""Factor by which the grid of light is coarser than a surface's image."""


def light(colored: list[tuple[ParametricSurface, np.ndarray]], rng: np.random.Generator) -> list[Surface]:
    """Return surfaces with images of the given colours, lit by a lamp with soft shadows and by the sky.

    Args:
      colored: shapes with their own colours [rows, columns, 3] float32 in [0, 1].
      rng: turns the patterns of rays.
    """
    shapes = [shape for shape, _ in colored]
    return [Surface(shape, _shaded(shape, colors, shapes, rng)) for shape, colors in colored]


def _shaded(
    shape: ParametricSurface, colors: np.ndarray, shapes: list[ParametricSurface], rng: np.random.Generator
) -> np.ndarray:
    """Return the image [rows, columns, 3] uint8 of one shape: its colours times its light, clipped at 1."""
    rows, columns = (max(2, -(-size // TEXELS_PER_SAMPLE)) for size in colors.shape[:2])
    u, v = np.meshgrid((np.arange(columns) + 0.5) / columns, (np.arange(rows) + 0.5) / rows)
    points, normals = (x.astype(np.float32) for x in shape.place(u.ravel(), v.ravel()))
    points = points + np.float32(1e-3) * normals
    coarse = SKY_LIGHT * _sky_light(shapes, points, normals, rng)
    coarse = coarse + LAMP_LIGHT * _lamp_light(shapes, points, normals, rng)
    factors = colors.shape[0] / rows, colors.shape[1] / columns
    fine = zoom(coarse.reshape(rows, columns), factors, order=1, grid_mode=True, mode="nearest")
    pixels: np.ndarray = np.rint(255 * np.clip(colors * fine[..., None], 0, 1)).astype(np.uint8)
    return pixels


def _lamp_light(
    shapes: list[ParametricSurface], points: np.ndarray, normals: np.ndarray, rng: np.random.Generator
) -> np.ndarray:
    """Return the cosine of the lamp's direction times the visible share of the lamp, [P]."""
    total = np.zeros(points.shape[1], np.float32)
    for offset in _unit_vectors(rng, NUM_LAMP_RAYS):
        towards = LAMP + np.float32(LAMP_RADIUS) * offset[:, None] - points
        cosine = (towards * normals).sum(axis=0) / np.linalg.norm(towards, axis=0)
        is_free = nearest_hits(shapes, points, towards)[0] > 1
        total += np.maximum(cosine, 0) * is_free
    return total / NUM_LAMP_RAYS


def _sky_light(
    shapes: list[ParametricSurface], points: np.ndarray, normals: np.ndarray, rng: np.random.Generator
) -> np.ndarray:
    """Return the share of the cosine-weighted hemisphere with nothing nearer than SKY_REACH, [P]."""
    total = np.zeros(points.shape[1], np.float32)
    for offset in _unit_vectors(rng, NUM_SKY_RAYS):
        directions = normals + np.float32(0.999) * offset[:, None]
        directions /= np.linalg.norm(directions, axis=0)
        total += nearest_hits(shapes, points, directions)[0] > SKY_REACH
    return total / NUM_SKY_RAYS


def _unit_vectors(rng: np.random.Generator, count: int) -> np.ndarray:
    """Return [count, 3] float32 unit vectors spread evenly over the sphere (a Fibonacci lattice, turned at random)."""
    index = np.arange(count) + 0.5
    z, angle = 1 - 2 * index / count, np.pi * (1 + 5**0.5) * index + rng.uniform(0, 2 * np.pi)
    radius = np.sqrt(1 - z * z)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), z], -1).astype(np.float32)
