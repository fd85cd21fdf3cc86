"""A model as plain tables of numbers in Z-curve order, and back.

Neighbouring rows are near each other in space, so that their numbers are similar. Each splat is turned by half about
one of its axes if that makes its rotation smaller, and its texture is mirrored with it: it looks the same.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np

from a2tg_jax import Appearance, Gaussians, Model, Origin
from a2tg_jax.appearance.files import arrays_of, with_arrays
from a2tg_jax.core.origin import Color
from a2tg_jax.core.sh import NUM_BASES
from a2tg_jax.model import check_model

HALF_TURNS = np.array(
    [
        [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]],
        [[0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 0, 1], [0, 0, -1, 0]],
        [[0, 0, -1, 0], [0, 0, 0, -1], [1, 0, 0, 0], [0, 1, 0, 0]],
        [[0, 0, 0, -1], [0, 0, 1, 0], [0, -1, 0, 0], [1, 0, 0, 0]],
    ],
    np.float64,
)
"""Row k: the matrix of q → q·(1, i, j, k) on wxyz, a half-turn about no axis, the first, the second, the third."""
U_MIRRORED = (2, 3)
"""Axes of half-turns that mirror a texture's columns."""
V_MIRRORED = (1, 3)
"""Axes of half-turns that mirror a texture's rows."""


@dataclasses.dataclass(frozen=True)
class Rows:
    """N splats; T texels in all. On the host."""

    means: np.ndarray
    """[N, 3]."""
    quats: np.ndarray
    """Unit quaternions [N, 4], w largest."""
    log_scales: np.ndarray
    """[N, 2]."""
    logit_opacities: np.ndarray
    """[N]."""
    degrees: np.ndarray
    """Degrees [N] of their spherical harmonics."""
    bands: tuple[np.ndarray, ...]
    """Band l is [M, 2l + 1, 3], of the M splats of degree l or more, in their order."""
    sizes: np.ndarray | None
    """Sizes [N, 2] of their textures, (Tv, Tu); None without textures."""
    texels: np.ndarray | None
    """Texels [T, 4], texture by texture, each row by row."""
    shapes: np.ndarray | None = None
    """Shapes [N] of their kernels; None if all are Gaussians."""


def check_encodable(
    appearance: Appearance, file: str = "a compact file", instead: str = "save_model keeps any model"
) -> None:
    """Raise ValueError, with the alternative, unless a file can hold an appearance."""
    if not appearance.is_portable:
        raise ValueError(
            f"model has {appearance.description}: {file} holds Gaussians with or without textures, exponents and "
            f"bands; {instead}"
        )


def rows_of_model(model: Model) -> Rows:
    """Return the tables of a valid model without unused rows, in its order."""
    gaussians = model.gaussians
    shown = arrays_of(model.appearance, gaussians.sh_degree)
    sh = np.asarray(gaussians.sh)
    # NUM_BASES[l] = (l + 1)², and band l has 2l + 1 coefficients.
    bands = [sh[:, NUM_BASES[degree] - 2 * degree - 1 : NUM_BASES[degree]] for degree in range(gaussians.sh_degree + 1)]
    degrees = np.full(gaussians.num, gaussians.sh_degree)
    if model.appearance.bands is not None:
        degrees = np.asarray(shown["degrees"], np.int64)
        bands += [shown[f"band_{degree}"] for degree in range(gaussians.sh_degree + 1, len(NUM_BASES))]
    tables = (shown.get(name) for name in ("sizes", "texels", "shapes"))
    return Rows(*columns_of(gaussians), degrees, tuple(bands), *tables)


def columns_of(gaussians: Gaussians) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return the first four fields of `Rows`, as Gaussians have them."""
    fields = (gaussians.means, gaussians.quats, gaussians.log_scales, gaussians.logit_opacities)
    means, quats, log_scales, logits = map(np.asarray, fields)
    return means, quats, log_scales, logits


def ordered(rows: Rows, order: np.ndarray, *, turns: bool = True) -> Rows:
    """Return the splats order[0], order[1], …

    Args:
      rows: the splats.
      order: indices [N].
      turns: turn splats by half if that makes their rotations smaller; otherwise only make w positive.
    """
    quats = with_positive_w(rows.quats[order])
    axis = np.zeros(len(order), np.int64)
    if turns:
        quats, axis = nearest_half_turn(rows.quats[order])
    degrees = rows.degrees[order]
    bands = []
    for degree, band in enumerate(rows.bands):  # The n-th splat of that degree or more has the n-th row.
        places = np.cumsum(rows.degrees >= degree) - 1
        bands.append(band[places[order[degrees >= degree]]])
    sizes = texels = shapes = None
    if rows.sizes is not None and rows.texels is not None:
        sizes = rows.sizes[order]
        texels = rows.texels[_texels(rows.sizes, order, axis)]
    if rows.shapes is not None:
        shapes = rows.shapes[order]
    columns = (rows.means[order], quats, rows.log_scales[order], rows.logit_opacities[order])
    return Rows(*columns, degrees, tuple(bands), sizes, texels, shapes)


def joined_rows(parts: Sequence[Rows]) -> Rows:
    """Return the splats of all parts, which have the same tables."""
    if len(parts) == 1:
        return parts[0]
    values = {field.name: [getattr(part, field.name) for part in parts] for field in dataclasses.fields(Rows)}
    bands = tuple(map(np.concatenate, zip(*values.pop("bands"), strict=True)))
    tables: dict[str, Any] = dict.fromkeys(values)
    for name, rows in values.items():
        if rows[0] is not None:
            tables[name] = np.concatenate(rows)
    return Rows(bands=bands, **tables)


def _texels(sizes: np.ndarray, order: np.ndarray, axis: np.ndarray) -> np.ndarray:
    """Return the old places of the texels of reordered and mirrored splats."""
    areas = sizes.prod(axis=1)
    # Exclusive sums: where each texture begins in the old table.
    starts = (np.cumsum(areas) - areas)[order]
    areas = areas[order]
    # The place of each texel within its texture, then its row and column, which a half-turn reverses.
    within = np.arange(areas.sum()) - np.repeat(np.cumsum(areas) - areas, areas)
    heights, widths = (np.repeat(side, areas) for side in sizes[order].T)
    row, column = np.divmod(within, np.maximum(widths, 1))
    row = np.where(np.repeat(np.isin(axis, V_MIRRORED), areas), heights - 1 - row, row)
    column = np.where(np.repeat(np.isin(axis, U_MIRRORED), areas), widths - 1 - column, column)
    return np.repeat(starts, areas) + row * widths + column


def nearest_half_turn(quats: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return unit quaternions [n, 4] after a half-turn about one of their axes, so that w is largest and not negative.

    A flat Gaussian is the same after half a turn about any of its axes; its texture is mirrored.

    Returns:
      The quaternions, float64, and [n] the axis about which each was turned: 0 is none, 1 to 3 are u, v and the normal.
    """
    quats = np.asarray(quats, np.float64)
    # w of q·(axis k) is −q[k]: turning about the axis of the largest number makes it w.
    axis = np.argmax(np.abs(quats), axis=1)
    # q and −q are one rotation: with w ≥ 0, w follows from x, y, z.
    return with_positive_w(np.einsum("nij,nj->ni", HALF_TURNS[axis], quats)), axis


def with_positive_w(quats: np.ndarray) -> np.ndarray:
    """Return the same rotations as unit quaternions [n, 4], float64, with w ≥ 0."""
    quats = np.asarray(quats, np.float64)
    norms = np.linalg.norm(quats, axis=1, keepdims=True)
    unit = np.where(norms > 0, quats / np.where(norms > 0, norms, 1.0), [1.0, 0.0, 0.0, 0.0])
    return unit * np.where(unit[:, :1] < 0, -1.0, 1.0)


def model_of(rows: Rows, base_degree: int, appearance: Appearance, origin: Origin | None, background: Color) -> Model:
    """Return the model of tables, float32.

    Args:
      rows: the tables.
      base_degree: degree of the spherical harmonics that all Gaussians have.
      appearance: template of the appearance.
      origin: origin of the model.
      background: RGB behind all splats.

    Raises:
      ValueError: if tables disagree.
    """
    sh = np.concatenate(rows.bands[: base_degree + 1], axis=1)
    fields = (rows.means, rows.quats, rows.log_scales, rows.logit_opacities, sh)
    gaussians = Gaussians(*(jnp.asarray(np.asarray(values, np.float32)) for values in fields))
    arrays: dict[str, np.ndarray] = {}
    if rows.sizes is not None and rows.texels is not None:
        arrays = {"sizes": rows.sizes, "texels": np.asarray(rows.texels, np.float32)}
    if rows.shapes is not None:
        arrays["shapes"] = np.asarray(rows.shapes, np.float32)
    if appearance.bands is not None:
        arrays |= {"degrees": rows.degrees, "base_degree": np.asarray(base_degree)}
        for degree, band in enumerate(rows.bands[base_degree + 1 :], base_degree + 1):
            arrays[f"band_{degree}"] = np.asarray(band, np.float32)
    shown = with_arrays(appearance, arrays, base_degree)
    model = Model(gaussians, shown, background=background, origin=origin)
    # The tables of a file may disagree in ways that only the whole model shows.
    check_model(model)
    return model
