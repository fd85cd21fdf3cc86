"""Flat 2D Gaussians: raw, differentiable parameters, their activations, initial values, and coincident copies.

N is the number of Gaussians; quaternions are wxyz and need not be unit.
"""

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import ArrayLike, DTypeLike

from a2tg_jax.base.checks import (
    FLOATS,
    LARGEST_NUMBER,
    check_array,
    check_floats,
    check_int,
    check_number,
    dtype_of,
    make_plain,
    plain_array,
    short_repr,
)
from a2tg_jax.base.named_fields import NamedFields
from a2tg_jax.base.user_warnings import warn
from a2tg_jax.core.numerics import safe_divide, safe_sqrt
from a2tg_jax.core.pytree import pytree
from a2tg_jax.core.sh import NUM_BASES, SH_C0

LARGEST_LOG_SCALE = math.log(LARGEST_NUMBER)
INITIAL_OPACITY = 0.1
MOST_ROUNDING = 0.1
"""Largest step of means in float32 without a warning, in units of the median scale."""
NO_ROW_LOG_SCALE = -10.0  # an opacity of 4.5e-5, far below 1/255
"""Log-scales and opacity logit of spare rows."""
COLOR_SLACK = 1e-3
"""Rounding by which colours may leave [0, 1]."""
LEAST_INITIAL_COLOR = 0.05
"""Least initial colour. At and below 0 the renderer's max(colour, 0) has no gradient that would raise it."""


@pytree
class Gaussians(NamedFields):
    """N flat Gaussians as unconstrained arrays, all of one dtype: float32, or float64.

    A Gaussian at (u, v), in standard deviations from its centre, has the weight exp(−(u² + v²)/2) (2DGS, Huang et al.,
    2024).

    Examples:
      >>> gaussians = a2tg.Gaussians(
      ...     means=jnp.zeros((2, 3)),
      ...     quats=jnp.zeros((2, 4)).at[:, 0].set(1.0),
      ...     log_scales=jnp.log(jnp.full((2, 2), 0.1)),
      ...     logit_opacities=jnp.zeros(2),
      ...     sh=jnp.zeros((2, 1, 3)),
      ... )
      >>> gaussians.num, gaussians.sh_degree, gaussians.floats_per_row
      (2, 0, 13)
    """

    means: Array
    """[N, 3] centres in the world."""
    quats: Array
    """[N, 4] rotations, wxyz, not necessarily unit."""
    log_scales: Array
    """[N, 2] logarithms of the standard deviations (s_x, s_y) along the first two axes."""
    logit_opacities: Array
    """[N] logits of the peak opacities."""
    sh: Array
    """[N, K, 3] spherical-harmonic coefficients of the colour, degree 0 first; K is 1, 4, 9 or 16."""

    __iter__ = None  # JAX indexing never raises IndexError, so iteration by __getitem__ would not terminate.

    def __post_init__(self) -> None:
        """Convert lists and NumPy's special arrays to plain arrays."""
        make_plain(self, "gaussians", "means", "quats", "log_scales", "logit_opacities", "sh")

    @property
    def num(self) -> int:
        """Number of rows N."""
        return self.means.shape[0]

    @property
    def sh_degree(self) -> int:
        """Highest degree of the spherical harmonics, 0 to 3."""
        return math.isqrt(self.sh.shape[1]) - 1

    @property
    def floats_per_row(self) -> int:
        """Number of floats of one Gaussian: 58 at degree 3, 13 at degree 0."""
        return floats_per_gaussian(self.sh_degree)

    @property
    def scales(self) -> Array:
        """[N, 2] standard deviations, positive."""
        return jnp.exp(self.log_scales)

    @property
    def sizes(self) -> Array:
        """[N] sizes √(s_x·s_y), the geometric means of both standard deviations."""
        return jnp.exp(jnp.mean(self.log_scales, axis=1))

    @property
    def rotations(self) -> Array:
        """[N, 3, 3] rotation matrices, whose columns are the Gaussians' axes in the world, the normal last."""
        columns = rotation_columns(tuple(jnp.moveaxis(self.quats, -1, 0)))
        return jnp.stack([jnp.stack(column, -1) for column in columns], -1)

    @property
    def opacities(self) -> Array:
        """[N] peak opacities in (0, 1)."""
        return jax.nn.sigmoid(self.logit_opacities)

    def __getitem__(self, rows: ArrayLike | slice) -> "Gaussians":
        """Return the Gaussians of the given rows (slice, mask or index array)."""
        return jax.tree.map(lambda x: x[rows], self)

    def __repr__(self) -> str:
        return short_repr(self)


def floats_per_gaussian(sh_degree: int = 3) -> int:
    """Return the number of floats of mean, rotation, scales, opacity and coefficients up to a degree."""
    return 10 + 3 * NUM_BASES[sh_degree]


def check_gaussians(gaussians: Gaussians, name: str = "gaussians") -> None:
    """Raise ValueError, naming the field, unless all fields have their shapes and one dtype, float32 or float64."""
    if not isinstance(gaussians, Gaussians):
        raise ValueError(f"{name} must be Gaussians; got {type(gaussians).__name__}")
    names = [field.name for field in dataclasses.fields(gaussians)]
    for field in names:
        check_array(f"{name}.{field}", getattr(gaussians, field))
    check_floats(f"{name}.means", gaussians.means, ("N", 3))
    num = gaussians.num
    check_floats(f"{name}.sh", gaussians.sh, (num, "K", 3))
    bases = gaussians.sh.shape[1]
    if bases not in NUM_BASES:
        raise ValueError(f"{name}.sh must be [{num}, K, 3] with K = 1, 4, 9 or 16, for degrees 0 to 3; got K = {bases}")
    shapes = {"quats": (num, 4), "log_scales": (num, 2), "logit_opacities": (num,)}
    for field, shape in shapes.items():
        check_floats(f"{name}.{field}", getattr(gaussians, field), shape)
    dtypes = {field: str(dtype_of(getattr(gaussians, field))) for field in names}
    # The error names the field that differs from most, whichever comes first.
    usual = max(dtypes.values(), key=[*dtypes.values()].count)
    if usual not in FLOATS:
        raise ValueError(f"{name} must be {' or '.join(FLOATS)}; got {usual}")
    for field, dtype in dtypes.items():
        if dtype != usual:
            others = ", ".join(other for other in names if dtypes[other] == usual)
            raise ValueError(f"{name}.{field} must be {usual} as {others} are; got {dtype}")


def rotation_columns(quat: tuple[Array, ...]) -> tuple[tuple[Array, ...], ...]:
    """Return the columns of the rotation of a quaternion (w, x, y, z), which is normalised first; element-wise."""
    w, x, y, z = quat
    norm = safe_sqrt(w * w + x * x + y * y + z * z)
    w, x, y, z = (safe_divide(number, norm) for number in quat)
    return (
        (1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)),
        (2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)),
        (2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)),
    )


def logit(p: Array) -> Array:
    """Return log(p / (1 - p)) for p in (0, 1)."""
    return jnp.log(p) - jnp.log1p(-p)


def init_from_points(
    points: ArrayLike,
    colors: ArrayLike,
    num: int | None = None,
    seed: int = 0,
    *,
    opacity: float = INITIAL_OPACITY,
    sh_degree: int = 3,
) -> Gaussians:
    """Make initial Gaussians from the points of a sparse reconstruction.

    Both log-scales are the logarithm of the root mean square distance to the 3 nearest neighbours. Rotations are
    uniformly random. SH of degree 0 come from the point's colour, higher degrees are 0.

    Args:
      points: [P, 3] positions, P >= 2.
      colors: [P, 3] floats, colours in [0, 1].
      num: number of Gaussians, at least 2; fewer than P are drawn without replacement, None takes all points.
      seed: seed of the drawing and the rotations.
      opacity: initial opacity, between 0 and 1.
      sh_degree: highest degree of spherical harmonics, 0 to 3.

    Returns:
      float32 Gaussians, min(num, P) of them. You are warned if float32 rounds their means coarsely, in map coordinates.

    Raises:
      ValueError: if the shapes disagree, there are fewer than two points, a number is not finite, colours are an array
        of integers or outside [0, 1], or another argument is outside its range.

    Examples:
      >>> gaussians = a2tg.init_from_points(scene.points, scene.colors, num=100, sh_degree=0)
      >>> gaussians.means.shape, gaussians.sh.shape
      ((100, 3), (100, 1, 3))
    """
    check_int("num", 2 if num is None else num, 2)
    check_int("sh_degree", sh_degree, 0, len(NUM_BASES) - 1)
    check_number("opacity", opacity, above=0, below=1)
    points = plain_array("points", points)
    colors = plain_array("colors", colors)
    values = np.asarray(colors)
    if hasattr(colors, "dtype") and not np.issubdtype(values.dtype, np.floating):
        raise ValueError(f"colors must be floats in [0, 1]; got {values.dtype}: divide bytes by 255")
    outside = values[(values < -COLOR_SLACK) | (values > 1 + COLOR_SLACK)]
    if outside.size:  # NaN is refused below.
        raise ValueError(f"colors must be in [0, 1]; got {outside.flat[0]:g}: divide bytes by 255")
    points = np.asarray(points, np.float64)
    colors = np.asarray(colors, np.float64)
    if points.ndim != 2 or points.shape[1] != 3 or points.shape != colors.shape:
        raise ValueError(f"points and colors must both be [P, 3]; got {points.shape} and {colors.shape}")
    if not (np.isfinite(points).all() and np.isfinite(colors).all()):
        raise ValueError("points and colors must be finite; some are NaN or infinite")
    rng = np.random.default_rng(seed)
    if num is not None and num < len(points):
        keep = np.sort(rng.choice(len(points), num, replace=False))
        points = points[keep]
        colors = colors[keep]
    if len(points) < 2:
        raise ValueError(f"at least two points are needed to choose scales; got {len(points)}")
    from scipy.spatial import cKDTree  # Not at import of the package, which would take 0.2 s longer.

    neighbours = min(3, len(points) - 1)
    # The nearest point of each is the point itself.
    distances = cKDTree(points).query(points, k=neighbours + 1)[0][:, 1:]
    # 1e-7 as in 3DGS's program: points that coincide would get a scale of 0.
    scales = np.sqrt(np.maximum(np.mean(distances**2, axis=1), 1e-7))
    rounding = float(np.spacing(np.abs(points).max().astype(np.float32)))
    if rounding > MOST_ROUNDING * np.median(scales):
        warn(
            f"points are in map coordinates, where means of float32 have steps of {rounding:g}, "
            f"{rounding / np.median(scales):.2g} of the Gaussians' size: subtract an offset from points and cameras"
        )
    count = len(points)
    # A normalised 4D normal is uniform over rotations.
    quats = rng.normal(size=(count, 4))
    arrays = (
        points,
        quats / np.linalg.norm(quats, axis=1, keepdims=True),
        np.repeat(np.log(scales)[:, None], 2, axis=1),
        np.full(count, np.log(opacity / (1 - opacity))),
        sh_of_colors(colors, sh_degree),
    )
    return Gaussians(*jax.device_put([array.astype(np.float32) for array in arrays]))


def sh_of_colors(colors: np.ndarray, sh_degree: int) -> np.ndarray:
    """Return initial coefficients [N, K, 3] of colours [N, 3] in [0, 1], raised to `LEAST_INITIAL_COLOR` at least."""
    sh = np.zeros((len(colors), NUM_BASES[sh_degree], 3))
    # Inverts the renderer's max(SH_C0·c + 0.5, 0).
    sh[:, 0] = (np.maximum(colors, LEAST_INITIAL_COLOR) - 0.5) / SH_C0
    return sh


def no_rows(num: int, num_coefficients: int, dtype: DTypeLike = jnp.float32) -> Gaussians:
    """Return rows that do not exist yet."""
    arrays = (
        np.zeros((num, 3), dtype),
        np.tile(np.asarray([1.0, 0.0, 0.0, 0.0], dtype), (num, 1)),
        np.full((num, 2), NO_ROW_LOG_SCALE, dtype),
        np.full(num, NO_ROW_LOG_SCALE, dtype),
        np.zeros((num, num_coefficients, 3), dtype),
    )
    return Gaussians(*jax.device_put(arrays))


# Coincident copies that together look like one Gaussian (3DGS-MCMC, Kheradmand et al., 2024, relocation)

DEAD_OPACITY = 0.005  # as in 3DGS-MCMC
MAX_SHARES = 51  # the largest number of copies in 3DGS-MCMC's program
LARGEST_OPACITY = 1 - 2**-23  # float32's ε below 1, so that its logit is finite
QUADRATURE_END = 5.0  # beyond it, 51·∫ e^(−x²) dx is less than 1e-10
QUADRATURE_STEPS = 32


def share(logit_opacities: Array, log_scales: Array, num_shares: Array) -> tuple[Array, Array]:
    """Return logit opacities [N] and log-scales [N, 2] of `num_shares` coincident copies that replace one Gaussian.

    o' = 1 - (1 - o)^(1/n), clamped to [0.005, 1 - 2⁻²³], keeps the opacity at the centre; the scales, multiplied by o /
    S(o', n), keep the integral of the opacity along a line through it. Rows with n = 1 stay unchanged.
    """
    dtype = logit_opacities.dtype
    opacities = shared_opacities(logit_opacities, num_shares.astype(dtype))
    log_ratio = jax.nn.log_sigmoid(logit_opacities) - jnp.log(stacked_integral(opacities, num_shares))
    is_shared = num_shares > 1
    return (
        jnp.where(is_shared, logit(opacities), logit_opacities),
        jnp.where(is_shared[:, None], log_scales + log_ratio[:, None], log_scales),
    )


def shared_opacities(logit_opacities: Array, num_shares: Array) -> Array:
    """Return 1 - (1 - o)^(1/n) [N], clamped to [0.005, 1 - 2⁻²³]: the opacity of n layers as opaque as one of o. The
    numbers n are floats of at least 1."""
    # log(1 - o) straight from the logit: 1 - o itself has no digits left when o is close to 1.
    log_transparency = jax.nn.log_sigmoid(-logit_opacities)
    return jnp.clip(-jnp.expm1(log_transparency / num_shares), DEAD_OPACITY, LARGEST_OPACITY)


def stacked_integral(opacities: Array, num_shares: Array) -> Array:
    """Return S = π^(-1/2)·∫ [1 - (1 - o·e^(-x²))^n] dx: the opacity of n coincident Gaussians, integrated along a line.

    Equal to the binomial double sum of 3DGS-MCMC, without its cancellation; o itself if n is 1. The integrand is even
    and entire, so the trapezoidal rule converges exponentially: 32 steps on [0, 5] are off by less than 1e-10 for n up
    to 51.
    """
    count = num_shares.astype(opacities.dtype)
    spacing = QUADRATURE_END / QUADRATURE_STEPS

    def integrand(x: float | Array) -> Array:
        return -jnp.expm1(count * jnp.log1p(-opacities * jnp.exp(-jnp.asarray(x * x, opacities.dtype))))

    def add_node(node: Array, total: Array) -> Array:
        # Without jit, JAX hands Python's integers to the body of a loop.
        return total + integrand(jnp.asarray(node, opacities.dtype) * spacing)

    # A loop over nodes, not an axis of nodes, so that memory stays one value per row. The integrand is even: half of
    # the line, where the node at 0 counts half, is doubled.
    half = jax.lax.fori_loop(1, QUADRATURE_STEPS + 1, add_node, 0.5 * integrand(0.0))
    return half * (2 * spacing / math.sqrt(math.pi))
