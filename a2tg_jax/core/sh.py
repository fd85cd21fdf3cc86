"""Real spherical harmonics to degree 3, in the sign and order of 3DGS.

L = 16 bases, degree 0 first; (x, y, z) is a unit vector from the camera to the splat, in the world.
"""

import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import ArrayLike

from a2tg_jax.base.checks import LARGEST_NUMBER
from a2tg_jax.core.numerics import factor_to, normalize

NUM_BASES = (1, 4, 9, 16)
"""Number of bases of degrees 0 to the index."""
SH_C0 = 0.28209479177387814  # 1/(2·√π), the value of the basis function of degree 0


def sh_basis(directions: Array, num: int = 16) -> Array:
    """Return the first basis functions [..., num] at unit directions [..., 3]; `num` is one of `NUM_BASES`."""
    # Factors and signs of 3DGS's program, whose files hold coefficients of this basis.
    x = directions[..., 0]
    y = directions[..., 1]
    z = directions[..., 2]
    bases = [jnp.full_like(x, SH_C0)]
    if num > 1:
        bases += [-0.4886025119029199 * y, 0.4886025119029199 * z, -0.4886025119029199 * x]
    if num > 4:
        xx = x * x
        yy = y * y
        zz = z * z
        bases += [
            1.0925484305920792 * x * y,
            -1.0925484305920792 * y * z,
            0.31539156525252005 * (2 * zz - xx - yy),
            -1.0925484305920792 * x * z,
            0.5462742152960396 * (xx - yy),
        ]
    if num > 9:
        bases += [
            -0.5900435899266435 * y * (3 * xx - yy),
            2.890611442640554 * x * y * z,
            -0.4570457994644658 * y * (4 * zz - xx - yy),
            0.3731763325901154 * z * (2 * zz - 3 * xx - 3 * yy),
            -0.4570457994644658 * x * (4 * zz - xx - yy),
            1.445305721320277 * z * (xx - yy),
            -0.5900435899266435 * x * (xx - 3 * yy),
        ]
    return jnp.stack(bases, axis=-1)


def directions_from(center: Array, means: Array) -> Array:
    """Return the unit vectors [N, 3] from a camera's centre [3] to means [N, 3] at any distance."""
    offsets = means - center[None, :]
    # Far away, squares would overflow and gradients be NaN.
    return normalize(offsets * factor_to(LARGEST_NUMBER, [*offsets.T])[:, None])


def sh_sum(sh: Array, means: Array, center: Array, degree: ArrayLike) -> Array:
    """Return the view-dependent sums [N, 3], Σ Y_l·sh_l; colours are max(sum + 0.5, 0).

    Coefficients are [N, K, 3], K being 1, 4, 9 or 16, the camera's centre [3]. The highest degree used may be traced.
    """
    num = sh.shape[1]
    basis = sh_basis(directions_from(center, means), num)
    degrees = np.repeat(np.arange(4, dtype=np.int32), [1, 3, 5, 7])[:num]
    # A mask, not a slice: the degree may be traced.
    basis = jnp.where((degrees <= jnp.asarray(degree, jnp.int32))[None, :], basis, 0.0)
    # A sum, which CPUs do several times faster than many small matrix products.
    return jnp.sum(basis[:, :, None] * sh, axis=1)
