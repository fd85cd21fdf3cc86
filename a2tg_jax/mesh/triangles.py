"""Triangle meshes: colours or a texture, connected parts, fewer triangles, distances of surfaces (host)."""

import dataclasses
from typing import Any, NamedTuple

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from a2tg_jax import Similarity
from a2tg_jax.base.named_fields import NamedFields
from a2tg_jax.host.optional import optional

LEAST_FACES = 4
"""Smallest number of faces to simplify to: a closed mesh has four."""
MOST_POINTS = 200_000_000
"""Largest number of sampled points, of 24 bytes each, twice that during sampling."""
CHUNK = 1 << 20
"""Points that are placed at a time."""
FAR = 100.0
"""Distance from the origin, in extents, beyond which positions are relative to the middle, for float32."""


@dataclasses.dataclass(frozen=True, eq=False)
class Mesh(NamedFields):
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
        return self.vertices[self.faces]

    @property
    def face_normals(self) -> np.ndarray:
        """[F, 3] face normals, whose lengths are twice the areas."""
        a, b, c = self.corners.transpose(1, 0, 2)
        return np.cross(b - a, c - a)

    @property
    def area(self) -> float:
        """Area of all faces."""
        return float(np.linalg.norm(self.face_normals, axis=1).sum() / 2)

    def transform(self, similarity: Similarity) -> "Mesh":
        """Return the mesh in the world that `similarity` maps to."""
        return dataclasses.replace(self, vertices=similarity.apply(np.asarray(self.vertices, np.float64)))

    def with_faces(self, chosen: np.ndarray) -> "Mesh":
        """Return the mesh of some faces, by a mask [F] or indices, without unused vertices."""
        kept, inverse = np.unique(self.faces[chosen], return_inverse=True)
        faces = inverse.reshape(-1, 3).astype(np.int32)
        colors, uv = (None if rows is None else rows[kept] for rows in (self.colors, self.uv))
        return dataclasses.replace(self, vertices=self.vertices[kept], faces=faces, colors=colors, uv=uv)

    def __repr__(self) -> str:
        kind = "bare" if self.colors is None else "with colours"
        if self.texture is not None:
            kind = "with a texture"
        return f"Mesh({self.num_vertices:,} vertices, {self.num_faces:,} faces, {kind})"


def largest_clusters(mesh: Mesh, most: int, least_faces: int) -> tuple[Mesh, int]:
    """Return the largest connected parts, up to `most` with at least `least_faces` faces, and the number of others."""
    if not mesh.num_faces:
        return mesh, 0
    a, b, c = mesh.faces.T
    # Two edges of a triangle connect its three vertices.
    edges = (np.concatenate([a, b]), np.concatenate([b, c]))
    graph = coo_matrix((np.ones(len(edges[0]), bool), edges), [mesh.num_vertices] * 2)
    _, labels = connected_components(graph, directed=False)
    # By faces: one vertex of each, since all three have one label.
    _, cluster, sizes = np.unique(labels[a], return_inverse=True, return_counts=True)
    ranks = np.empty(len(sizes), int)
    # The inverse permutation: rank of each cluster by size.
    ranks[np.argsort(-sizes, kind="stable")] = np.arange(len(sizes))
    is_kept = (ranks < most) & (sizes >= least_faces)
    return mesh.with_faces(is_kept[cluster]), int((~is_kept).sum())


def far_middle(vertices: np.ndarray) -> np.ndarray:
    """Return the middle [3] of positions far from the origin; otherwise zeros."""
    low = vertices.min(axis=0)
    high = vertices.max(axis=0)
    middle = (low + high) / 2
    return middle if np.abs(middle).max() > FAR * (high - low).max() else np.zeros(3)


def check_simplifying(num_faces: int) -> Any:
    """Return the library fast-simplification. ValueError: it is not installed, or there are fewer than 4 faces."""
    if num_faces < LEAST_FACES:
        raise ValueError(f"faces must be at least {LEAST_FACES}; got {num_faces}")
    return optional("fast_simplification", "fewer faces need fast-simplification", "mesh")


def simplify_mesh(mesh: Mesh, num_faces: int) -> Mesh:
    """Return a mesh of about `num_faces` triangles, by quadric decimation; unchanged if it has no more.

    Args:
      mesh: a mesh.
      num_faces: number of triangles, at least 4.

    Returns:
      A mesh with vertex colours, without a texture.

    Raises:
      ValueError: if fast-simplification is not installed, the number is less than 4, or no face would be left.
    """
    library = check_simplifying(num_faces)
    if mesh.num_faces <= num_faces:
        return mesh
    middle = far_middle(mesh.vertices)
    vertices, faces = library.simplify(
        np.asarray(mesh.vertices - middle, np.float32), mesh.faces, target_reduction=1 - num_faces / mesh.num_faces
    )
    vertices = vertices + middle
    if not len(faces):
        raise ValueError(f"no faces are left of {mesh.num_faces:,}: choose more faces than {num_faces:,}")
    # Decimation moves vertices and drops colours: each takes the nearest old one's.
    colors = None if mesh.colors is None else mesh.colors[cKDTree(mesh.vertices).query(vertices)[1]]
    return Mesh(vertices, faces.astype(np.int32), colors).with_faces(np.arange(len(faces)))


# Distances between surfaces: accuracy, completeness, Chamfer distance and F-score of point samples


class SurfaceDistance(NamedTuple):
    """Distances between a surface and its reference, named as in DTU's evaluation."""

    accuracy: float
    """Mean distance of the surface's points from the reference, in scene units; lower is better."""
    completeness: float
    """Mean distance of the reference's points from the surface, in scene units; lower is better."""
    precision: float
    """Share of the surface's points within the threshold of the reference; higher is better."""
    recall: float
    """Share of the reference's points within the threshold of the surface; higher is better."""

    @property
    def chamfer(self) -> float:
        """Mean of accuracy and completeness, as DTU's evaluation of splats reports it; lower is better."""
        return (self.accuracy + self.completeness) / 2

    @property
    def f_score(self) -> float:
        """Harmonic mean of precision and recall, 0 if both are 0; higher is better."""
        total = self.precision + self.recall
        return 2 * self.precision * self.recall / total if total else 0.0


def surface_distance(
    points: np.ndarray, reference: np.ndarray, *, threshold: float, most: float = np.inf
) -> SurfaceDistance:
    """Compare the points of a surface with points of its reference.

    Args:
      points: [P, 3] points on the surface, such as from `sample_surface`.
      reference: [R, 3] points on the true surface.
      threshold: largest distance that counts as a match, for precision, recall and F-score.
      most: larger distances are left out of the means, as in DTU's evaluation with 20 mm.

    Returns:
      The distances; infinite means and shares of 0 if either has no points.
    """
    if not len(points) or not len(reference):
        return SurfaceDistance(np.inf, np.inf, 0.0, 0.0)
    forth, _ = cKDTree(reference).query(points, workers=-1)
    back, _ = cKDTree(points).query(reference, workers=-1)
    accuracy, completeness = (
        float(each[each < most].mean()) if (each < most).any() else np.inf for each in (forth, back)
    )
    return SurfaceDistance(accuracy, completeness, float((forth < threshold).mean()), float((back < threshold).mean()))


def sample_surface(mesh: Mesh, spacing: float, seed: int = 0) -> np.ndarray:
    """Return random points on a mesh, evenly by area, one for each square of side `spacing`.

    Args:
      mesh: a mesh.
      spacing: side of the square, in units of the mesh's world.
      seed: random seed.

    Returns:
      [P, 3] points.

    Raises:
      ValueError: if these are more than 200,000,000.
    """
    areas = np.linalg.norm(mesh.face_normals, axis=1) / 2
    wanted = np.ceil(areas.sum() / spacing**2) if len(areas) else 0
    if not wanted <= MOST_POINTS:
        raise ValueError(f"spacing {spacing:g} takes {wanted:.3g} points; give one for up to {MOST_POINTS:,}")
    num = int(wanted)
    points = np.zeros((num, 3))
    if not num:
        return points
    rng = np.random.default_rng(seed)
    ends = np.cumsum(areas)
    # Stratified by area: one point in each of num equal parts.
    chosen = np.searchsorted(ends, (np.arange(num) + rng.uniform(size=num)) * (ends[-1] / num))
    # The root makes (1 − a, a·(1 − b), a·b) uniform in a triangle.
    a = np.sqrt(rng.uniform(size=num))
    b = rng.uniform(size=num)
    # Rounding of the sum may lead beyond the last face.
    chosen = np.minimum(chosen, len(areas) - 1)
    for start in range(0, num, CHUNK):
        part = slice(start, start + CHUNK)
        weights = np.stack([1 - a[part], a[part] * (1 - b[part]), a[part] * b[part]], -1)
        points[part] = np.einsum("pk,pkc->pc", weights, mesh.vertices[mesh.faces[chosen[part]]])
    return points
