"""Adaptive textures: the anisotropic rule, the selection, and the rebuild of the buckets (A²TG).

The event `Upscale` averages the statistic, proposes `next_sizes`, lets `select` choose who gets them, and calls
`reallocate`. Except for the statistic, all of it runs on the host, one array at a time.
"""

import math
from collections.abc import Sequence
from typing import Any, Literal, NamedTuple

import numpy as np
from jax.typing import ArrayLike

from a2tg_jax.base.checks import check_fields, check_int, check_literal, check_number, check_shape
from a2tg_jax.base.text import bytes_of
from a2tg_jax.core.budget import MOST_ROOM, event_budget, within_budget
from a2tg_jax.core.optim import AdamState
from a2tg_jax.core.pytree import pytree, static
from a2tg_jax.core.table import Layout, Size, resize
from a2tg_jax.events import Change, Due, GradientStatistics, HostEvent, Statistic, Times, times_at
from a2tg_jax.model import Model
from a2tg_jax.texture import BYTES_PER_TEXEL, MAX_SIDE, Textures, check_textures, checked_sizes

Axes = Literal["paper", "authors"]
"""Rule for the axis that a thin Gaussian doubles."""
PAPER_ITERATIONS = 30_000
PAPER_INTERVAL = 1 / 60
"""Share of a stage between two upscalings: the paper's 500 of 30,000 iterations."""
SHORT_INTERVAL = 0.15
"""The same in shorter stages, in which the statistic needs more time to settle."""
PAPER_THRESHOLD = 2e-5
"""k_G, in the unit of the authors' own statistic."""
USUAL_SHARE = 0.25
"""Default share of the Gaussians that grow, for forecasts."""


class ReallocateResult(NamedTuple):
    """Result of `reallocate`."""

    textures: Textures
    """Textures of the new sizes."""
    moments: Any
    """Moments as given, their textures rebuilt as the texels were."""


@pytree
class Upscale(HostEvent):
    """Gradient-driven selection, then anisotropic upscaling, of textures (A²TG).

    Examples:
      >>> event = a2tg.Upscale(select="fraction", fraction=0.1, cap=8, at=(0.25, 0.5))
      >>> event.times(1000)
      (250, 500)
    """

    select: Literal["fraction", "threshold", "budget"] = static(default="fraction")
    """Rule that chooses the Gaussians to upscale; a memory_budget sets "budget"."""
    fraction: float = 0.25
    """Share of the Gaussians upscaled at each event."""
    threshold: float | None = None
    """Smallest average gradient that is upscaled (k_G); needed by select="threshold"."""
    budget_mb: float | None = None
    """Largest reported memory in MB (10^6 bytes); for select="budget" only, which needs it. It bounds the textures
    alone, without the Gaussians; a memory_budget chooses both."""
    anisotropic: bool = static(default=True)
    """Whether thin Gaussians double one axis only; off: always both."""
    axes: Axes = static(default="paper")
    """Axis that a thin Gaussian doubles: the long one, or the short one as in the authors' program."""
    k_a: float = 4.0
    """Aspect ratio above which a Gaussian counts as elongated."""
    k_s: float = 0.01
    """Shorter scale, in units of the normalised world, below which an elongated Gaussian counts as thin."""
    cap: int = static(default=4)
    """Largest texture side in texels (at most 16)."""
    at: tuple[float, ...] | None = static(default=None)
    """Fractions of the stage after which textures grow; None: as often as it takes to reach the cap, every 1/60 of the
    stage as in the paper, every 0.15 in stages under 30,000 iterations."""
    gradient: Statistic = static(default="position")
    """Gradient that is averaged: by position in the world, as in the paper, or "screen": by the position on the
    screen, in units of half an image, and only where the low-pass filter decides, as in the authors' program."""
    moments: Literal["zero", "copied"] = static(default="zero")
    """Adam's moments of a texture that has grown: zero, so that its texels part quickly, or copied from its old
    texels."""

    @staticmethod
    def official() -> "Upscale":
        """Return the choices of the authors' own program."""
        return Upscale(
            select="threshold", threshold=PAPER_THRESHOLD, axes="authors", gradient="screen", moments="copied"
        )

    @property
    def statistic(self) -> Statistic:
        return self.gradient

    def check_options(self) -> None:
        check_fields(self, "cap", least=1, most=MAX_SIDE)
        check_fields(self, "fraction", least=0, most=1)
        check_fields(self, "k_a", least=1)
        check_fields(self, "k_s", "threshold", least=0)
        check_fields(self, "budget_mb", least=1e-6)
        if self.select == "budget" and self.budget_mb is None:
            raise ValueError("select is 'budget', so it needs budget_mb, in MB (10^6 bytes)")
        if self.select == "threshold" and self.threshold is None:
            raise ValueError("select is 'threshold', so it needs threshold, an average gradient")
        # The threshold of the authors' program may stay when another rule is chosen.
        for rule, name, usual in (("budget", "budget_mb", None), ("threshold", "threshold", PAPER_THRESHOLD)):
            number = getattr(self, name)
            if self.select != rule and number not in (None, usual):
                raise ValueError(
                    f"{name} is {number}, but select is {self.select!r}: set select to {rule!r}, or leave {name} out"
                )
        self.times(PAPER_ITERATIONS)  # checks `at`

    def times(self, num_iterations: int) -> Times:
        fractions = self.at
        if fractions is None:
            interval = SHORT_INTERVAL if num_iterations < PAPER_ITERATIONS else PAPER_INTERVAL
            rounds = math.ceil(math.log2(self.cap))
            fractions = tuple(interval * (index + 1) for index in range(rounds))
        return times_at(fractions, num_iterations)

    @property
    def _budget_bytes(self) -> int:
        assert self.budget_mb is not None, "refused by `check_options`"
        return bytes_of(self.budget_mb)

    def most_bytes(self, num_bytes: float, num: int, num_iterations: int) -> float:
        # An upscaling doubles both sides at most.
        texels = min(4.0 ** len(self.times(num_iterations)), self.cap**2)
        if self.select == "budget":
            return max(num_bytes, min(self._budget_bytes, num_bytes + BYTES_PER_TEXEL * num * texels))
        # Mostly the same textures grow each time, so one share of them reaches the largest size, from one texel. From
        # none it is one texel more. How many pass a threshold is unknown.
        share = self.fraction if self.select == "fraction" else USUAL_SHARE
        return num_bytes + BYTES_PER_TEXEL * num * share * (texels - 1)

    def with_room(
        self, model: Model, moments: AdamState, num_bytes: float, num_iterations: int
    ) -> tuple[Model, AdamState]:
        if model.textures is None or self.select != "budget":
            return model, moments
        textures = model.textures
        present = BYTES_PER_TEXEL * textures.count_elements(model.num)
        left = self._budget_bytes - num_bytes + present
        room = most_textures(textures.sizes, left, self.cap)
        # Padding would take too many bytes: steps are compiled again instead when textures grow.
        if BYTES_PER_TEXEL * room.num_elements > MOST_ROOM * self._budget_bytes:
            return model, moments
        rebuilt = reallocate(textures, textures.sizes, moments, room=room)
        return model.with_textures(rebuilt.textures), rebuilt.moments

    def apply(self, due: Due, model: Model, moments: AdamState, state: GradientStatistics) -> Change:
        if model.textures is None:
            raise ValueError(
                f"{model.appearance.description} cannot grow textures: the stage needs Appearance(texture=Texture())"
            )
        textures = model.textures
        # Only rows that exist can grow.
        num = model.num
        old_sizes = textures.sizes
        sizes = old_sizes[:num]
        scales = np.asarray(model.gaussians.scales)[:num]
        averages = np.asarray(state.average())[:num]
        proposed = self._proposed(sizes, scales, self.anisotropic, self.cap)
        if self.select == "budget":
            rule = {"budget_bytes": event_budget(self._budget_bytes, model.num_bytes, due.index, due.count)}
        else:
            rule = {self.select: getattr(self, self.select)}
        mask = select(averages, sizes, proposed, **rule)
        unused = self._unused(sizes[mask], scales[mask])
        grown = np.where(mask[:, None], proposed, sizes)
        # If the last event has bytes for every proposal, the remaining ones pay for further upscalings.
        if self.select == "budget" and due.index == due.count and (grown == proposed).all():
            left = rule["budget_bytes"] - _bytes_between(sizes, grown)
            grown = self._grown_within(left, grown, scales, averages)
        new_sizes = np.concatenate([grown, old_sizes[num:]])
        kept = None if self.moments == "copied" else (new_sizes == old_sizes).all(axis=1)
        rebuilt = reallocate(textures, new_sizes, moments, tuple(due.layouts), kept, textures.layout)
        due.layouts.add(rebuilt.textures.layout)
        model = model.with_textures(rebuilt.textures)
        return Change(model, rebuilt.moments, self.init(model), unused=unused)

    def _proposed(self, sizes: np.ndarray, scales: np.ndarray, anisotropic: bool, cap: int) -> np.ndarray:
        """Return the sizes after one upscaling of all textures."""
        return next_sizes(sizes, scales, k_a=self.k_a, k_s=self.k_s, cap=cap, anisotropic=anisotropic, axes=self.axes)

    def _grown_within(self, left: int, sizes: np.ndarray, scales: np.ndarray, averages: np.ndarray) -> np.ndarray:
        """Return sizes after as many upscalings as fit in the bytes that are left: by the event's rule, then of both
        axes."""
        for anisotropic in (self.anisotropic, False):
            while True:
                proposed = self._proposed(sizes, scales, anisotropic, self.cap)
                mask = select(averages, sizes, proposed, budget_bytes=left)
                if not mask.any():
                    break
                grown = np.where(mask[:, None], proposed, sizes)
                left -= _bytes_between(sizes, grown)
                sizes = grown
        return sizes

    def _unused(self, sizes: np.ndarray, scales: np.ndarray) -> str | None:
        """Return a sentence about options of anisotropy that differ from the defaults but made no difference to the
        textures that grow; None if there are none."""
        names = [name for name in ("anisotropic", "k_a", "k_s") if getattr(self, name) != getattr(Upscale, name)]
        if not names:
            return None
        # With the largest cap, because at `self.cap` both rules may give the same size.
        by_rule = self._proposed(sizes, scales, True, MAX_SIDE)
        doubled = self._proposed(sizes, scales, False, MAX_SIDE)
        if (by_rule != doubled).any():
            return None
        return f"{' and '.join(names)} made no difference: no Gaussian whose texture grew was elongated and thin"


def next_sizes(
    sizes: ArrayLike,
    scales: ArrayLike,
    *,
    k_a: float,
    k_s: float,
    cap: int,
    anisotropic: bool = True,
    axes: Axes = "paper",
) -> np.ndarray:
    """Return the texture sizes one upscaling would give (A²TG, anisotropic upscaling).

    s_x/s_y > k_A and s_y < k_S: Tu doubles. s_y/s_x > k_A and s_x < k_S: Tv doubles. Otherwise both double. Each
    axis stops at the cap, so that a 4×1 texture becomes 4×2 at a cap of 4. An empty texture grows as one of 1×1 does.
    Sizes of Gaussians whose scales are NaN or infinite do not change, so that `select` never chooses these.

    Args:
      sizes: [N, 2] integers (Tv, Tu).
      scales: [N, 2] standard deviations (s_x, s_y), in units of the normalised world.
      k_a: aspect ratio above which a Gaussian is elongated, at least 1.
      k_s: shorter scale below which an elongated Gaussian is thin.
      cap: largest side.
      anisotropic: False doubles both axes always.
      axes: "paper", or "authors": their program doubles the short axis of a thin Gaussian, Tv where s_x is the longer.

    Returns:
      [N, 2] int64 (Tv, Tu), never below `sizes`.

    Raises:
      ValueError: if the shapes differ, or a number is out of range.

    Examples:
      >>> a2tg.next_sizes([[1, 1], [1, 1]], [[0.1, 0.1], [0.1, 0.001]], k_a=4.0, k_s=0.01, cap=4)
      array([[2, 2],
             [1, 2]])
    """
    sizes = checked_sizes(sizes)
    check_shape("scales", scales, sizes.shape)
    scales = np.asarray(scales)
    if (scales < 0).any():
        raise ValueError(f"scales must be positive standard deviations; got {scales.min():g}: use gaussians.scales")
    check_number("k_a", k_a, least=1)
    check_number("k_s", k_s, least=0)
    check_int("cap", cap, 1, MAX_SIDE)
    check_literal("axes", axes, Axes)
    s_x, s_y = scales.T
    is_thin_u = anisotropic & (s_x > k_a * s_y) & (s_y < k_s)
    is_thin_v = anisotropic & (s_y > k_a * s_x) & (s_x < k_s)
    if axes == "authors":
        is_thin_u, is_thin_v = is_thin_v, is_thin_u
    doubles = np.stack([~is_thin_u, ~is_thin_v], axis=1)
    present = np.maximum(sizes, 1)
    # The maximum keeps sides that are above the cap already.
    grown = np.where(doubles, np.maximum(present, np.minimum(2 * present, cap)), present)
    return np.where(np.isfinite(scales).all(axis=1, keepdims=True), grown, sizes)


def most_textures(sizes: np.ndarray, num_bytes: float, cap: int) -> Layout:
    """Return a layout with room for all textures that `next_sizes` can make of sizes [N, 2] within a number of bytes
    (host)."""
    reached = np.unique(sizes, axis=0)
    num_before = 0
    while len(reached) > num_before:
        num_before = len(reached)
        larger = [
            # With these limits every Gaussian that is not round is thin.
            next_sizes(reached, np.broadcast_to(scales, reached.shape), k_a=1.0, k_s=math.inf, cap=cap)
            for scales in ((1.0, 1.0), (2.0, 1.0), (1.0, 2.0))  # Round; thin along each axis.
        ]
        reached = np.unique(np.concatenate([reached, *larger]), axis=0)
    counts: dict[Size, int] = {}
    for height, width in reached.tolist():
        # Textures of one size alone may take all bytes.
        area = height * width
        count = int(min(len(sizes), num_bytes // (BYTES_PER_TEXEL * area))) if area else len(sizes)
        if count > 0:
            counts[height, width] = count
    return Layout.of(counts)


def select(
    statistic: ArrayLike,
    sizes: ArrayLike,
    proposed: ArrayLike,
    *,
    threshold: float | None = None,
    fraction: float | None = None,
    budget_bytes: float | None = None,
) -> np.ndarray:
    """Choose the Gaussians that receive their proposed size, by exactly one of three rules.

    * threshold: those whose statistic exceeds it.
    * fraction: the round(fraction·N) largest statistics, halves rounded up, out of the Gaussians that can still grow
      and have a statistic above 0.
    * budget_bytes: in descending order of statistic per added byte, each Gaussian whose added texels still fit in
      what is left of the budget; one that does not fit is skipped and the search continues. What stays unspent is less
      than the cheapest upscale not chosen. Gaussians with a statistic of 0 come last.

    Equal values are taken in the order of the Gaussians. A Gaussian that cannot grow is never selected.

    Args:
      statistic: [N], at least 0.
      sizes: [N, 2] current (Tv, Tu).
      proposed: [N, 2] from `next_sizes`.
      threshold: in the unit of the statistic.
      fraction: in [0, 1].
      budget_bytes: bytes that this event may add (16 a texel), at least 0.

    Returns:
      [N] bool.

    Raises:
      ValueError: unless exactly one rule is given, in its range, and the shapes agree.

    Examples:
      >>> sizes, proposed = np.ones((3, 2), int), np.full((3, 2), 2)
      >>> a2tg.select(np.array([0.3, 0.1, 0.2]), sizes, proposed, budget_bytes=100)
      array([ True, False,  True])
    """
    statistic = np.asarray(statistic)
    sizes = checked_sizes(sizes)
    proposed = checked_sizes(proposed, "proposed")
    check_shape("statistic", statistic, ("N",))
    check_shape("sizes", sizes, (len(statistic), 2))
    check_shape("proposed", proposed, (len(statistic), 2))
    if sum(rule is not None for rule in (threshold, fraction, budget_bytes)) != 1:
        raise ValueError("select needs exactly one of threshold, fraction and budget_bytes")
    added_bytes = BYTES_PER_TEXEL * (np.prod(proposed, axis=1) - np.prod(sizes, axis=1))
    can_grow = added_bytes > 0
    if fraction is not None:
        check_number("fraction", fraction, least=0, most=1)
        candidates = np.flatnonzero(can_grow & (statistic > 0))
        order = np.argsort(-statistic[candidates], kind="stable")
        mask = np.zeros(len(statistic), bool)
        mask[candidates[order[: math.floor(fraction * len(statistic) + 0.5)]]] = True
        return mask
    if budget_bytes is not None:
        return within_budget(statistic, can_grow, added_bytes, budget_bytes)
    check_number("threshold", threshold)
    return can_grow & (statistic > threshold)


def reallocate(
    textures: Textures,
    new_sizes: ArrayLike,
    moments: object = None,
    known: Sequence[Layout] = (),
    kept: ArrayLike | None = None,
    room: Layout | None = None,
) -> ReallocateResult:
    """Rebuild the buckets at new sizes (host). New texels, and their moments, copy the nearest old one.

    Texel j of a side that grows from T to T' comes from ⌊(j + 0.5)·T/T'⌋, so doubling repeats each texel. Padding, and
    what grows from an empty texture, is (0, 0, 0, 1) in textures and 0 in moments.

    Args:
      textures: the present textures, of N Gaussians.
      new_sizes: [N, 2] integers (Tv, Tu), each side 1 to 16, or both 0.
      moments: any pytree, such as the state of Adam: all `Textures` in it are rebuilt, other leaves stay
        unchanged.
      known: layouts of the buckets to prefer, since programs are compiled for them.
      kept: [N] bool, whose moments are kept, the others' being 0; None: all.
      room: layout of the buckets, if the textures fit; None: as small as possible, or one of `known`.

    Returns:
      The named tuple (textures, moments), both at the new sizes.

    Raises:
      ValueError: if `new_sizes` does not fit the textures or holds a side out of range.

    Examples:
      >>> textures = a2tg.allocate_textures(np.ones((3, 2), int))
      >>> grown = a2tg.reallocate(textures, np.array([[1, 1], [2, 1], [2, 2]]), moments=())
      >>> grown.textures.num_texels
      7
    """
    check_textures(textures)
    new_sizes = checked_sizes(new_sizes, "new_sizes")
    check_shape("new_sizes", new_sizes, (textures.num, 2))
    rebuilt, moments = resize(textures, new_sizes, moments, known, None if kept is None else np.asarray(kept), room)
    return ReallocateResult(rebuilt, moments)


def _bytes_between(sizes: np.ndarray, larger: np.ndarray) -> int:
    """Return the bytes that textures gain when they grow to larger sizes."""
    return BYTES_PER_TEXEL * int(np.prod(larger, axis=1).sum() - np.prod(sizes, axis=1).sum())
