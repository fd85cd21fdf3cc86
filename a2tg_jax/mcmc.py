"""Densification as Markov-chain Monte Carlo (3DGS-MCMC, Kheradmand et al., 2024) for flat Gaussians, at fixed shapes.

Arrays hold N rows, of which the first `num_live` exist; the count is traced, so growth never recompiles. Dead
Gaussians move onto live ones, and new rows are copies of live ones; both share their host's opacity and size so that
the image stays nearly the same.
"""

import dataclasses
import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from a2tg_jax.gaussians import Gaussians, logit, rotation_matrices

DEAD_OPACITY = 0.005
MAX_SHARES = 51
LARGEST_OPACITY = 1 - 2**-23
NOISE_SCALE = 5e5
NOISE_STEEPNESS = 100.0
NOISE_TRANSPARENCY = 0.995

QUADRATURE_END = 5.0
QUADRATURE_STEPS = 32


class MoveInfo(NamedTuple):
    """What an event did; scalars, traced."""

    num_dead: Array
    """Live rows found dead by `relocate`, all of them moved; 0 from `grow`."""
    num_added: Array
    """Rows added by `grow`; 0 from `relocate`."""
    has_hosts: Array
    """False when no Gaussian above the death opacity is left: nothing was changed, and training cannot go on."""


class MoveResult(NamedTuple):
    """What `relocate` and `grow` return."""

    gaussians: Gaussians
    moments: Any
    """As given, with the rows of the hosts (and of the added) at zero."""
    num_live: Array
    """int32."""
    info: MoveInfo


def relocate(key: Array, gaussians: Gaussians, moments, num_live: Array | int) -> MoveResult:
    """Moves each dead Gaussian (opacity at most 0.005) onto a live one, drawn with probability ∝ its opacity.

    Host and moved ones share the opacity and size of `share`; everything else is copied from the host. The moments
    of a host become zero; the moved rows keep theirs.

    Args:
      key: a random key.
      gaussians: N rows.
      moments: pytree of arrays with leading axis N, such as (mu, nu) of Adam.
      num_live: rows in use, 0 to N; may be traced.

    Returns:
      MoveResult, with `num_live` as given.

    Raises:
      ValueError: if a leaf of `moments` has another leading axis.
    """
    _check_moments(gaussians, moments)
    num_live = jnp.asarray(num_live, jnp.int32)
    is_live, is_host = _live_and_hosts(gaussians, num_live)
    is_dead = is_live & ~is_host
    has_hosts = jnp.any(is_host)
    hosts = draw_hosts(key, gaussians.opacities, is_host)
    gaussians, is_drawn = _copy_hosts(gaussians, hosts, is_dead & has_hosts)
    info = MoveInfo(jnp.sum(is_dead, dtype=jnp.int32), jnp.zeros((), jnp.int32), has_hosts)
    return MoveResult(gaussians, _zero_rows(moments, is_drawn), num_live, info)


def grow(key: Array, gaussians: Gaussians, moments, num_live: Array | int, cap: Array | int) -> MoveResult:
    """Grows the live count n to min(cap, max(n + 1, ⌊1.05·n⌋)) by copies of hosts drawn as in `relocate`.

    Hosts and added rows start with zero moments. A count at the cap or above stays.

    Args:
      key: a random key.
      gaussians: N rows.
      moments: pytree of arrays with leading axis N.
      num_live: rows in use, 0 to N; may be traced.
      cap: largest count, at most N; may be traced.

    Returns:
      MoveResult, with the new `num_live`.

    Raises:
      ValueError: if a cap that is not traced exceeds N, or a leaf of `moments` has another leading axis.
    """
    _check_moments(gaussians, moments)
    if not isinstance(cap, jax.core.Tracer) and int(cap) > gaussians.num:
        raise ValueError(f"cap must be at most the {gaussians.num} rows that are allocated; got {int(cap)}")
    num_live = jnp.asarray(num_live, jnp.int32)
    is_live, is_host = _live_and_hosts(gaussians, num_live)
    has_hosts = jnp.any(is_host)
    # n + ⌊n/20⌋ is ⌊1.05·n⌋ in integers, free of rounding.
    wanted = jnp.minimum(jnp.asarray(cap, jnp.int32), jnp.maximum(num_live + 1, num_live + num_live // 20))
    grown = jnp.where(has_hosts, jnp.maximum(wanted, num_live), num_live)
    is_added = ~is_live & (jnp.arange(gaussians.num, dtype=jnp.int32) < grown)
    hosts = draw_hosts(key, gaussians.opacities, is_host)
    gaussians, is_drawn = _copy_hosts(gaussians, hosts, is_added)
    info = MoveInfo(jnp.zeros((), jnp.int32), grown - num_live, has_hosts)
    return MoveResult(gaussians, _zero_rows(moments, is_drawn | is_added), grown, info)


def perturb(key: Array, gaussians: Gaussians, num_live: Array | int, lr: Array | float) -> Gaussians:
    """Adds exploration noise to the means of the live rows: Σ·ε·sigmoid(100·((1 - o) - 0.995))·lr·5e5.

    Σ = R S Sᵀ Rᵀ is the covariance of the flat splat (its third scale is 0), ε is standard normal: the noise stays
    in the splat's plane and dies out on opaque Gaussians.

    Args:
      key: a random key.
      gaussians: N rows.
      num_live: rows in use; may be traced.
      lr: the current learning rate of the means, in world units; may be traced.
    """
    means, dtype = gaussians.means, gaussians.means.dtype
    noise = jax.random.normal(key, means.shape, dtype)
    axes = rotation_matrices(gaussians.quats)[:, :, :2]
    # Sums of products instead of matmuls, which accelerators may round to fewer bits.
    in_plane = jnp.sum(axes * noise[:, :, None], axis=1) * gaussians.scales**2
    shift = jnp.sum(axes * in_plane[:, None, :], axis=2)
    transparency = jax.nn.sigmoid(-gaussians.logit_opacities)
    gate = jax.nn.sigmoid(NOISE_STEEPNESS * (transparency - NOISE_TRANSPARENCY))
    strength = gate * (jnp.asarray(lr, dtype) * NOISE_SCALE)
    is_live = jnp.arange(gaussians.num, dtype=jnp.int32) < jnp.asarray(num_live, jnp.int32)
    return dataclasses.replace(gaussians, means=jnp.where(is_live[:, None], means + shift * strength[:, None], means))


def share(logit_opacities: Array, log_scales: Array, num_shares: Array) -> tuple[Array, Array]:
    """Opacity and size with which `num_shares` coincident copies replace one Gaussian (3DGS-MCMC, relocation).

    o' = 1 - (1 - o)^(1/N), clamped to [0.005, 1 - 2⁻²³], keeps the opacity at the centre; the scales, multiplied by
    o / S(o', N), keep the integral of the opacity along a line through it.

    Args:
      logit_opacities: [N] of the originals.
      log_scales: [N, 2] of the originals.
      num_shares: [N] integers of at least 1; 1 leaves a row as it is.

    Returns:
      logit_opacities [N] and log_scales [N, 2] of each copy.
    """
    dtype = logit_opacities.dtype
    # log(1 - o) straight from the logit: 1 - o itself has no digits left when o is close to 1.
    log_transparency = jax.nn.log_sigmoid(-logit_opacities)
    opacities = -jnp.expm1(log_transparency / num_shares.astype(dtype))
    opacities = jnp.clip(opacities, DEAD_OPACITY, LARGEST_OPACITY)
    log_ratio = jax.nn.log_sigmoid(logit_opacities) - jnp.log(stacked_integral(opacities, num_shares))
    is_shared = num_shares > 1
    return (
        jnp.where(is_shared, logit(opacities), logit_opacities),
        jnp.where(is_shared[:, None], log_scales + log_ratio[:, None], log_scales),
    )


def stacked_integral(opacities: Array, num_shares: Array) -> Array:
    """S = π^(-1/2)·∫ [1 - (1 - o·e^(-x²))^N] dx: the opacity of N coincident Gaussians, integrated along a line.

    Equal to the binomial double sum of 3DGS-MCMC, without its cancellation. The integrand is even and entire, so the
    trapezoidal rule converges exponentially: 32 steps on [0, 5] are off by less than 1e-10 for N up to 51.

    Args:
      opacities: [N] in (0, 1).
      num_shares: [N] integers, 1 to 51.

    Returns:
      [N], positive; `opacities` itself where `num_shares` is 1.
    """
    count = num_shares.astype(opacities.dtype)
    spacing = QUADRATURE_END / QUADRATURE_STEPS

    def integrand(x: float | Array) -> Array:
        return -jnp.expm1(count * jnp.log1p(-opacities * jnp.exp(-jnp.asarray(x * x, opacities.dtype))))

    def add_node(node: Array, total: Array) -> Array:
        return total + integrand(node.astype(opacities.dtype) * spacing)

    # A loop over nodes, not an axis of nodes: the memory stays that of one value per row.
    half = jax.lax.fori_loop(1, QUADRATURE_STEPS + 1, add_node, 0.5 * integrand(0.0))
    return half * (2 * spacing / math.sqrt(math.pi))


def draw_hosts(key: Array, opacities: Array, is_host: Array) -> Array:
    """For every row a host, drawn independently with probability proportional to its opacity.

    Two draws, a block of about √N hosts and then a host in it: one cumulative sum over a million float32 weights
    would have a resolution of a tenth of a weight.

    Args:
      key: a random key.
      opacities: [N] in (0, 1).
      is_host: [N], which rows may be drawn.

    Returns:
      [N] int32 rows for which `is_host` holds; all 0 if there are none.
    """
    num = opacities.shape[0]
    width = 2 ** math.ceil(math.log2(num) / 2)
    num_blocks = -(-num // width)
    num_hosts = jnp.sum(is_host, dtype=jnp.int32)
    # Hosts come first, so that rounding in the sums can never lead to a row of weight zero between them.
    (rows,) = jnp.nonzero(is_host, size=num, fill_value=0)
    weights = jnp.where(jnp.arange(num, dtype=jnp.int32) < num_hosts, opacities[rows], 0.0)
    within = jnp.cumsum(jnp.pad(weights, (0, num_blocks * width - num)).reshape(num_blocks, width), axis=1)
    blocks = jnp.cumsum(within[:, -1])
    u_block, u_within = jax.random.uniform(key, (2, num), opacities.dtype)
    block = jnp.searchsorted(blocks, u_block * blocks[-1], side="right")
    block = jnp.minimum(block, jnp.maximum(num_hosts - 1, 0) // width).astype(jnp.int32)
    place = block * width + _first_above(within, block, u_within * within[block, -1])
    return rows[jnp.clip(place, 0, jnp.maximum(num_hosts - 1, 0))].astype(jnp.int32)


def _first_above(tables: Array, which: Array, targets: Array) -> Array:
    """The first column whose value exceeds the target, in row `which` of ascending `tables` [B, 2^k]; [N] int32."""
    step = tables.shape[1] // 2
    column = jnp.zeros_like(which)
    while step:
        is_below = tables[which, column + (step - 1)] <= targets
        column = jnp.where(is_below, column + step, column)
        step //= 2
    return column


def _live_and_hosts(gaussians: Gaussians, num_live: Array) -> tuple[Array, Array]:
    """[N] which rows are live, and which of those are above the death opacity."""
    is_live = jnp.arange(gaussians.num, dtype=jnp.int32) < num_live
    return is_live, is_live & (gaussians.opacities > DEAD_OPACITY)


def _copy_hosts(gaussians: Gaussians, hosts: Array, is_target: Array) -> tuple[Gaussians, Array]:
    """Overwrites the target rows with their hosts' after sharing; also [N], which rows served as a host."""
    num_draws = jnp.zeros(gaussians.num, jnp.int32).at[hosts].add(is_target.astype(jnp.int32))
    logit_opacities, log_scales = share(
        gaussians.logit_opacities, gaussians.log_scales, jnp.minimum(num_draws + 1, MAX_SHARES)
    )
    shared = dataclasses.replace(gaussians, logit_opacities=logit_opacities, log_scales=log_scales)
    source = jnp.where(is_target, hosts, jnp.arange(gaussians.num, dtype=jnp.int32))
    return shared[source], num_draws > 0


def _zero_rows(tree, is_zeroed: Array):
    """The pytree with the marked rows of every leaf at zero."""
    return jax.tree.map(lambda x: jnp.where(is_zeroed.reshape(-1, *[1] * (x.ndim - 1)), jnp.zeros_like(x), x), tree)


def _check_moments(gaussians: Gaussians, moments) -> None:
    """Raises ValueError unless every leaf has one row per Gaussian."""
    for leaf in jax.tree.leaves(moments):
        if leaf.ndim == 0 or leaf.shape[0] != gaussians.num:
            raise ValueError(f"every leaf of moments must have {gaussians.num} rows; got shape {leaf.shape}")
