"""Triangle meshes: vertices, faces, colours, and a texture atlas; on the host."""

import dataclasses

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from a2tg_jax.core.similarity import Similarity


@dataclasses.dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles with colours of vertices, or with a texture."""

    vertices: np.ndarray
    """[V, 3] float32 or float64 positions."""
    faces: np.ndarray
    """[F, 3] int32 indices of vertices, counter-clockwise seen from outside."""
    colors: np.ndarray | None = None
    """[V, 3] uint8 colours (sRGB) of the vertices."""
    uv: np.ndarray | None = None
    """[V, 2] float32 positions in the texture, from its lower left corner."""
    texture: np.ndarray | None = None
    """[H, W, 3] uint8 texture atlas (sRGB), first row on top."""

    @property
    def num_vertices(self) -> int:
        """Number of vertices."""
        return len(self.vertices)

    @property
    def num_faces(self) -> int:
        """Number of triangles."""
        return len(self.faces)

    @property
    def corners(self) -> np.ndarray:
        """[F, 3, 3] positions of the corners of each face."""
        corners: np.ndarray = self.vertices[self.faces]
        return corners

    @property
    def face_normals(self) -> np.ndarray:
        """[F, 3] normals of the faces, of twice the length of their areas."""
        a, b, c = self.corners.transpose(1, 0, 2)
        return np.cross(b - a, c - a)

    @property
    def area(self) -> float:
        """Area of all faces."""
        return float(np.linalg.norm(self.face_normals, axis=1).sum() / 2)

    @property
    def vertex_normals(self) -> np.ndarray:
        """[V, 3] unit normals of the vertices, the means of their faces' by area; zero at vertices without faces."""
        normals, of_faces = np.zeros((self.num_vertices, 3)), self.face_normals
        for corner in range(3):
            np.add.at(normals, self.faces[:, corner], of_faces)
        length = np.linalg.norm(normals, axis=1, keepdims=True)
        return np.asarray(normals / np.where(length > 0, length, 1.0), np.float32)

    def transform(self, similarity: Similarity) -> "Mesh":
        """Return the same mesh in the world that `similarity` leads to."""
        return dataclasses.replace(self, vertices=similarity.apply(np.asarray(self.vertices, np.float64)))

    def with_faces(self, chosen: np.ndarray) -> "Mesh":
        """Return the mesh of some faces, by a mask [F] or indices, without the vertices that no face needs."""
        faces = self.faces[chosen]
        kept, inverse = np.unique(faces, return_inverse=True)
        return dataclasses.replace(
            self,
            vertices=self.vertices[kept],
            faces=inverse.reshape(-1, 3).astype(np.int32),
            colors=None if self.colors is None else self.colors[kept],
            uv=None if self.uv is None else self.uv[kept],
        )

    def __repr__(self) -> str:
        kind = "with a texture" if self.texture is not None else "with colours" if self.colors is not None else "bare"
        return f"Mesh({self.num_vertices:,} vertices, {self.num_faces:,} faces, {kind})"


def clusters_of(mesh: Mesh) -> np.ndarray:
    """Return [F] the number of the connected part that a face belongs to, from 0."""
    a, b, c = mesh.faces.T
    rows, columns = np.concatenate([a, b]), np.concatenate([b, c])
    graph = coo_matrix((np.ones(len(rows), bool), (rows, columns)), (mesh.num_vertices, mesh.num_vertices))
    labels: np.ndarray = connected_components(graph, directed=False)[1][a]
    return labels


def largest_clusters(mesh: Mesh, most: int, least_faces: int) -> tuple[Mesh, int]:
    """Return the mesh of its largest connected parts, and the number of parts that are left out.

    Args:
      mesh: a mesh.
      most: largest number of parts to keep.
      least_faces: smallest number of faces of a part.
    """
    if not mesh.num_faces:
        return mesh, 0
    _, cluster, sizes = np.unique(clusters_of(mesh), return_inverse=True, return_counts=True)
    ranks = np.empty(len(sizes), int)
    ranks[np.argsort(-sizes, kind="stable")] = np.arange(len(sizes))
    is_kept = (ranks < most) & (sizes >= least_faces)
    return mesh.with_faces(is_kept[cluster]), int((~is_kept).sum())
