"""PLY files as SuperSplat packs them: sixteen bytes a Gaussian, within the bounds of its chunk of 256.

Elements: `chunk` (float: bounds of positions, log-scales and, in newer files, colours), `vertex` (four uint: position
and scale in 11, 10 and 11 bits; rotation as the index of its largest number and the three others in 10 bits; colour and
opacity in 8), and perhaps `sh` (uchar: spherical harmonics above degree 0). Unpacked they are vertices of 3DGS.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import BinaryIO

import numpy as np

from a2tg_jax.core.gaussians import SH_C0
from a2tg_jax.data.ply_header import VertexHeader, header_lines, read_headers

CHUNK = 256
AXES, CHANNELS = "xyz", "rgb"
BOUNDS = tuple(f"{end}_{what}{axis}" for what in ("", "scale_") for end in ("min", "max") for axis in AXES)
COLOR_BOUNDS = tuple(f"{end}_{channel}" for end in ("min", "max") for channel in CHANNELS)
PACKED = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
SH_RANGE = 8.0
"""Range of the coefficients that a byte stands for."""
LEAST_OPACITY = 1e-6


def is_packed(file: BinaryIO, path: Path) -> bool:
    """Return whether a PLY is packed so, with the file left at its beginning. Raises ValueError without a header."""
    elements = (words[1] for words in header_lines(file, path) if words[:1] == ["element"] and len(words) > 1)
    first = next(elements, "")
    file.seek(0)
    return first == "chunk"


def read_packed(file: BinaryIO, path: Path) -> np.ndarray:
    """Return the vertices of a packed PLY, structured, with the attribute names of 3DGS; float32.

    Raises:
      ValueError: naming the file, if it is cut off, not binary, or its elements do not fit each other.
    """
    headers = read_headers(file, path)
    if list(headers) not in (["chunk", "vertex"], ["chunk", "vertex", "sh"]):
        raise ValueError(f"{path}: a packed PLY has the elements chunk, vertex and sh; this one has {list(headers)}")
    _check(headers, path)
    tables = {name: header.read_binary(file) for name, header in headers.items()}
    num, vertex = headers["vertex"].count, tables["vertex"]
    bounds = {name: np.repeat(tables["chunk"][name], CHUNK)[:num] for name in tables["chunk"].dtype.names or ()}
    columns = _within(bounds, "", AXES, _unpacked(vertex["packed_position"], (11, 10, 11)), AXES)
    scales = _unpacked(vertex["packed_scale"], (11, 10, 11))
    columns |= _within(bounds, "scale_", AXES, scales, [f"scale_{k}" for k in range(3)])
    columns |= _rotations(vertex["packed_rotation"])
    columns |= _colors(bounds, vertex["packed_color"])
    rest = tables.get("sh", np.zeros(num, []))
    for name in rest.dtype.names or ():
        codes = rest[name].astype(np.float64)
        shares = np.where(codes == 0, 0.0, np.where(codes == 255, 1.0, (codes + 0.5) / 256))
        columns[name] = (shares - 0.5) * SH_RANGE
    found = np.empty(num, [(name, "<f4") for name in columns])
    for name, values in columns.items():
        found[name] = values
    return found


def _check(headers: Mapping[str, VertexHeader], path: Path) -> None:
    chunk, vertex = headers["chunk"], headers["vertex"]
    if vertex.encoding != "binary_little_endian":
        raise ValueError(f"{path}: is a packed PLY in {vertex.encoding}; binary_little_endian is expected")
    chunk.require(BOUNDS, "a PLY as SuperSplat packs it")
    vertex.require(PACKED, "a PLY as SuperSplat packs it")
    if any(vertex.fields[name] != "u4" for name in PACKED):
        raise ValueError(f"{path}: packed attributes must be uint; got {[vertex.fields[name] for name in PACKED]}")
    if chunk.count != -(-vertex.count // CHUNK):
        raise ValueError(f"{path}: has {chunk.count} chunks for {vertex.count} vertices; {CHUNK} are in each")
    rest = headers.get("sh")
    if rest is not None and (rest.count != vertex.count or set(rest.fields.values()) - {"u1"}):
        raise ValueError(f"{path}: sh must be uchar of each of the {vertex.count} vertices; got {rest.count}")


def _unpacked(packed: np.ndarray, bits: tuple[int, ...]) -> list[np.ndarray]:
    """Return numbers in [0, 1] of unsigned integers packed into one, the first highest."""
    found, shift = [], sum(bits)
    for num in bits:
        shift -= num
        found.append(((packed >> np.uint32(shift)) & np.uint32((1 << num) - 1)) / ((1 << num) - 1))
    return found


def _within(
    bounds: Mapping[str, np.ndarray], what: str, axes: str, shares: Sequence[np.ndarray], names: Sequence[str]
) -> dict[str, np.ndarray]:
    """Return columns scaled between their bounds."""
    ends = [(bounds[f"min_{what}{axis}"], bounds[f"max_{what}{axis}"]) for axis in axes]
    return {
        name: low * (1 - share) + high * share for name, (low, high), share in zip(names, ends, shares, strict=True)
    }


def _rotations(packed: np.ndarray) -> dict[str, np.ndarray]:
    """Return unit quaternions wxyz. The highest bits hold the index of the largest number, which follows from the
    others."""
    shares = _unpacked(packed & np.uint32((1 << 30) - 1), (10, 10, 10))
    others = np.stack([(share - 0.5) * np.sqrt(2) for share in shares])
    largest = np.sqrt(np.maximum(1 - np.sum(others**2, axis=0), 0.0))
    index = (packed >> np.uint32(30)).astype(np.int64)
    before, after = np.stack([*others, others[2]]), np.stack([others[0], *others])
    return {f"rot_{k}": np.where(index == k, largest, np.where(index > k, before[k], after[k])) for k in range(4)}


def _colors(bounds: Mapping[str, np.ndarray], packed: np.ndarray) -> dict[str, np.ndarray]:
    """Return coefficients of degree 0, and logits of opacities."""
    *colors, opacity = _unpacked(packed, (8, 8, 8, 8))
    if set(COLOR_BOUNDS) <= set(bounds):
        colors = list(_within(bounds, "", CHANNELS, colors, CHANNELS).values())
    opacity = np.clip(opacity, LEAST_OPACITY, 1 - LEAST_OPACITY)
    found = {f"f_dc_{k}": (color - 0.5) / SH_C0 for k, color in enumerate(colors)}
    return found | {"opacity": np.log(opacity) - np.log1p(-opacity)}
