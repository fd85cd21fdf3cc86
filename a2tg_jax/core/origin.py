"""The origin of a model: its training cameras, and the transform from the original world.

With an origin, a model can be rendered, flown past and moved without the photographs.
"""

import dataclasses
from collections.abc import Mapping, Sequence

import jax
import jax.numpy as jnp
import numpy as np

from a2tg_jax.base.checks import check_bounded, check_floats, check_shape
from a2tg_jax.base.named_fields import NamedFields
from a2tg_jax.base.text import shortened
from a2tg_jax.core.cameras import MAX_SKEW, Camera, check_calibration
from a2tg_jax.core.similarity import Similarity, check_similarity

Color = tuple[float, float, float]
BLACK: Color = (0.0, 0.0, 0.0)
WHITE: Color = (1.0, 1.0, 1.0)
FEWEST = 4
"""Smallest number of cameras whose right axes are trusted over their mean up."""
LEAST_SPREAD = 0.025
"""Smallest second eigenvalue of the right axes' moments: headings that spread by 9°."""
LARGEST_RATIO = 0.25
"""Largest ratio of their first to their second eigenvalue."""
LEAST_COSINE = 0.5
"""Smallest cosine between the vertical and the cameras' mean up."""


# eq=False: the generated == compares arrays, whose truth value is ambiguous.
@dataclasses.dataclass(frozen=True, eq=False)
class Origin(NamedFields):
    """V cameras and their world, on the host. Two origins are equal if all their numbers are."""

    viewmats: np.ndarray
    """[V, 4, 4] float64, world to camera."""
    Ks: np.ndarray
    """[V, 3, 3] float64, in pixels."""
    sizes: np.ndarray
    """[V, 2] integers (width, height)."""
    names: tuple[str, ...]
    """Names of the photographs."""
    is_test: np.ndarray
    """[V] whether the photograph was held out for testing."""
    transform: Similarity
    """Transform from the original world to the world of the cameras."""
    corrections: Mapping[str, np.ndarray] = dataclasses.field(default_factory=dict)
    """[V, ...] learned values of each photograph, by the name of the `Correction`, in the world of
    the training. `viewmats` are corrected already."""
    up: np.ndarray | None = None
    """[3] unit vertical that was chosen (`apply_edit`); None: it is estimated from the cameras."""

    @staticmethod
    def of_cameras(
        cameras: Sequence[Camera],
        names: Sequence[str] | None = None,
        *,
        is_test: Sequence[bool] | None = None,
        transform: Similarity | None = None,
    ) -> "Origin":
        """Make an origin of cameras; by default named by number, none held out, in their original world."""
        num = len(cameras)
        return Origin(
            # Reshaped, because without cameras the array has one axis.
            viewmats=np.array([camera.viewmat for camera in cameras], np.float64).reshape(num, 4, 4),
            Ks=np.array([camera.K for camera in cameras], np.float64).reshape(num, 3, 3),
            sizes=np.array([(camera.width, camera.height) for camera in cameras], np.int64).reshape(num, 2),
            names=tuple(str(index) for index in range(num)) if names is None else tuple(names),
            is_test=np.zeros(num, bool) if is_test is None else np.array(is_test, bool),
            transform=transform or Similarity(1.0, np.eye(3), np.zeros(3)),
        )

    @property
    def vertical(self) -> np.ndarray:
        """[3] unit vertical; without cameras −y, as in most files of splats."""
        if self.up is not None:
            return self.up
        return vertical_of(self.viewmats) if len(self.viewmats) else np.array([0.0, -1.0, 0.0])

    @property
    def cameras(self) -> list[Camera]:
        """Cameras in float32."""
        return [
            Camera(jnp.asarray(viewmat, jnp.float32), jnp.asarray(K, jnp.float32), int(width), int(height))
            for viewmat, K, (width, height) in zip(self.viewmats, self.Ks, self.sizes, strict=True)
        ]

    @property
    def training_cameras(self) -> list[Camera]:
        """Cameras of photographs that were trained on; all cameras if all were held out."""
        return self.cameras if self.is_test.all() else self._cameras_where(~self.is_test)

    @property
    def held_out_cameras(self) -> list[Camera]:
        """Cameras of photographs that were held out for testing; empty if all were, which then count as training
        cameras."""
        return [] if self.is_test.all() else self._cameras_where(self.is_test)

    def _cameras_where(self, is_chosen: np.ndarray) -> list[Camera]:
        return [camera for camera, is_one in zip(self.cameras, is_chosen, strict=True) if is_one]

    def moved(self, similarity: Similarity) -> "Origin":
        """Return the same cameras in the world that `similarity` leads to, without the corrections they contain."""
        viewmats = np.array([similarity.apply_to_viewmat(viewmat) for viewmat in self.viewmats]).reshape(-1, 4, 4)
        # Learned rows are in units of the world that is left here; `viewmats` contain them already.
        transform = self.transform.then(similarity)
        up = None if self.up is None else similarity.rotation @ self.up
        return dataclasses.replace(self, viewmats=viewmats, transform=transform, corrections={}, up=up)

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Origin):
            return NotImplemented
        leaves, structure = jax.tree.flatten(dataclasses.asdict(self))
        other_leaves, other_structure = jax.tree.flatten(dataclasses.asdict(other))
        return structure == other_structure and all(map(np.array_equal, leaves, other_leaves))  # type: ignore[operator]

    def __repr__(self) -> str:
        return f"Origin({len(self.names)} cameras, {int(np.sum(self.is_test))} of them for testing)"


def check_origin(origin: Origin) -> None:
    """Raise ValueError, naming the field, unless the cameras and the transform of an origin are valid."""
    cameras = zip(origin.names, origin.viewmats, origin.Ks, origin.sizes.tolist(), strict=True)
    for name, viewmat, K, (width, height) in cameras:
        check_calibration(viewmat, K, width, height, f"origin, camera {shortened(name)}")
    check_similarity(origin.transform, "origin.transform")
    if origin.up is not None:
        check_shape("origin.up", origin.up, (3,))
        if not abs(np.linalg.norm(origin.up) - 1) < MAX_SKEW:
            raise ValueError(f"origin.up must have unit length; got {np.asarray(origin.up).tolist()}")
    for name, rows in origin.corrections.items():
        check_floats(f"origin.corrections.{name}", rows, (len(origin.names), *np.shape(rows)[1:]))
        check_bounded(f"origin.corrections.{name}", rows)


def vertical_of(viewmats: np.ndarray) -> np.ndarray:
    """Return the vertical [3] of cameras [V, 4, 4], as the viewer estimates it (web/src/vertical.ts).

    It is the axis closest to perpendicular to all right axes in least squares, or the cameras' mean up if the right
    axes do not determine it.
    """
    up: np.ndarray = -viewmats[:, 1, :3].mean(axis=0)
    up /= max(float(np.linalg.norm(up)), 1e-12)
    rights = viewmats[:, 0, :3]
    # `eigh` sorts eigenvalues in ascending order: the first vector is nearest to perpendicular to all rights.
    (least, middle, _), vectors = np.linalg.eigh(rights.T @ rights / len(rights))
    axis: np.ndarray = vectors[:, 0]
    is_open = middle < LEAST_SPREAD or least > LARGEST_RATIO * middle
    if len(viewmats) < FEWEST or is_open or abs(axis @ up) < LEAST_COSINE:
        return up
    # The sign of an eigenvector is arbitrary.
    return np.asarray(axis * np.sign(axis @ up))
