"""Surfaces that rays can hit and that carry an image: what the synthetic scene is made of.

Rays are origin + t·direction with P rows each, directions not necessarily unit; t is infinite where a ray misses.
(u, v) in [0, 1] run along the columns and rows of a surface's image.
"""

import dataclasses
from typing import Protocol

import numpy as np

NEAR = 1e-3
"""Hits at smaller t are the point itself."""


class Shape(Protocol):
    """A parametrised surface."""

    def hit(self, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """t [P] of the nearest hit beyond NEAR."""

    def locate(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(u, v), each [P], of points [P, 3] on the surface."""

    def place(self, u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(points, unit normals) [..., 3] at (u, v) [...], the inverse of `locate`."""


@dataclasses.dataclass(frozen=True)
class Disc:
    """A horizontal disc, seen from above; its image is the square around it."""

    center: tuple[float, float, float]
    radius: float

    def hit(self, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
        down = np.minimum(directions[:, 2], -1e-9)
        t = (self.center[2] - origins[:, 2]) / down
        x = origins[:, 0] + t * directions[:, 0] - self.center[0]
        y = origins[:, 1] + t * directions[:, 1] - self.center[1]
        return np.where((t > NEAR) & (x * x + y * y < self.radius**2), t, np.inf)

    def locate(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        offsets = points - np.float32(self.center)
        return 0.5 + offsets[:, 0] / (2 * self.radius), 0.5 + offsets[:, 1] / (2 * self.radius)

    def place(self, u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        offsets = np.stack([(2 * u - 1) * self.radius, (2 * v - 1) * self.radius, np.zeros_like(u)], -1)
        return offsets + np.float32(self.center), np.broadcast_to(np.float32([0, 0, 1]), offsets.shape)


@dataclasses.dataclass(frozen=True)
class Tube:
    """A vertical cylinder without caps, seen from the outside or, as a room's wall, from the inside.

    u runs counter-clockwise around it, v downwards.
    """

    center: tuple[float, float, float]
    """Of its foot."""
    radius: float
    height: float
    is_inward: bool = False

    def hit(self, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
        x, y = origins[:, 0] - self.center[0], origins[:, 1] - self.center[1]
        dx, dy = directions[:, 0], directions[:, 1]
        a = np.maximum(dx * dx + dy * dy, 1e-12)
        b = x * dx + y * dy
        discriminant = b * b - a * (x * x + y * y - self.radius**2)
        root = np.sqrt(np.maximum(discriminant, 0))
        t = (-b + root if self.is_inward else -b - root) / a
        z = origins[:, 2] + t * directions[:, 2] - self.center[2]
        return np.where((discriminant > 0) & (t > NEAR) & (z > 0) & (z < self.height), t, np.inf)

    def locate(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        offsets = points - np.float32(self.center)
        u = np.arctan2(offsets[:, 1], offsets[:, 0]) * np.float32(0.5 / np.pi) + 0.5
        return (1 - u if self.is_inward else u), 1 - offsets[:, 2] / self.height

    def place(self, u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        angle = 2 * np.pi * ((1 - u if self.is_inward else u) - 0.5)
        outward = np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], -1)
        points = outward * self.radius + np.float32(self.center)
        points[..., 2] += (1 - v) * self.height
        return points, -outward if self.is_inward else outward


@dataclasses.dataclass(frozen=True)
class Ball:
    """A sphere; u is its longitude, v its latitude from the top down."""

    center: tuple[float, float, float]
    radius: float

    def hit(self, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
        offsets = origins - np.float32(self.center)
        a = np.einsum("pk,pk->p", directions, directions)
        b = np.einsum("pk,pk->p", offsets, directions)
        discriminant = b * b - a * (np.einsum("pk,pk->p", offsets, offsets) - self.radius**2)
        t = (-b - np.sqrt(np.maximum(discriminant, 0))) / a
        return np.where((discriminant > 0) & (t > NEAR), t, np.inf)

    def locate(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        outward = (points - np.float32(self.center)) / self.radius
        longitude = np.arctan2(outward[:, 1], outward[:, 0]) * np.float32(0.5 / np.pi) + 0.5
        return longitude, np.arccos(np.clip(outward[:, 2], -1, 1)) / np.float32(np.pi)

    def place(self, u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        longitude, polar = 2 * np.pi * (u - 0.5), np.pi * v
        sine = np.sin(polar)
        outward = np.stack([sine * np.cos(longitude), sine * np.sin(longitude), np.cos(polar)], -1)
        return outward * self.radius + np.float32(self.center), outward


@dataclasses.dataclass(frozen=True)
class Block:
    """A cube standing upright, turned about the vertical; its image holds the faces +x, +y, -x, -y, +z side by side."""

    center: tuple[float, float, float]
    half_side: float
    turn: float
    """Radians counter-clockwise."""

    @property
    def axes(self) -> np.ndarray:
        """[3, 3] rows are the cube's own axes in the world."""
        cosine, sine = np.cos(self.turn), np.sin(self.turn)
        return np.float32([[cosine, sine, 0], [-sine, cosine, 0], [0, 0, 1]])

    def hit(self, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
        start = (origins - np.float32(self.center)) @ self.axes.T
        step = directions @ self.axes.T
        step = np.where(np.abs(step) < 1e-9, np.float32(1e-9), step)
        middle, reach = -start / step, self.half_side / np.abs(step)
        entry, leaving = (middle - reach).max(axis=1), (middle + reach).min(axis=1)
        return np.where((entry < leaving) & (entry > NEAR), entry, np.inf)

    def locate(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        x, y, z = ((points - np.float32(self.center)) @ self.axes.T / self.half_side).T
        face = np.argmax(np.stack([x, y, -x, -y, z]), axis=0)
        along = np.choose(face, [y, -x, -y, x, x])
        down = np.where(face == 4, -y, -z)
        return (face + np.clip(0.5 + 0.5 * along, 0, 0.9999)) / 5, np.clip(0.5 + 0.5 * down, 0, 0.9999)

    def place(self, u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        face = np.minimum((u * 5).astype(int), 4)
        along, down = 2 * (u * 5 - face) - 1, 2 * v - 1
        normals = np.float32([[1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0], [0, 0, 1]])
        rights = np.float32([[0, 1, 0], [-1, 0, 0], [0, -1, 0], [1, 0, 0], [1, 0, 0]])
        downs = np.float32([[0, 0, -1]] * 4 + [[0, -1, 0]])
        local = normals[face] + along[..., None] * rights[face] + down[..., None] * downs[face]
        return local * self.half_side @ self.axes + np.float32(self.center), normals[face] @ self.axes


@dataclasses.dataclass(frozen=True, eq=False)
class Surface:
    """A shape with its image."""

    shape: Shape
    image: np.ndarray
    """[rows, columns, 3] float32 in [0, 1]."""


def nearest_hits(
    surfaces: list[Surface], origins: np.ndarray, directions: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """(t, index of the surface) of the first hit of each ray, both [P]; t is infinite where all are missed."""
    nearest = np.full(len(directions), np.inf, np.float32)
    index = np.zeros(len(directions), np.int8)
    for number, surface in enumerate(surfaces):
        t = surface.shape.hit(origins, directions)
        is_nearer = t < nearest
        np.copyto(nearest, t, where=is_nearer, casting="same_kind")
        np.copyto(index, np.int8(number), where=is_nearer)
    return nearest, index


def trace(surfaces: list[Surface], origin: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Colours and places of what rays from one point see.

    Args:
      surfaces: the scene.
      origin: [3] float32.
      directions: [P, 3] float32.

    Returns:
      (colors [P, 3], black where nothing is hit; points [P, 3], not finite there), float32.
    """
    t, index = nearest_hits(surfaces, origin[None], directions)
    points = origin + t[:, None] * directions
    colors = np.zeros_like(points)
    is_hit = np.isfinite(t)
    for number, surface in enumerate(surfaces):
        rows = np.flatnonzero(is_hit & (index == number))
        colors[rows] = look_up(surface.image, *surface.shape.locate(points[rows]))
    return colors, points


def look_up(image: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """The texels [P, 3] nearest to (u, v)."""
    rows, columns = image.shape[:2]
    row = np.clip((v * rows).astype(np.int32), 0, rows - 1)
    column = np.clip((u * columns).astype(np.int32), 0, columns - 1)
    return image[row, column]
