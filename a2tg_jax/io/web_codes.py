"""The numbers of a scene for browsers as bytes, chunk after chunk, and back; docs/formats.md has their order.

N rows in chunks, T texels. Columns come first: [C, N].
"""

import dataclasses
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from a2tg_jax.appearance.parts import log_exponents_of, shapes_of
from a2tg_jax.io import quantise
from a2tg_jax.io.model_rows import Rows
from a2tg_jax.io.quantise import Contraction, Ends
from a2tg_jax.texture import MAX_SIDE

BITS: Mapping[str, int] = {
    "log_scales": 8, "quats": 8, "opacities": 8, "sh_0": 8, "sh_1": 7, "sh_2": 6, "sh_3": 6, "colors": 8, "alphas": 8,
    "shapes": 8,
}  # fmt: skip
"""Bits of the numbers kept as a byte."""
MEANS_BITS = 16
LEAST_OPACITY = 1e-7
SCALE_RANGE = 16.0
"""Largest −log of a scale relative to the largest one; smaller scales, below a pixel in any full view, are raised."""


@dataclasses.dataclass(frozen=True)
class Codes:
    """A scene's numbers as bytes, in the file's order; columns first."""

    means: np.ndarray
    """Means [3, N], 16 bits each."""
    columns: np.ndarray
    """[9, N]: log-scales, x, y, z of the quaternions, opacity, and of degree 0 red − green, green, blue − green."""
    degrees: np.ndarray
    """[N]."""
    sizes: np.ndarray | None
    """[2, N]."""
    bands: tuple[np.ndarray, ...]
    """Band l > 0 is [3, 2l + 1, M]."""
    texels: np.ndarray | None
    """[4, T]."""
    shapes: np.ndarray | None
    """Logarithms [1, N] of the exponents of the kernels."""
    ends: Mapping[str, Any]
    """Ends of each group, for the header."""

    def chunk(self, start: int, stop: int) -> Iterator[bytes]:
        """Yield the pieces of one chunk."""
        rows = slice(start, stop)
        yield quantise.to_planes(self.means[:, rows], MEANS_BITS).tobytes()
        yield self.columns[:, rows].astype(np.uint8).tobytes()
        yield self.degrees[rows].astype(np.uint8).tobytes()
        if self.sizes is not None:
            yield self.sizes[:, rows].astype(np.uint8).tobytes()
        if self.shapes is not None:
            yield self.shapes[:, rows].astype(np.uint8).tobytes()
        for degree, band in enumerate(self.bands, 1):
            before = np.cumsum(np.concatenate([[0], self.degrees >= degree]))
            stop_row = min(stop, len(self.degrees))
            yield band[:, :, before[start] : before[stop_row]].astype(np.uint8).tobytes()
        if self.sizes is not None and self.texels is not None:
            before = np.cumsum(np.concatenate([[0], self.sizes.prod(axis=0)]))
            yield self.texels[:, before[start] : before[min(stop, len(self.degrees))]].astype(np.uint8).tobytes()


def codes_of(rows: Rows) -> Codes:
    ends: dict[str, list[float]] = {}

    def coded(name: str, values: np.ndarray, is_color: bool = False) -> np.ndarray:
        found = quantise.ends_of(values, BITS[name])
        ends[name] = list(found)
        codes = quantise.quantised(values, found, BITS[name])
        return quantise.green_apart(codes, 8) if is_color else codes

    means, axes = [], []
    for x in rows.means.T:
        contraction = Contraction.of(x)
        y = contraction.contracted(x)
        found = quantise.ends_of(y, MEANS_BITS)
        axes.append([*contraction, *found])
        means.append(quantise.quantised(y, found, MEANS_BITS))
    opacities = 1 / (1 + np.exp(-np.clip(rows.logit_opacities.astype(np.float64), -80, 80)))
    columns = [
        coded("log_scales", np.maximum(rows.log_scales, rows.log_scales.max(initial=-np.inf) - SCALE_RANGE).T),
        coded("quats", rows.quats[:, 1:].T),
        coded("opacities", opacities[None]),
        coded("sh_0", rows.bands[0][:, 0].T, is_color=True),
    ]
    bands = []
    for degree, band in enumerate(rows.bands[1:], 1):
        flat = coded(f"sh_{degree}", band.transpose(2, 1, 0).reshape(3, -1), is_color=True)
        bands.append(flat.reshape(3, 2 * degree + 1, -1))
    texels = None
    if rows.texels is not None:
        texels = np.concatenate(
            [coded("colors", signed_root(rows.texels[:, :3].T), is_color=True), coded("alphas", rows.texels[:, 3:].T)]
        )
    sizes = None if rows.sizes is None else rows.sizes.T
    shapes = None if rows.shapes is None else coded("shapes", log_exponents_of(rows.shapes)[None])
    means_and_ends = {"means": axes, "ends": ends}
    return Codes(
        np.array(means), np.concatenate(columns), rows.degrees, sizes, tuple(bands), texels, shapes, means_and_ends
    )


def rows_of_body(header: Mapping[str, Any], body: bytes) -> Rows:
    """Return the tables of a whole file."""
    reader, num, num_bands = ChunkReader(header, body), header["num"], header["num_bands"]
    chunks = [reader.chunk(min(header["chunk"], num - start)) for start in range(0, num, header["chunk"])]
    reader.end()

    def joined(name: str, *shape: int) -> np.ndarray:
        return np.concatenate([np.zeros((*shape, 0), np.int64), *(chunk[name] for chunk in chunks)], axis=-1)

    def values(name: str, codes: np.ndarray) -> np.ndarray:
        return quantise.dequantised(codes, Ends(*header["ends"][name]), BITS[name])

    codes = joined("means", 3)
    means = [
        Contraction(centre, spread).expanded(quantise.dequantised(x, Ends(low, high), MEANS_BITS))
        for x, (centre, spread, low, high) in zip(codes, header["means"], strict=True)
    ]
    columns = joined("columns", 9)
    opacities = np.clip(values("opacities", columns[5]), LEAST_OPACITY, 1 - LEAST_OPACITY)
    bands = [values("sh_0", quantise.with_green(columns[6:9], 8)).T[:, None]]
    for degree in range(1, num_bands):
        flat = joined(f"band_{degree}", 3, 2 * degree + 1)
        bands.append(values(f"sh_{degree}", quantise.with_green(flat, 8)).transpose(2, 1, 0))
    has_textures = header["num_texels"] is not None
    texels = joined("texels", 4)
    colors = signed_square(values("colors", quantise.with_green(texels[:3], 8))) if has_textures else None
    return Rows(
        means=np.stack(means, axis=-1),
        quats=quantise.with_w(values("quats", columns[2:5])),
        log_scales=values("log_scales", columns[:2]).T,
        logit_opacities=np.log(opacities) - np.log1p(-opacities),
        degrees=joined("degrees"),
        bands=tuple(bands),
        sizes=joined("sizes", 2).T if has_textures else None,
        texels=None if colors is None else np.concatenate([colors, values("alphas", texels[3:])]).T,
        shapes=shapes_of(values("shapes", joined("shapes", 1)[0])) if has_shapes(header) else None,
    )


def has_shapes(header: Mapping[str, Any]) -> bool:
    """Return whether a file holds shapes of kernels."""
    return "shapes" in header["ends"]


def signed_root(x: np.ndarray) -> np.ndarray:
    """Return √|x| with the sign of x, so that steps grow with the residual; most residuals are small."""
    root: np.ndarray = np.sign(x) * np.sqrt(np.abs(x))
    return root


def signed_square(x: np.ndarray) -> np.ndarray:
    """Return the inverse of `signed_root`."""
    square: np.ndarray = x * np.abs(x)
    return square


class ChunkReader:
    """Takes the chunks of a body one after the other, and never more than there is."""

    def __init__(self, header: Mapping[str, Any], body: bytes):
        self._header, self._body, self._place = header, body, 0

    def chunk(self, num: int) -> dict[str, np.ndarray]:
        """Return the codes of the next `num` rows."""
        found = {
            "means": quantise.from_planes(self._take(6, num), 3),
            "columns": self._take(9, num).astype(np.int64),
            "degrees": self._take(1, num)[0].astype(np.int64),
        }
        base, num_bands = self._header["base_degree"], self._header["num_bands"]
        if num and not base <= found["degrees"].min() <= found["degrees"].max() < num_bands:
            raise ValueError(f"degrees must lie in {base}..{num_bands - 1}")
        sizes = None
        if self._header["num_texels"] is not None:
            sizes = found["sizes"] = self._take(2, num).astype(np.int64)
        if has_shapes(self._header):
            found["shapes"] = self._take(1, num).astype(np.int64)
        for degree in range(1, num_bands):
            count = int(np.count_nonzero(found["degrees"] >= degree))
            flat = self._take(3 * (2 * degree + 1), count).astype(np.int64)
            found[f"band_{degree}"] = flat.reshape(3, 2 * degree + 1, count)
        found["texels"] = np.zeros((4, 0), np.int64)
        if sizes is not None:
            if sizes.max(initial=0) > MAX_SIDE or ((sizes == 0).any(axis=0) != (sizes == 0).all(axis=0)).any():
                raise ValueError(f"texture sides must lie in 1..{MAX_SIDE}, or both be 0")
            found["texels"] = self._take(4, int(sizes.prod(axis=0).sum())).astype(np.int64)
        return found

    def end(self) -> None:
        """Raise ValueError unless all has been read."""
        if self._place != len(self._body):
            raise ValueError(f"holds {len(self._body) - self._place} bytes more than its rows")

    def _take(self, num_columns: int, num: int) -> np.ndarray:
        count = num_columns * num
        if self._place + count > len(self._body):
            raise ValueError("holds fewer bytes than its rows need")
        columns = np.frombuffer(self._body, np.uint8, count, self._place).reshape(num_columns, num)
        self._place += count
        return columns
