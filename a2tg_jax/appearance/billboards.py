"""The appearance of BBSplat: flat RGBA pictures, whose alpha replaces opacity and Gaussian.

A picture of S × S texels covers u and v from −1 to 1, in standard deviations: texel (x, y) is at u = 2x/(S − 1) − 1,
v likewise, the outer ones on the border. It is looked up bilinearly among zeros, so that it fades out over one texel
beyond the border:

    α = min(max_alpha, A(u, v)),   colour = SH colour + RGB(u, v) − initial RGB

There is no low-pass filter. RGB is the sigmoid of the trained numbers. The authors lower the first SH coefficient so
that the initial colours stay; here the appearance subtracts the initial RGB, and the Gaussians stay unchanged.
"""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from a2tg_jax.appearance.base import Appearance
from a2tg_jax.appearance.parts import Factor, Residual
from a2tg_jax.core.bilinear import TextureRegion
from a2tg_jax.core.gaussians import Gaussians
from a2tg_jax.core.numerics import safe_divide
from a2tg_jax.core.pytree import pytree, static
from a2tg_jax.texture import MAX_SIDE, Textures, allocate_textures

INITIAL_PEAK = 0.5
"""Peak of the initial alpha picture."""
INITIAL_SIGMA = 0.3
"""Its σ, in units of u; at the border it has fallen to an invisible 0.002."""
LEAST_PEAK = 0.999 / 255  # rounding must not hide a picture that reaches 1/255


@pytree
class Billboards(Appearance):
    """Picture for each splat."""

    pictures: Textures | None = None
    """Pictures of N splats, S × S texels each: RGB before the sigmoid, and alpha; None until allocated."""
    side: int = static(default=16)
    """Side S of a picture in texels, 2 to 16."""
    initial_rgb: float = static(default=0.1)
    """Initial RGB, in (0, 1), which is subtracted."""

    has_low_pass = False
    replaced_floats = 1

    def __post_init__(self) -> None:
        """Check the ranges of the side and the colour."""
        super().__post_init__()
        if not 2 <= self.side <= MAX_SIDE:
            raise ValueError(f"side must be in 2..{MAX_SIDE}; got {self.side}")
        if not 0 < self.initial_rgb < 1:
            raise ValueError(f"initial_rgb must be in (0, 1); got {self.initial_rgb}")

    def atlas(self) -> tuple[Array, TextureRegion]:
        """Return the texels [T, 4], RGB in (0, 1) and alpha, and the places of the pictures."""
        bucket = self._bucket()
        row = self._rows()
        texels = jnp.concatenate([jax.nn.sigmoid(bucket[..., :3]), bucket[..., 3:]], axis=-1)
        first = row * jnp.int32(self.side**2)
        side = jnp.full_like(first, self.side)
        return texels.reshape(-1, 4), TextureRegion(first, side, side)

    def peak_opacities(self, gaussians: Gaussians) -> Array:
        # The picture's alpha is the whole opacity.
        return jnp.ones(gaussians.num, gaussians.means.dtype)

    def texel_position(self, region: TextureRegion, u: Array, v: Array) -> tuple[Array, Array]:
        return jnp.clip(self._place(u), 0.0, self.side - 1.0), jnp.clip(self._place(v), 0.0, self.side - 1.0)

    def shade(
        self, numbers: tuple[Array, ...], values: tuple[Array, ...], u: Array, v: Array
    ) -> tuple[Residual, Factor]:
        *rgb, alpha = values
        inside = self._inside(u) * self._inside(v)
        red, green, blue = (inside * channel - self.initial_rgb for channel in rgb)
        return (red, green, blue), inside * alpha

    def falloff(self, numbers: tuple[Array, ...], rho: Array) -> Array:
        return jnp.ones_like(rho)

    def cutoff(self, opacities: Array) -> Array:
        """Return the circle around the picture, border included."""
        bucket = self._bucket()
        peaks = jax.lax.stop_gradient(jnp.max(bucket[..., 3], axis=(1, 2)))[self._rows()]
        # Pictures fade out over one texel beyond ±1; a corner is at ρ = u² + v².
        half_side = 1 + 2 / (self.side - 1)
        return jnp.where(opacities * peaks >= LEAST_PEAK, 2 * half_side * half_side, -1.0)

    def _place(self, u: Array) -> Array:
        """Return the position of u along an axis, in texels."""
        return (u + 1) * ((self.side - 1) / 2)

    def _inside(self, u: Array) -> Array:
        """Return the factor that fades a clamped lookup out, as if zeros surrounded the picture: 1 up to the outer
        texels, 0 from one texel beyond them."""
        x = self._place(u)
        return jnp.clip(1 - jnp.maximum(-x, x - (self.side - 1.0)), 0.0, 1.0)

    def allocate(self, key: Array, gaussians: Gaussians) -> "Billboards":
        """Return pictures of a Gaussian, half opaque in the middle, that do not change the splats' colour."""
        pictures = allocate_textures(np.full((gaussians.num, 2), self.side), dtype=gaussians.means.dtype)
        along = np.exp(-0.5 * (np.linspace(-1, 1, self.side) / INITIAL_SIGMA) ** 2)
        picture = np.full((self.side, self.side, 4), np.log(self.initial_rgb / (1 - self.initial_rgb)))
        picture[..., 3] = INITIAL_PEAK * np.outer(along, along)
        if gaussians.num:
            (bucket,) = pictures.buckets
            filled = jnp.broadcast_to(jnp.asarray(picture, bucket.dtype)[None], bucket.shape)
            pictures = dataclasses.replace(pictures, buckets=(filled,))
        return dataclasses.replace(self, pictures=pictures)

    def project(self) -> "Billboards":
        """Return pictures with alpha clamped to [0, the upper limit]: above it nothing would ever fade again."""
        return self._with_alpha(lambda alpha: jnp.clip(alpha, 0.0, self.alpha_limit))

    def rates(self, rate: object) -> Any:
        """Return the rates of RGB and alpha, given as a pair, or one rate."""
        if not isinstance(rate, tuple):
            return rate
        rgb, alpha = rate
        assert self.pictures is not None
        rates = jnp.full((1, 1, 1, 4), rgb).at[..., 3].set(alpha)
        return dataclasses.replace(self, pictures=dataclasses.replace(self.pictures, buckets=(rates,)))

    def opacities(self, gaussians: Gaussians) -> Array:
        """Return the mean alpha [N] of the texels."""
        return self._means()[: gaussians.num]

    def limit_opacities(self, gaussians: Gaussians, most: Array) -> tuple[Gaussians, "Billboards"]:
        """Fade pictures whose mean alpha is larger than `most`, by one factor each."""
        bucket = self._bucket()
        fading = jnp.minimum(safe_divide(jnp.asarray(most, bucket.dtype), self._means(), 1.0), 1.0)
        return gaussians, self._with_alpha(lambda alpha: alpha * fading[:, None, None])

    def share(self, gaussians: Gaussians, num_shares: Array) -> tuple[Gaussians, "Billboards"]:
        """Fade pictures so that n coincident copies are together as opaque as one was; scales stay unchanged."""
        bucket = self._bucket()
        # One share leaves the rows of padding unchanged.
        num_shares = jnp.pad(num_shares, (0, bucket.shape[0] - gaussians.num), constant_values=1)
        exponents = (1 / num_shares.astype(bucket.dtype))[:, None, None]
        return gaussians, self._with_alpha(lambda alpha: 1 - (1 - alpha) ** exponents)

    @property
    def textures(self) -> Textures | None:
        return self.pictures

    def with_textures(self, textures: Textures) -> "Billboards":
        return dataclasses.replace(self, pictures=textures)

    def check_arrays(self, gaussians: Gaussians) -> None:
        if gaussians.num:
            self._bucket()

    def _bucket(self) -> Array:
        """Return the one bucket of pictures. Raise ValueError if there are several sizes."""
        sizes = None if self.pictures is None else self.pictures.bucket_sizes
        if self.pictures is None or sizes != ((self.side, self.side),):
            raise ValueError(f"pictures must all have {self.side} × {self.side} texels; got sizes {sizes}")
        return self.pictures.buckets[0]

    def _rows(self) -> Array:
        assert self.pictures is not None
        return self.pictures.nearest_places().row

    def _means(self) -> Array:
        """Return the mean alphas [capacity]."""
        return jnp.mean(self._bucket()[..., 3], axis=(1, 2))

    def _with_alpha(self, change: Callable[[Array], Array]) -> "Billboards":
        bucket = self._bucket()
        bucket = bucket.at[..., 3].set(change(bucket[..., 3]))
        assert self.pictures is not None
        return dataclasses.replace(self, pictures=dataclasses.replace(self.pictures, buckets=(bucket,)))
