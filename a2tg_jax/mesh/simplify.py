"""Meshes of fewer triangles, by quadric decimation (host)."""

import importlib
from types import ModuleType

import numpy as np
from scipy.spatial import cKDTree

from a2tg_jax.mesh.triangles import Mesh

LEAST_FACES = 4
"""Smallest number of faces to simplify to, that of a closed mesh."""


def check_simplifying(num_faces: int) -> ModuleType:
    """Return the library fast-simplification.

    Raises:
      ValueError: if it is not installed, or the number of faces is less than 4.
    """
    if num_faces < LEAST_FACES:
        raise ValueError(f"faces must be at least {LEAST_FACES}; got {num_faces}")
    try:
        return importlib.import_module("fast_simplification")
    except ImportError:
        raise ValueError(
            "fewer faces need fast-simplification, which is not installed: pip install 'a2tg-jax[mesh]'"
        ) from None


def simplify_mesh(mesh: Mesh, num_faces: int) -> Mesh:
    """Return a mesh of about `num_faces` triangles; the same if it has no more.

    Raises:
      ValueError: if fast-simplification is not installed, the number is less than 4, or no face would be left.
    """
    library = check_simplifying(num_faces)
    if mesh.num_faces <= num_faces:
        return mesh
    vertices, faces = library.simplify(
        np.asarray(mesh.vertices, np.float32), mesh.faces, target_reduction=1 - num_faces / mesh.num_faces
    )
    if not len(faces):
        raise ValueError(f"no faces are left of {mesh.num_faces:,}: ask for more faces than {num_faces:,}")
    colors = None if mesh.colors is None else mesh.colors[cKDTree(mesh.vertices).query(vertices)[1]]
    return Mesh(vertices, faces.astype(np.int32), colors).with_faces(np.arange(len(faces)))
