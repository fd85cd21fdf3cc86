"""Meshes of fewer triangles, by quadric decimation (host)."""

import importlib
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from a2tg_jax.mesh.triangles import Mesh


def check_simplifying(num_faces: int) -> Any:
    """Return the library fast-simplification.

    Raises:
      ValueError: if it is not installed, or the number of faces is not positive.
    """
    if num_faces < 1:
        raise ValueError(f"faces must be at least 1; got {num_faces}")
    try:
        return importlib.import_module("fast_simplification")
    except ImportError:
        raise ValueError(
            "fewer faces need fast-simplification, which is not installed: pip install 'a2tg-jax[mesh]'"
        ) from None


def simplify_mesh(mesh: Mesh, num_faces: int) -> Mesh:
    """Return a mesh of about `num_faces` triangles; the same if it has no more.

    Raises:
      ValueError: if fast-simplification is not installed, or the number is not positive.
    """
    library = check_simplifying(num_faces)
    if mesh.num_faces <= num_faces:
        return mesh
    vertices, faces = library.simplify(
        np.asarray(mesh.vertices, np.float32), mesh.faces, target_reduction=1 - num_faces / mesh.num_faces
    )
    colors = None if mesh.colors is None else mesh.colors[cKDTree(mesh.vertices).query(vertices)[1]]
    return Mesh(vertices, faces.astype(np.int32), colors).with_faces(np.arange(len(faces)))
