"""Surfaces of the built-in scenes: shapes that rays can hit, with an image on them, and the light on them.

Vectors are float32 with their components first, [3, P], which makes numpy several times faster. (Python's numbers do
not change the type of an array.) Rays are origin + t·direction, directions not necessarily unit; t is infinite if a ray
misses. (u, v) in [0, 1] run along the columns and rows of a surface's image. Light is multiplied once into the images,
so that every view sees the same.

Each shape has three methods. `hit` returns t [P] of the nearest hit beyond NEAR, of rays whose origins are [3, P] or
one for all, [3, 1]. `locate` returns (u, v), each [P], of points [3, P] on the shape. `place`, its inverse, returns
points and unit normals [3, P] at (u, v).
"""

import dataclasses
from collections.abc import Sequence

import numpy as np
from scipy.ndimage import zoom

from a2tg_jax.base.even_spacing import fibonacci

NEAR = 1e-3
"""Smallest t of a hit; nearer ones are the point itself."""
LAMP = np.array([[-1.7], [-1.9], [3.1]], np.float32)
"""Centre of a spherical lamp."""
LAMP_RADIUS = 0.35
NUM_LAMP_RAYS = 8
NUM_SKY_RAYS = 16
SKY_REACH = 0.8
"""Largest distance at which a surface darkens a point."""
SKY_LIGHT = 0.48
LAMP_LIGHT = 0.68
TEXELS_PER_SAMPLE = 8
"""Factor by which the grid of light is coarser than a surface's image."""
Vector = tuple[float, float, float]


@dataclasses.dataclass(frozen=True)
class Disc:
    """A horizontal disc, seen from above; its image is the square around it."""

    center: Vector
    radius: float

    def hit(self, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
        x, y, z = origins - column(self.center)
        dx, dy, dz = directions
        t = z / np.maximum(-dz, 1e-9)
        is_inside = squares(x + t * dx, y + t * dy) < self.radius**2
        return np.where(is_inside & (t > NEAR), t, np.inf)

    def locate(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        u, v, _ = 0.5 + (points - column(self.center)) / (2 * self.radius)
        return u, v

    def place(self, u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        offsets = np.stack([2 * u - 1, 2 * v - 1, np.zeros_like(u)]) * np.float32(self.radius)
        return offsets + column(self.center), np.broadcast_to(column((0, 0, 1)), offsets.shape)


@dataclasses.dataclass(frozen=True)
class Tube:
    """A vertical cylinder without caps, seen from the outside or, as a room's wall, from the inside.

    u runs from left to right as seen, v downwards.
    """

    center: Vector
    """Centre of its foot."""
    radius: float
    height: float
    is_inward: bool = False

    def hit(self, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
        x, y, z = origins - column(self.center)
        dx, dy, dz = directions
        near, far = quadratic_roots(squares(dx, dy), x * dx + y * dy, squares(x, y) - self.radius**2)
        t = far if self.is_inward else near
        at = z + t * dz
        return np.where((t > NEAR) & (at > 0) & (at < self.height), t, np.inf)

    def locate(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        x, y, z = points - column(self.center)
        turns = np.arctan2(y, x) * (0.5 / np.pi) + 0.5
        return (1 - turns if self.is_inward else turns), 1 - z / self.height

    def place(self, u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        angle = 2 * np.pi * ((1 - u if self.is_inward else u) - 0.5)
        outward = np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)])
        up = np.stack([np.zeros_like(v), np.zeros_like(v), (1 - v) * self.height])
        return outward * self.radius + up + column(self.center), -outward if self.is_inward else outward


@dataclasses.dataclass(frozen=True)
class Ball:
    """A sphere; u is its longitude, v its latitude from the top down."""

    center: Vector
    radius: float

    def hit(self, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
        x, y, z = origins - column(self.center)
        dx, dy, dz = directions
        constant = squares(x, y, z) - self.radius**2
        t, _ = quadratic_roots(squares(dx, dy, dz), x * dx + y * dy + z * dz, constant)
        return np.where(t > NEAR, t, np.inf)

    def locate(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        x, y, z = (points - column(self.center)) / self.radius
        longitude = np.arctan2(y, x) * (0.5 / np.pi) + 0.5
        return longitude, np.arccos(np.clip(z, -1, 1)) * (1 / np.pi)

    def place(self, u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        longitude = 2 * np.pi * (u - 0.5)
        polar = np.pi * v
        sine = np.sin(polar)
        outward = np.stack([sine * np.cos(longitude), sine * np.sin(longitude), np.cos(polar)])
        return outward * self.radius + column(self.center), outward


@dataclasses.dataclass(frozen=True)
class Block:
    """An upright cube, turned about the vertical; its image holds the faces +x, +y, -x, -y, +z side by side."""

    center: Vector
    half_side: float
    turn: float
    """Angle in radians, counter-clockwise."""

    @property
    def axes(self) -> np.ndarray:
        """[3, 3] rows are the cube's own axes in the world, divided by half its side."""
        cosine = np.cos(self.turn)
        sine = np.sin(self.turn)
        return np.array([[cosine, sine, 0], [-sine, cosine, 0], [0, 0, 1]], np.float32) / np.float32(self.half_side)

    def hit(self, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
        # A ray is in the cube where it is between the planes of all three axes at once.
        entry = NEAR
        leaving = np.inf
        positions = self.axes @ (origins - column(self.center))
        for position, speed in zip(positions, self.axes @ directions, strict=True):
            inverse = 1 / np.where(np.abs(speed) < 1e-9, 1e-9, speed)  # No 1 / 0 for a ray along a face.
            middle = -position * inverse
            reach = np.abs(inverse)
            entry = np.maximum(entry, middle - reach)
            leaving = np.minimum(leaving, middle + reach)
        return np.where((entry < leaving) & (entry > NEAR), entry, np.inf)

    def locate(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        x, y, z = self.axes @ (points - column(self.center))
        face = np.argmax(np.stack([x, y, -x, -y, z]), axis=0)
        # The inverse of `rights` and `downs` in place.
        along = np.choose(face, [y, -x, -y, x, x])
        down = np.where(face == 4, -y, -z)
        inside = 0.9999  # 1 would be on the next face of the image.
        return (face + np.clip(0.5 + 0.5 * along, 0, inside)) / 5, np.clip(0.5 + 0.5 * down, 0, inside)

    def place(self, u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        face = np.minimum((u * 5).astype(int), 4)
        along = 2 * (u * 5 - face) - 1
        down = 2 * v - 1
        normals = np.array([[1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0], [0, 0, 1]], np.float32)[face].T
        rights = np.array([[0, 1, 0], [-1, 0, 0], [0, -1, 0], [1, 0, 0], [1, 0, 0]], np.float32)[face].T
        downs = np.array([*[[0, 0, -1]] * 4, [0, -1, 0]], np.float32)[face].T
        to_world = self.axes.T * np.float32(self.half_side)
        points = to_world @ (normals + along * rights + down * downs) * self.half_side
        return points + column(self.center), to_world @ normals


ParametricSurface = Disc | Tube | Ball | Block


@dataclasses.dataclass(frozen=True, eq=False)
class Surface:
    """A shape with its image."""

    shape: ParametricSurface
    image: np.ndarray
    """[rows, columns, 3] uint8."""


def nearest_hits(
    shapes: Sequence[ParametricSurface], origins: np.ndarray, directions: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return (t, index of the shape), both [P], of the first hit of each ray; t is infinite if it misses all."""
    nearest = np.full(directions.shape[1], np.inf, np.float32)
    index = np.zeros(directions.shape[1], np.int8)  # For up to 127 shapes.
    for number, shape in enumerate(shapes):
        t = shape.hit(origins, directions)
        index[t < nearest] = number
        np.minimum(nearest, t, out=nearest)
    return nearest, index


def trace_rays(
    surfaces: Sequence[Surface], origin: np.ndarray, directions: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the colours [P, 3] uint8 and positions [3, P] float32 of the hits of rays [3, P] from one point [3, 1].

    Where nothing is hit, colours are black and positions not finite.
    """
    t, index = nearest_hits([surface.shape for surface in surfaces], origin, directions)
    points = origin + t * directions
    colors = np.zeros((len(t), 3), np.uint8)
    index[~np.isfinite(t)] = -1  # nearest_hits has 0 there, which is a shape.
    for number, surface in enumerate(surfaces):
        hits = np.flatnonzero(index == number)
        rows, columns = surface.image.shape[:2]
        u, v = surface.shape.locate(points[:, hits])
        row = np.clip((v * rows).astype(np.int32), 0, rows - 1)
        texel = row * columns + np.clip((u * columns).astype(np.int32), 0, columns - 1)
        colors[hits] = np.take(surface.image.reshape(-1, 3), texel, axis=0)
    return colors, points


def column(vector: Vector) -> np.ndarray:
    """Return [3, 1] float32."""
    return np.array(vector, np.float32)[:, None]


def squares(*components: np.ndarray) -> np.ndarray:
    """Return the sum of their squares."""
    return sum(component * component for component in components)


def quadratic_roots(a: np.ndarray, half_b: np.ndarray, c: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the smaller and the larger root of a·t² + 2·half_b·t + c, a > 0; NaN, which no comparison passes, without
    any."""
    discriminant = half_b * half_b - a * c
    root = np.sqrt(np.where(discriminant > 0, discriminant, np.float32(np.nan)))
    inverse = 1 / np.maximum(a, np.float32(1e-12))
    return (-half_b - root) * inverse, (-half_b + root) * inverse


def light(colored: list[tuple[ParametricSurface, np.ndarray]], rng: np.random.Generator) -> list[Surface]:
    """Return surfaces with images of the given colours, lit by a lamp with soft shadows and by the sky.

    Colours are [rows, columns, 3] float32 in [0, 1]; the generator turns the patterns of rays.
    """
    shapes = [shape for shape, _ in colored]
    surfaces = []
    for shape, colors in colored:
        rows, columns = (max(2, -(-size // TEXELS_PER_SAMPLE)) for size in colors.shape[:2])
        u, v = np.meshgrid((np.arange(columns) + 0.5) / columns, (np.arange(rows) + 0.5) / rows)
        points, normals = (x.astype(np.float32) for x in shape.place(u.ravel(), v.ravel()))
        points = points + np.float32(1e-3) * normals  # Off the surface, which would shade itself.
        # Of the sky, the share of the cosine-weighted hemisphere with nothing nearer than SKY_REACH.
        sky = np.zeros(points.shape[1], np.float32)
        for offset in fibonacci(NUM_SKY_RAYS, rng.uniform(0, 2 * np.pi)).astype(np.float32):
            # The sum of a normal and a random unit vector is distributed by the cosine; 0.999 keeps it from 0.
            directions = normals + np.float32(0.999) * offset[:, None]
            directions /= np.linalg.norm(directions, axis=0)
            sky += nearest_hits(shapes, points, directions)[0] > SKY_REACH
        # Of the lamp, the cosine of its direction times its visible share.
        lamp = np.zeros(points.shape[1], np.float32)
        for offset in fibonacci(NUM_LAMP_RAYS, rng.uniform(0, 2 * np.pi)).astype(np.float32):
            towards = LAMP + np.float32(LAMP_RADIUS) * offset[:, None] - points
            cosine = (towards * normals).sum(axis=0) / np.linalg.norm(towards, axis=0)
            is_free = nearest_hits(shapes, points, towards)[0] > 1  # The lamp is at 1.
            lamp += np.maximum(cosine, 0) * is_free
        coarse = SKY_LIGHT * (sky / NUM_SKY_RAYS)
        coarse = coarse + LAMP_LIGHT * (lamp / NUM_LAMP_RAYS)
        factors = colors.shape[0] / rows, colors.shape[1] / columns
        fine = zoom(coarse.reshape(rows, columns), factors, order=1, grid_mode=True, mode="nearest")
        image = np.rint(255 * np.clip(colors * fine[..., None], 0, 1)).astype(np.uint8)
        surfaces.append(Surface(shape, image))
    return surfaces
