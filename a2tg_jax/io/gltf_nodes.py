"""Nodes of glTF: which of a scene have meshes, and where they are."""

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from a2tg_jax.host.text import shortened
from a2tg_jax.io.gltf_reader import Document

PARTS = {"translation": [0.0, 0.0, 0.0], "rotation": [0.0, 0.0, 0.0, 1.0], "scale": [1.0, 1.0, 1.0]}
"""Parts of a transform, and what they are if they are left out."""


def mesh_nodes(document: Document) -> Iterator[tuple[dict[str, Any], np.ndarray]]:
    """Yield the nodes of the scene that have a mesh, and the matrix [4, 4] from each to the world.

    Raises:
      ValueError: if a node is missing, occurs twice, or its transform is no numbers.
    """
    seen: set[int] = set()
    waiting = [(index, np.eye(4)) for index in reversed(_roots(document))]
    while waiting:
        index, parent = waiting.pop()
        node = document.entry("nodes", index)
        if index in seen:
            raise ValueError(f"its nodes[{index}] occurs twice")
        seen.add(index)
        with np.errstate(over="ignore", invalid="ignore"):
            matrix = parent @ local_matrix(node)
        if "mesh" in node:
            yield node, matrix
        waiting += [(child, matrix) for child in reversed(_indices(node, "children"))]


def _roots(document: Document) -> list[Any]:
    """Return the indices of the topmost nodes of the scene that is shown; without scenes of all."""
    if document.json.get("scenes"):
        return _indices(document.entry("scenes", document.json.get("scene", 0)), "nodes")
    nodes = document.json.get("nodes", [])
    children = {child for node in nodes for child in _indices(node, "children")}
    return [index for index in range(len(nodes)) if index not in children]


def _indices(described: Mapping[str, Any], name: str) -> list[Any]:
    indices = described.get(name, [])
    if not isinstance(indices, list):
        raise ValueError(f"{name} must be a list; got {shortened(indices)}")
    return indices


def local_matrix(node: Mapping[str, Any]) -> np.ndarray:
    """Return the matrix [4, 4] from a node to its parent, for columns."""
    if "matrix" in node:
        return _vector(node["matrix"], 16, "matrix").reshape(4, 4).T
    parts = {name: _vector(node.get(name, default), len(default), name) for name, default in PARTS.items()}
    x, y, z, w = parts["rotation"] / max(np.linalg.norm(parts["rotation"]), 1e-30)
    rotation = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    matrix = np.eye(4)
    matrix[:3, :3] = rotation * parts["scale"]
    matrix[:3, 3] = parts["translation"]
    return matrix


def _vector(values: Any, length: int, name: str) -> np.ndarray:
    is_right = isinstance(values, list) and len(values) == length and all(type(x) in (int, float) for x in values)
    if not is_right or not all(abs(x) < 1e30 for x in values):
        raise ValueError(f"{name} of a node must be {length} numbers; got {shortened(values)}")
    return np.asarray(values, np.float64)
