"""Densification as Markov-chain Monte Carlo (3DGS-MCMC, Kheradmand et al., 2024) for flat Gaussians, at fixed shapes.

Arrays hold N rows, of which the first `num_live` exist; the count is traced, so growth never recompiles. Dead
Gaussians move onto live ones, and new rows are copies of live ones; both share their host's opacity and size so that
the image stays nearly the same.
"""

import dataclasses
import functools
import math
from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from a2tg_jax.base.checks import check_count, check_fields, check_shape
from a2tg_jax.core.budget import number_to_reach
from a2tg_jax.core.gaussians import DEAD_OPACITY, MAX_SHARES, Gaussians, check_gaussians, share
from a2tg_jax.core.numerics import first_rows, where_rows
from a2tg_jax.core.optim import AdamState
from a2tg_jax.core.pytree import pytree, static
from a2tg_jax.core.table import bucket_capacity
from a2tg_jax.events import Change, EventInfo, Now, StepEvent, Times, clear_moments, gather_rows, multiples
from a2tg_jax.model import Model

# Constants of 3DGS-MCMC's program.
NOISE_SCALE = 5e5
NOISE_STEEPNESS = 100.0
NOISE_TRANSPARENCY = 0.995


class MoveInfo(NamedTuple):
    """Counts of one event; scalars, traced."""

    num_dead: Array
    """Live rows found dead by `relocate`, all of them moved if there are hosts; 0 from `grow`."""
    num_added: Array
    """Rows added by `grow`; 0 from `relocate`."""
    has_hosts: Array
    """False when no Gaussian above the death opacity is left: nothing was changed, and training cannot continue."""


class MoveResult(NamedTuple):
    """Result of `relocate` and `grow`."""

    gaussians: Gaussians
    """Rows after the moves."""
    moments: Any
    """Moments as given, with the rows of the hosts (and of the added) at zero; the count of Adam's state stays."""
    num_live: Array
    """int32 number of rows in use."""
    info: MoveInfo
    """Counts of the event."""


def relocate(key: Array, gaussians: Gaussians, moments: Any, num_live: Array | int) -> MoveResult:
    """Move each dead Gaussian (opacity at most 0.005) onto a live one, drawn with probability ∝ its opacity.

    Host and moved ones share opacity and size so that together they look like the host (3DGS-MCMC, Kheradmand et al.,
    2024); everything else is copied from the host. The moments of a host become zero; the moved rows keep theirs.

    Args:
      key: a random key.
      gaussians: N rows.
      moments: state of Adam (`adam_init(gaussians)`), or a pytree of arrays with leading axis N.
      num_live: rows in use, 0 to N; may be traced.

    Returns:
      The named tuple (gaussians, moments, num_live, info): rows and moments after the moves, `num_live` as given, and
      the scalars `num_dead`, `num_added` and `has_hosts`.

    Raises:
      ValueError: if a count that is not traced is no integer in 0..N, or a leaf of `moments` has another leading axis.

    Examples:
      >>> state = a2tg.adam_init(gaussians)
      >>> moved = a2tg.relocate(jax.random.key(0), gaussians, state, gaussians.num)
      >>> moved.gaussians.num, int(moved.num_live)
      (200, 200)
    """
    _check_moments(gaussians, moments, num_live)
    num_live = jnp.asarray(num_live, jnp.int32)
    return _moved(gaussians, moments, num_live, plan_relocation(key, gaussians.opacities, num_live))


def grow(key: Array, gaussians: Gaussians, moments: Any, num_live: Array | int, cap: Array | int) -> MoveResult:
    """Grow the live count n to min(cap, max(n + 1, ⌊1.05·n⌋)) by copies of hosts drawn as in `relocate`.

    3DGS-MCMC (Kheradmand et al., 2024).

    Hosts and added rows start with zero moments. A count at the cap or above stays.

    Args:
      key: a random key.
      gaussians: N rows.
      moments: state of Adam (`adam_init(gaussians)`), or a pytree of arrays with leading axis N.
      num_live: rows in use, 0 to N; may be traced.
      cap: largest count, at most N; may be traced.

    Returns:
      The named tuple (gaussians, moments, num_live, info): rows and moments with the copies, the new count, and the
      scalars `num_dead`, `num_added` and `has_hosts`.

    Raises:
      ValueError: if a count or a cap that is not traced is no integer in 0..N, or a leaf of `moments` has another
        leading axis.

    Examples:
      >>> state = a2tg.adam_init(gaussians)
      >>> grown = a2tg.grow(jax.random.key(0), gaussians, state, 100, cap=200)
      >>> int(grown.num_live)
      105
    """
    _check_moments(gaussians, moments, num_live)
    check_count("cap", cap, gaussians.num)
    num_live = jnp.asarray(num_live, jnp.int32)
    return _moved(gaussians, moments, num_live, plan_growth(key, gaussians.opacities, num_live, cap))


class Moves(NamedTuple):
    """Plan of which rows become copies of which; N rows, all traced."""

    rows: Array
    """[N] int32: row i becomes a copy of row rows[i], after sharing."""
    num_shares: Array
    """[N] int32: how many copies a row is shared among, 1 to 51."""
    is_reset: Array
    """[N]: rows whose moments become zero."""
    info: MoveInfo


DrawHosts = Callable[[Array, Array, Array], Array]
"""(key, is_host [N], is_target [N]) → [N] int32: the host of each target; the other entries are not used."""


def plan_relocation(key: Array, opacities: Array, num_live: Array, draw: DrawHosts | None = None) -> Moves:
    """Plan what `relocate` does to rows of these opacities [N], of which the first `num_live` exist. Hosts are drawn by
    `draw`, or with probability ∝ opacity."""
    is_live = first_rows(opacities.shape[0], num_live)
    is_host = is_live & (opacities > DEAD_OPACITY)
    is_dead = is_live & ~is_host
    has_hosts = jnp.any(is_host)
    info = MoveInfo(jnp.sum(is_dead, dtype=jnp.int32), jnp.zeros((), jnp.int32), has_hosts)
    return _copies(key, opacities, is_host, is_dead & has_hosts, info, draw)


def plan_growth(
    key: Array,
    opacities: Array,
    num_live: Array,
    cap: Array | int,
    least: Array | int = 0,
    draw: DrawHosts | None = None,
) -> Moves:
    """Plan what `grow` does to rows of these opacities [N], of which the first `num_live` exist. It grows to at least
    `least`, within the cap. Hosts are drawn as in `plan_relocation`."""
    num_rows = opacities.shape[0]
    is_live = first_rows(num_rows, num_live)
    is_host = is_live & (opacities > DEAD_OPACITY)
    has_hosts = jnp.any(is_host)
    # n + ⌊n/20⌋ is ⌊1.05·n⌋ in integers, free of rounding.
    grown = jnp.maximum(jnp.maximum(num_live + 1, num_live + num_live // 20), jnp.asarray(least, jnp.int32))
    grown = jnp.minimum(jnp.asarray(cap, jnp.int32), grown)
    grown = jnp.where(has_hosts, jnp.maximum(grown, num_live), num_live)
    is_added = ~is_live & first_rows(num_rows, grown)
    info = MoveInfo(jnp.zeros((), jnp.int32), grown - num_live, has_hosts)
    moves = _copies(key, opacities, is_host, is_added, info, draw)
    return moves._replace(is_reset=moves.is_reset | is_added)


def _copies(
    key: Array, opacities: Array, is_host: Array, is_target: Array, info: MoveInfo, draw: DrawHosts | None
) -> Moves:
    """Plan copies of drawn hosts in the rows of the targets; moments of the hosts become zero."""
    hosts = draw_hosts(key, opacities, is_host) if draw is None else draw(key, is_host, is_target)
    index = jnp.arange(hosts.shape[0], dtype=jnp.int32)
    num_draws = jnp.zeros(hosts.shape[0], jnp.int32).at[hosts].add(is_target.astype(jnp.int32))
    # The host itself keeps one of the shares.
    num_shares = jnp.minimum(num_draws + 1, MAX_SHARES)
    return Moves(jnp.where(is_target, hosts, index), num_shares, num_draws > 0, info)


def perturb(
    key: Array, gaussians: Gaussians, num_live: Array | int, lr: Array | float, scales: Array | None = None
) -> Gaussians:
    """Add exploration noise to the means of the live rows: Σ·ε·sigmoid(100·((1 - o) - 0.995))·lr·5e5.

    3DGS-MCMC (Kheradmand et al., 2024).

    Σ = R S Sᵀ Rᵀ is the covariance of the flat splat (its third scale is 0), ε is standard normal: the noise stays
    in the splat's plane and dies out on opaque Gaussians.

    Args:
      key: a random key.
      gaussians: N rows.
      num_live: rows in use; may be traced.
      lr: the current learning rate of the means, in world units; may be traced.
      scales: standard deviations along the first axes, [N, 2] or of ellipsoids [N, 3]; None: `gaussians.scales`.

    Returns:
      N Gaussians; only means of live rows differ.

    Raises:
      ValueError: if an argument has another shape than it must have.

    Examples:
      >>> noisy = a2tg.perturb(jax.random.key(0), gaussians, gaussians.num, lr=1e-4)
      >>> noisy.means.shape
      (200, 3)
    """
    check_gaussians(gaussians)
    check_count("num_live", num_live, gaussians.num)
    check_shape("lr", lr, ())
    scales = gaussians.scales if scales is None else jnp.asarray(scales)
    check_shape("scales", scales, (gaussians.num, 3 if np.shape(scales)[1:] == (3,) else 2))
    means = gaussians.means
    dtype = gaussians.means.dtype
    noise = jax.random.normal(key, means.shape, dtype)
    axes = gaussians.rotations[:, :, : scales.shape[1]]
    # Sums of products instead of matmuls, which accelerators may round to fewer bits.
    in_plane = jnp.sum(axes * noise[:, :, None], axis=1) * scales**2
    shift = jnp.sum(axes * in_plane[:, None, :], axis=2)
    # 1 − o, without the cancellation of the difference.
    transparency = jax.nn.sigmoid(-gaussians.logit_opacities)
    gate = jax.nn.sigmoid(NOISE_STEEPNESS * (transparency - NOISE_TRANSPARENCY))
    strength = gate * (jnp.asarray(lr, dtype) * NOISE_SCALE)
    is_live = first_rows(gaussians.num, jnp.asarray(num_live, jnp.int32))
    return dataclasses.replace(gaussians, means=jnp.where(is_live[:, None], means + shift * strength[:, None], means))


def draw_hosts(key: Array, opacities: Array, is_host: Array) -> Array:
    """Draw a host [N] int32 for every row, independently and with probability proportional to its opacity.

    Two draws, a block of about √N hosts and then a host in it: one cumulative sum over a million float32 weights would
    have a resolution of a tenth of a weight. All are 0 if no row may be drawn.
    """
    num = opacities.shape[0]
    if num == 0:
        return jnp.zeros(0, jnp.int32)
    # A power of two, for the bisection below.
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
    # Rounding may lead past the last block that has hosts.
    block = jnp.minimum(block, jnp.maximum(num_hosts - 1, 0) // width).astype(jnp.int32)
    # By bisection, the first column above the target in the block's ascending row.
    target = u_within * within[block, -1]
    column = jnp.zeros_like(block)
    step = width // 2
    while step:
        column = jnp.where(within[block, column + (step - 1)] <= target, column + step, column)
        step //= 2
    place = block * width + column
    return rows[jnp.clip(place, 0, jnp.maximum(num_hosts - 1, 0))].astype(jnp.int32)


def _moved(gaussians: Gaussians, moments: Any, num_live: Array, moves: Moves) -> MoveResult:
    """Copy rows from their hosts after sharing, and clear their moments."""
    logits, scales = share(gaussians.logit_opacities, gaussians.log_scales, moves.num_shares)
    copied = dataclasses.replace(gaussians, logit_opacities=logits, log_scales=scales)[moves.rows]
    # The only leaf without rows is the number of Adam's updates.
    moments = jax.tree.map(lambda x: where_rows(moves.is_reset, jnp.zeros_like(x), x) if x.ndim else x, moments)
    return MoveResult(copied, moments, num_live + moves.info.num_added, moves.info)


def _check_moments(gaussians: Gaussians, moments: object, num_live: Array | int) -> None:
    """Raise ValueError unless the Gaussians are well formed and every leaf has one row for each of them."""
    check_gaussians(gaussians)
    check_count("num_live", num_live, gaussians.num)
    rows = (moments.mu, moments.nu) if isinstance(moments, AdamState) else moments
    for path, leaf in jax.tree_util.tree_leaves_with_path(rows):
        if np.ndim(leaf) == 0 or np.shape(leaf)[0] != gaussians.num:
            name = f"moments{jax.tree_util.keystr(path)}"
            raise ValueError(
                f"moments must be adam_init(gaussians), or arrays with {gaussians.num} rows; got {name} of shape "
                f"{[*np.shape(leaf)]}"
            )


def densify_times(num_iterations: int) -> Times:
    """Return the times of densification: the paper's 500, 25,000 and every 100 of 30,000 iterations, scaled."""
    every = max(10, round(num_iterations / 300))
    return multiples(every, max(1, round(num_iterations / 60)), int(5 / 6 * num_iterations + 1e-9))


@pytree
class Noise(StepEvent):
    """Exploration noise on the means, after every iteration (`perturb`).

    3DGS-MCMC (Kheradmand et al., 2024).
    """

    def apply(self, now: Now, model: Model, moments: AdamState, state: tuple[()]) -> Change:
        gaussians = perturb(now.keys[0], model.gaussians, model.live_count, now.rate_of_means)
        return Change(dataclasses.replace(model, gaussians=gaussians), moments, state)


@pytree
class Mcmc(StepEvent):
    """Relocation of dead Gaussians and growth to a cap (`relocate`, `grow`), for any appearance.

    3DGS-MCMC (Kheradmand et al., 2024).

    Examples:
      >>> a2tg.Mcmc(cap=5000).num_rows(1000, 30_000)
      5000
      >>> system = a2tg.Gaussians2dMcmc.preset("quick", densify=a2tg.Mcmc(cap=5000))
    """

    cap: int = static(default=500_000)
    """Largest number of Gaussians; 0: none relocate, and their number stays. A memory_budget replaces it."""

    limited_by = "cap"
    num_keys: ClassVar[int] = 2
    impossible: ClassVar[str] = "no Gaussian above the death opacity is left"

    def check_options(self) -> None:
        if self.cap:
            check_fields(self, "cap", least=2)

    def times(self, num_iterations: int) -> Times:
        return densify_times(num_iterations) if self.cap else ()

    @property
    def most_gaussians(self) -> int | None:
        return self.cap or None

    def num_rows(self, num: int, num_iterations: int) -> int:
        """Return the cap, or the number that growth reaches, rounded up so that few shapes occur, if it is less than
        half of the cap."""
        num = self.grown(num, num_iterations)
        return max(num, self.cap if 2 * num >= self.cap else bucket_capacity(num))

    def grown(self, num: int, num_iterations: int) -> int:
        """Return the number of Gaussians after growth from `num` (host)."""
        for _ in self.times(num_iterations):
            if num < self.cap:
                num = min(self.cap, max(num + 1, num + num // 20))
        return num

    def apply(self, now: Now, model: Model, moments: AdamState, state: Any) -> Change:
        # Dead Gaussians move first: their new places can be hosts of what is added.
        moved, moments, _ = self._move(model, moments, functools.partial(plan_relocation, now.keys[0]))
        least = self.least(now, model.live_count)
        cap = min(self.cap, model.num_rows)
        plan = functools.partial(plan_growth, now.keys[1], cap=cap, least=least)
        model, moments, info = self._move(moved, moments, plan)
        return Change(model, moments, state, EventInfo(is_possible=info.has_hosts))

    def least(self, now: Now, num_live: Array) -> Array | int:
        """Return the least number of Gaussians after growth; traced."""
        return 0

    @staticmethod
    def _move(model: Model, moments: AdamState, plan: Callable[..., Moves]) -> tuple[Model, AdamState, MoveInfo]:
        num_live = model.live_count
        moves = plan(model.appearance.opacities(model.gaussians), num_live)
        # Shared before they are copied, so that copies get the shared values.
        gaussians, appearance = model.appearance.share(model.gaussians, moves.num_shares)
        num_live = num_live + moves.info.num_added
        shared = dataclasses.replace(model, gaussians=gaussians, appearance=appearance, num_live=num_live)
        return gather_rows(shared, moves.rows), clear_moments(model, moments, moves.is_reset), moves.info


@pytree
class FillingMcmc(Mcmc):
    """Variant of `Mcmc` that grows by more than 5 % where that is needed to reach the cap by its last event."""

    cap: int = static(default=500_000)
    """Largest number of Gaussians, at least 2. A memory_budget replaces it."""

    def check_options(self) -> None:
        check_fields(self, "cap", least=2)

    def num_rows(self, num: int, num_iterations: int) -> int:
        if num < self.cap and not self.times(num_iterations):
            raise ValueError(
                f"cap has room for {self.cap:,} Gaussians, but in {num_iterations} iterations there is no growth from "
                f"{num:,}"
            )
        return max(num, self.cap)

    def least(self, now: Now, num_live: Array) -> Array | int:
        assert now.num_left is not None
        return number_to_reach(num_live, self.cap, now.num_left)
