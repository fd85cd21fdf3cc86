"""Procedural colours for the built-in scenes: float32 images [rows, columns, 3] in [0, 1], made by numpy alone.

Sizes are in texels. The palette is soft and the details are even on purpose. They are finer than a Gaussian but not
finer than its texels, so that a short training shows the benefit of textures.
"""

from collections.abc import Sequence

import numpy as np
from PIL import Image, ImageDraw, ImageFont
from scipy.ndimage import zoom


def _color(*rgb: float) -> np.ndarray:
    return np.array(rgb, np.float32)


CREAM = _color(0.85, 0.81, 0.71)
INK = _color(0.27, 0.31, 0.42)
BRICK = _color(0.68, 0.45, 0.37)
MORTAR = _color(0.73, 0.53, 0.45)
TEAL = _color(0.28, 0.54, 0.56)
GOLD = _color(0.87, 0.69, 0.38)
CORAL = _color(0.82, 0.45, 0.38)
SLATE = _color(0.47, 0.53, 0.60)
SKY = _color(0.47, 0.64, 0.79)
LEAF = _color(0.50, 0.62, 0.40)
BRICK_HUE = _color(0.0, 0.02, 0.02)
GROUT = _color(0.62, 0.58, 0.52)
VEIN = _color(0.48, 0.58, 0.60)
STONE = _color(0.86, 0.87, 0.84)
WALNUT = _color(0.52, 0.38, 0.27)
OAK = _color(0.68, 0.53, 0.38)
GAP = _color(0.48, 0.35, 0.25)


def coordinates(rows: int, columns: int) -> tuple[np.ndarray, np.ndarray]:
    """Return (u, v) of the texel centres, each [rows, columns] float32 in (0, 1); u along the columns."""
    u = (np.arange(columns, dtype=np.float32) + 0.5) / columns
    v = (np.arange(rows, dtype=np.float32) + 0.5) / rows
    return np.broadcast_to(u, (rows, columns)), np.broadcast_to(v[:, None], (rows, columns))


def mix(first: np.ndarray, second: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Return (1 - weight)·first + weight·second, [rows, columns, 3]."""
    return first + weight[..., None].astype(np.float32) * (second - first)


def fractal_noise(rng: np.random.Generator, rows: int, columns: int, cells: int, octaves: int = 2) -> np.ndarray:
    """Return smooth noise [rows, columns] of mean 0 within about ±1.5; the first octave has `cells` lattice cells a
    column."""
    noise = np.zeros((rows, columns), np.float32)
    for octave in range(octaves):
        lattice = (cells << octave, max(1, round((cells << octave) * columns / rows)))
        values = rng.uniform(-1, 1, (lattice[0] + 1, lattice[1] + 1)).astype(np.float32)
        factors = rows / values.shape[0], columns / values.shape[1]
        noise += zoom(values, factors, order=1, grid_mode=True, mode="nearest") * 0.5**octave
    return noise


def bricks(rng: np.random.Generator, rows: int, columns: int, size: tuple[int, int]) -> np.ndarray:
    """Return a brick wall; `size` is (height, width) of a brick with its mortar, in texels."""
    row, column = np.indices((rows, columns))
    course = row // size[0]
    shifted = column + (course % 2) * (size[1] // 2)
    shades = rng.uniform(-1, 1, (course.max() + 1, shifted.max() // size[1] + 1)).astype(np.float32)
    shade = shades[course, shifted // size[1]]
    color = BRICK * (1 + 0.08 * shade[..., None]) + shade[..., None] * BRICK_HUE
    gap = max(2, size[0] // 6)
    is_mortar = (row % size[0] < gap) | (shifted % size[1] < gap)
    color = np.where(is_mortar[..., None], MORTAR, color)
    return color * (1 + 0.06 * fractal_noise(rng, rows, columns, 24)[..., None])


def mosaic(rng: np.random.Generator, side: int, ring: int) -> np.ndarray:
    """Return a round mosaic of rings of nearly square stones, `ring` texels wide, in bands of zigzags, checks and
    stripes."""
    y, x = (np.indices((side, side), np.float32) + 0.5) - side / 2
    radius = np.hypot(x, y) / ring
    angle = np.arctan2(y, x) / (2 * np.pi) + 0.5
    index = radius.astype(int)
    sectors = 6 * np.maximum(index, 1)  # 2πr ≈ 6r: stones of ring r are nearly square.
    along = angle * sectors
    stone = np.minimum(along.astype(int), sectors - 1)
    palette = np.stack([CREAM, INK, CORAL, TEAL, GOLD])
    kind = np.select(
        [index % 9 < 4, index % 9 == 4, index % 9 < 8],
        [np.where((stone + index) % 2 == 0, 0, 1), 4, np.where((stone + 2 * index) % 6 < 3, 2, 0)],
        3,
    )
    shade = rng.uniform(0.92, 1.05, (index.max() + 1, sectors.max())).astype(np.float32)[index, stone]
    to_edge = np.minimum(radius - index, index + 1 - radius) * ring
    along_edge = np.minimum(along - stone, stone + 1 - along) * (2 * np.pi * radius * ring / sectors)
    grout = np.clip(np.minimum(to_edge, along_edge) - 0.6, 0, 1)[..., None]  # 0.6 texels, then a soft edge.
    return palette[kind] * shade[..., None] * grout + GROUT * (1 - grout)


def marble(rng: np.random.Generator, rows: int, columns: int) -> np.ndarray:
    """Return dark-veined stone."""
    u, v = coordinates(rows, columns)
    phase = 9 * u + 5 * v + 1.6 * fractal_noise(rng, rows, columns, 4, octaves=5)
    veins = np.abs(np.sin(np.pi * phase)) ** 0.6
    return mix(VEIN, STONE, veins)


def globe(rows: int, columns: int, num_checks: int) -> np.ndarray:
    """Return a ball in latitude and longitude: wedges of colour at the poles, `num_checks` checks around the
    equator."""
    u, v = coordinates(rows, columns)
    wedges = np.stack([CORAL, CREAM, GOLD, CREAM, TEAL, CREAM])[(u * 18).astype(int) % 6]
    checks = ((u * num_checks).astype(int) + (v * num_checks / 2).astype(int)) % 2
    color = np.where((np.abs(v - 0.5) < 0.17)[..., None], mix(CREAM, INK, checks), wedges)
    is_line = (np.abs(np.abs(v - 0.5) - 0.185) < 0.012) | (np.abs(np.abs(v - 0.5) - 0.40) < 0.012)
    return np.where(is_line[..., None], INK, color)


def checks(rows: int, columns: int, first: np.ndarray, second: np.ndarray, *, texels: int) -> np.ndarray:
    """Return a checked band of rows × columns squares, each `texels` wide."""
    row, column = np.indices((rows * texels, columns * texels)) // texels
    return mix(first, second, (row + column) % 2)


def cells(rng: np.random.Generator, rows: int, columns: int, *, texels: int) -> np.ndarray:
    """Return a grid of rows × columns squares of random colours, each `texels` wide."""
    colors = rng.uniform(0.2, 0.85, (rows, columns, 3)).astype(np.float32)
    return colors.repeat(texels, axis=0).repeat(texels, axis=1)


def barber_pole(rng: np.random.Generator, rows: int, columns: int) -> np.ndarray:
    """Return a column: oblique stripes, wider and steeper in each of three drums, with bands of keys between them."""
    u, v = coordinates(rows, columns)
    frequency = np.select([v < 0.34, v < 0.67], [12, 9], 6)
    stripe = ((u * frequency + v * 9) % 1.0) < 0.5
    color = np.where(stripe[..., None], TEAL, CREAM)
    near_band = np.minimum(np.abs(v - 0.34), np.abs(v - 0.67))
    keys = ((u * 24).astype(int) % 2 == 0) & (near_band < 0.025)
    color = np.where((near_band < 0.04)[..., None], np.where(keys[..., None], GOLD, INK), color)
    return color * (1 + 0.05 * fractal_noise(rng, rows, columns, 8)[..., None])


def planks(rng: np.random.Generator, side: int, width: int, length: int) -> np.ndarray:
    """Return a square floor of boards along the columns, `width` × `length` texels each, in two kinds of wood."""
    row, column = np.indices((side, side))
    board = row // width
    shifted = column + (board * 577) % length  # A prime step, so that joints do not line up.
    shades = rng.uniform(0, 1, (board.max() + 1, shifted.max() // length + 1)).astype(np.float32)
    shade = shades[board, shifted // length]
    u, v = coordinates(side, side)
    grain = np.sin(2 * np.pi * (90 * v + 3 * shade + 1.2 * fractal_noise(rng, side, side, 6) + u))
    color = mix(WALNUT, OAK, np.clip(shade + 0.12 * grain, 0, 1))
    is_gap = (row % width < max(2, width // 9)) | (shifted % length < max(2, width // 9))
    return np.where(is_gap[..., None], GAP, color)


def letter_block(letters: Sequence[str], side: int, colors: Sequence[np.ndarray]) -> np.ndarray:
    """Return the faces of toy blocks side by side: a framed letter each, the frame checked."""
    faces = []
    for letter, color in zip(letters, colors, strict=True):
        u, v = coordinates(side, side)
        edge = np.minimum(np.minimum(u, 1 - u), np.minimum(v, 1 - v))
        checks = ((u * 8).astype(int) + (v * 8).astype(int)) % 2
        face = mix(color, CREAM, np.where(edge < 1 / 8, checks, edge > 1.5 / 8))
        mask = text_mask(letter, side, side, 0.58 * side, repeat=False)
        faces.append(face + mask[..., None] * (color * 0.8 - face))
    return np.concatenate(faces, axis=1)


def text_mask(text: str, rows: int, columns: int, height: float, *, repeat: bool) -> np.ndarray:
    """Return the coverage [rows, columns] in [0, 1] of text in Pillow's own font, vertically centred."""
    font = ImageFont.load_default(height)
    canvas = Image.new("L", (columns, rows))
    draw = ImageDraw.Draw(canvas)
    left, top, right, bottom = font.getbbox(text)
    y = (rows - (bottom - top)) / 2 - top  # Glyphs begin `top` below the position of the text.
    x = 0.0 if repeat else (columns - (right - left)) / 2 - left
    while x < columns:
        draw.text((x, y), text, fill=255, font=font, stroke_width=max(1, round(height / 40)), stroke_fill=255)
        x += right - left + 0.6 * height if repeat else columns
    return np.asarray(canvas, np.float32) / 255
