"""The built-in scene without its room, under a sky with clouds: a capture of which much is far away."""

import numpy as np

import a2tg_jax as a2tg
from a2tg_jax.core.cameras import intrinsics, looking
from a2tg_jax.data.assembly import Shot, assemble_scene, every_kth
from a2tg_jax.data.ray_tracing import Surface, light, trace_rays
from a2tg_jax.data.synthetic import DISTANCE, DOWN, FIELD_OF_VIEW, SAMPLE_OFFSETS, TARGET, sample_points, still_life

NUM_VIEWS, NUM_POINTS, TEST_EVERY = 28, 4_000, 8
ZENITH, HORIZON, CLOUD, GROUND = np.array([[70, 120, 200], [190, 210, 230], [250, 250, 248], [150, 145, 135]])
"""Colours in bytes."""
NUM_WAVES = 24


def outdoors(width: int, height: int) -> a2tg.Scene:
    """Return the scene: a podium with objects on a round floor, seen from low cameras of which some look up."""
    rng = np.random.default_rng(0)
    surfaces = light(still_life(rng), rng)[1:]
    K = intrinsics(width, height, FIELD_OF_VIEW)
    shots = [
        Shot(f"view_{index:03d}.png", viewmat, K, a2tg.Picture.of(photograph(surfaces, viewmat, K, width, height)))
        for index, viewmat in enumerate(low_path(NUM_VIEWS))
    ]
    cloud = sample_points(surfaces, shots, NUM_POINTS, rng)
    return assemble_scene("outdoors", *every_kth(shots, TEST_EVERY), cloud, source="the scene outdoors")


def low_path(num_views: int) -> list[np.ndarray]:
    """Return world-to-camera matrices of cameras along an arc, low above the floor; they look up and down in turn."""
    phase = 2 * np.pi * (np.arange(num_views) + 0.5) / num_views
    azimuth = -0.5 * np.pi + np.deg2rad(60.0) * np.sin(phase)
    elevation = np.deg2rad(10.0) + np.deg2rad(6.0) * np.sin(2 * phase + 0.6)
    outward = np.stack(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)], axis=-1
    )
    targets = TARGET + np.stack([0 * phase, 0 * phase, 0.45 + 0.5 * np.sin(3 * phase)], axis=-1)
    centers = TARGET + DISTANCE * outward
    return [looking(center, target - center, DOWN) for center, target in zip(centers, targets, strict=True)]


def photograph(surfaces: list[Surface], viewmat: np.ndarray, K: np.ndarray, width: int, height: int) -> np.ndarray:
    """Return the image [H, W, 3] uint8 that a camera sees, the mean of a few rays a pixel, with the sky behind."""
    center = (-viewmat[:3, :3].T @ viewmat[:3, 3:]).astype(np.float32)
    x, y = (grid.ravel() for grid in np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5))
    image = np.zeros((width * height, 3))
    for dx, dy in SAMPLE_OFFSETS.T:
        pixels = np.stack([x + dx, y + dy, np.ones_like(x)])
        directions = (viewmat[:3, :3].T @ np.linalg.inv(K) @ pixels).astype(np.float32)
        colors, points = trace_rays(surfaces, center, directions)
        image += np.where(np.isfinite(points).all(axis=0)[:, None], colors, sky_colors(directions))
    rounded: np.ndarray = np.rint(image / SAMPLE_OFFSETS.shape[1]).astype(np.uint8).reshape(height, width, 3)
    return rounded


def sky_colors(directions: np.ndarray) -> np.ndarray:
    """Return colours [P, 3] of the sky in directions [3, P]: a gradient with clouds, and distant ground below."""
    x, y, z = directions / np.linalg.norm(directions, axis=0)
    up = np.clip(z, 0, 1)[:, None]
    clear = HORIZON + (ZENITH - HORIZON) * np.sqrt(up)
    density = clouds(1.4 * np.stack([x, y]) / (np.maximum(z, 0) + 0.25))[:, None]
    above = clear + (CLOUD - clear) * density * np.minimum(1, 6 * up)
    return np.where(z[:, None] > 0, above, GROUND + (HORIZON - GROUND) * np.exp(8 * np.minimum(z, 0))[:, None])


def clouds(places: np.ndarray) -> np.ndarray:
    """Return the density of clouds [P] in [0, 1] at places [2, P], a sum of waves."""
    rng = np.random.default_rng(0)
    turns, sizes = rng.uniform(0, np.pi, NUM_WAVES), 1.35 ** rng.uniform(0, 10, NUM_WAVES)
    axes = np.stack([np.cos(turns), np.sin(turns)], axis=1) * sizes[:, None]
    waves = np.cos(axes @ places + rng.uniform(0, 6, NUM_WAVES)[:, None])
    density: np.ndarray = 0.5 + 1.2 * (waves / np.sqrt(sizes)[:, None]).sum(axis=0) / np.sqrt(NUM_WAVES)
    return np.clip(density, 0, 1)
