"""Options of a rendering and its images: what `render_image` takes and returns."""

import dataclasses

import numpy as np
from jax import Array

from a2tg_jax.appearance import TextureOptions
from a2tg_jax.base.checks import check_int, check_kind, check_literal, check_number, short_repr
from a2tg_jax.base.named_fields import NamedFields
from a2tg_jax.core.cameras import Camera, resize_camera
from a2tg_jax.core.geometry import NEAR_PLANE
from a2tg_jax.core.notebook_display import as_bytes, enlarged, png
from a2tg_jax.core.pytree import pytree
from a2tg_jax.core.similarity import Similarity
from a2tg_jax.rasterize.kernels.platforms import MAX_TILE_SIZE
from a2tg_jax.rasterize.splats import CompositorChoice


@dataclasses.dataclass(frozen=True)
class RenderSettings(NamedFields):
    """Static options of a rendering; hashable, so that jit can close over them or take them as static.

    Examples:
      >>> settings = a2tg.RenderSettings(sh_degree=0, supersample=2)
      >>> model.render(camera, settings=settings).color.shape
      (36, 48, 3)
    """

    tile_size: int = 16
    """Side of a tile in pixels, 1 to 64; it does not change the image."""
    near_plane: float = NEAR_PLANE
    """Least depth of visible splats and hits, in units of the world; positive. If you scale the world, scale near_plane
    by the same factor (`transform`)."""
    sh_degree: int = 3
    """Highest degree of spherical harmonics used, 0 to 3."""
    texture: TextureOptions = dataclasses.field(default_factory=TextureOptions)
    """Texture options for Gaussians and textures given without a model (`render_image`, `plan_render`, `evaluate`).

    A `Model` and an appearance have their own options; this field is then not used."""
    capacity: int | None = None
    """Largest number of (splat, tile) pairs, at least 1, as `plan_render` finds it. None: an eager call finds it, jit
    raises. If it is too small, the image is only the background and `overflow` is True; an eager call then warns."""
    compositor: CompositorChoice = "auto"
    """Native loops (CPUs, with llvmlite), CUDA kernels (NVIDIA GPUs) or XLA. "auto" takes the first one that runs where
    the arrays are, and XLA with a warning if it does not support the appearance. These are differentiated once, in
    reverse mode; "autodiff", slower and by XLA, in any mode and to any order."""
    tile_batch: int | None = None
    """Number of tiles that XLA composites at once; 0: all. None: 1 on CPUs, 4096 elsewhere."""
    supersample: int = 1
    """Factor k by which views are drawn larger; each pixel is the mean over k × k. It lets a model be seen much smaller
    than it was trained without aliasing, at k² times the cost."""

    def __post_init__(self) -> None:
        """Refuse numbers out of range; convert numpy's integers to Python's, which are static for jit."""
        check_number("near_plane", self.near_plane, above=0)
        check_kind("texture", self.texture, TextureOptions)
        check_literal("compositor", self.compositor, CompositorChoice)
        for name, least, most in (("tile_size", 1, MAX_TILE_SIZE), ("sh_degree", 0, 3), ("supersample", 1, None)):
            check_int(name, getattr(self, name), least, most)
        for name, least in (("capacity", 1), ("tile_batch", 0)):
            if getattr(self, name) is not None:
                check_int(name, getattr(self, name), least, otherwise=", or None")
        for name, value in vars(self).items():
            if isinstance(value, np.integer):
                object.__setattr__(self, name, int(value))

    def finer(self, camera: Camera) -> Camera:
        """Return the view at the size at which it is drawn: `supersample` times its own."""
        factor = self.supersample
        return camera if factor == 1 else resize_camera(camera, factor * camera.width, factor * camera.height)

    def transform(self, similarity: Similarity) -> "RenderSettings":
        """Return the settings that show a model transformed by `similarity` as these show the model itself."""
        return dataclasses.replace(self, near_plane=self.near_plane * similarity.scale)

    @staticmethod
    def official() -> "RenderSettings":
        """Return settings with the texture conventions of the authors' program."""
        return RenderSettings(texture=TextureOptions.official())


@pytree
class Geometry(NamedFields):
    """Depth, normal and distortion of a view: weighted sums, not divided by alpha, without the background."""

    depth: Array
    """[H, W] Σ z·α·T."""
    normal: Array
    """[H, W, 3] Σ n·α·T, in the world, facing the camera."""
    distortion: Array
    """[H, W] the depth distortion of 2DGS, Σ_ij w_i w_j (z_i − z_j)² / 2, in world units squared."""

    def __repr__(self) -> str:
        return short_repr(self)


@pytree
class RenderOutput(NamedFields):
    """Images of a view."""

    color: Array
    """[H, W, 3], background included, not clipped; or [H, W, D] features."""
    alpha: Array
    """[H, W] in [0, 1], 1 − the final transmittance."""
    overflow: Array
    """Whether the capacity was too small; the image is then only the background and must not be used. Eager calls
    warn of it (`CapacityWarning`), jitted ones cannot."""
    geometry: Geometry | None = None
    """Depth, normal and distortion; None after a render with `has_geometry=False`."""

    @property
    def depth(self) -> Array:
        """[H, W] Σ z·α·T, not divided by alpha. Raises ValueError if there is no geometry."""
        return self._rendered("depth").depth

    @property
    def normal(self) -> Array:
        """[H, W, 3] Σ n·α·T, not divided by alpha, in the world. Raises ValueError if there is no geometry."""
        return self._rendered("normal").normal

    @property
    def distortion(self) -> Array:
        """[H, W] the depth distortion of 2DGS. Raises ValueError if there is no geometry."""
        return self._rendered("distortion").distortion

    def _rendered(self, name: str) -> Geometry:
        if self.geometry is None:
            raise ValueError(
                f"{name} was not rendered: use has_geometry=True, as in Term(function, has_geometry=True) for a custom "
                "loss term"
            )
        return self.geometry

    def __repr__(self) -> str:
        return short_repr(self)

    def _repr_png_(self) -> bytes | None:
        """Return the colour as a PNG file for notebooks; None for several views, or under a transformation."""
        pixels = as_bytes(self.color)
        return None if pixels is None else png(enlarged(pixels))
