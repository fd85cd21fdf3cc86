"""Adaptation: the table of the rule, the laws of the selection, the rebuild against a naive loop."""

import dataclasses
import re
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from a2tg_jax import (
    A2tg,
    Appearance,
    Due,
    GradientStatistics,
    Model,
    Texture,
    Upscale,
    adam_init,
    allocate_appearance,
    allocate_textures,
    combine,
    init_from_points,
    next_sizes,
    partition,
    reallocate,
    select,
    texture_arrays,
    textures_from_arrays,
)
from a2tg_jax.adapt import most_textures
from a2tg_jax.core.budget import event_budget
from a2tg_jax.core.table import Layout, plan_places

ROUND = (0.1, 0.1)
WIDE = (0.05, 0.009)
TALL = (0.009, 0.05)
WIDE_BUT_LARGE = (0.5, 0.02)
PAPER = {"k_a": 4.0, "k_s": 0.01, "cap": 4}
NEXT_SIZES = [
    ((1, 1), ROUND, (2, 2)),
    ((1, 1), WIDE, (1, 2)),
    ((1, 1), TALL, (2, 1)),
    ((1, 1), WIDE_BUT_LARGE, (2, 2)),
    ((1, 1), (0.036, 0.009), (2, 2)),  # A ratio of exactly k_A is not above it.
    ((1, 2), WIDE, (1, 4)),
    ((1, 4), WIDE, (1, 4)),
    ((4, 1), ROUND, (4, 2)),
    ((4, 1), WIDE, (4, 2)),
    ((4, 4), ROUND, (4, 4)),
    ((3, 3), ROUND, (4, 4)),
    ((8, 1), ROUND, (8, 2)),  # Larger than the cap already: never shrunk.
    ((0, 0), ROUND, (2, 2)),  # An empty texture grows as one texel does.
    ((0, 0), WIDE, (1, 2)),
    ((0, 0), TALL, (2, 1)),
]


def test_table_of_next_sizes():
    sizes, scales, wanted = (np.array(column) for column in zip(*NEXT_SIZES, strict=True))
    np.testing.assert_array_equal(next_sizes(sizes, scales, **PAPER), wanted)
    both = next_sizes(np.ones((3, 2), int), np.array([ROUND, WIDE, TALL]), **PAPER, anisotropic=False)
    np.testing.assert_array_equal(both, 2)


def random_event(num, seed):
    """Statistics with ties and zeros, mixed sizes, and their proposals."""
    rng = np.random.default_rng(seed)
    statistic = np.round(rng.exponential(size=num), 2)
    sizes = rng.choice([1, 2, 4], (num, 2))
    scales = np.exp(rng.normal(-5, 1.5, (num, 2)))
    return statistic, sizes, next_sizes(sizes, scales, k_a=4, k_s=0.01, cap=8 if seed % 2 else 4)


def added_bytes(sizes, proposed):
    return 16 * (np.prod(proposed, 1) - np.prod(sizes, 1))


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_textures_of_unknown_scales_stay_and_are_never_chosen(bad):
    sizes = np.array([[2, 1], [0, 0], [1, 1], [2, 2]])
    scales = np.full((4, 2), 0.1)
    scales[:3, 1] = bad
    scales[1, 0] = np.nan
    proposed = next_sizes(sizes, scales, k_a=4.0, k_s=0.01, cap=4)
    np.testing.assert_array_equal(proposed, [*sizes[:3], [4, 4]])
    for rule in ({"threshold": 0.0}, {"fraction": 1.0}, {"budget_bytes": 1e6}):
        assert select(np.ones(4), sizes, proposed, **rule).tolist() == [False, False, False, True]


def test_threshold_takes_exactly_those_above():
    for seed in range(4):
        statistic, sizes, proposed = random_event(200, seed)
        mask = select(statistic, sizes, proposed, threshold=0.5)
        np.testing.assert_array_equal(mask, (statistic > 0.5) & (proposed != sizes).any(1))


def test_fraction_rounds_halves_up_breaks_ties_by_index_and_leaves_out_the_unseen_and_the_full():
    for fraction, num in ((0.0, 0), (0.25, 3), (0.24, 2), (0.5, 5), (1.0, 10)):
        mask = select(np.arange(1.0, 11.0), np.ones((10, 2), int), np.full((10, 2), 2), fraction=fraction)
        np.testing.assert_array_equal(np.flatnonzero(mask), np.arange(10 - num, 10))
    statistic = np.array([0.0, 2.0, 1.0, 1.0, 1.0, 9.0])
    sizes = np.ones((6, 2), int)
    proposed = np.full((6, 2), 2)
    proposed[5] = 1
    for fraction, wanted in ((0.5, [1, 2, 3]), (1.0, [1, 2, 3, 4])):
        np.testing.assert_array_equal(np.flatnonzero(select(statistic, sizes, proposed, fraction=fraction)), wanted)


def greedy(statistic, sizes, proposed, budget):
    """The rule of the budget, one Gaussian at a time."""
    cost = added_bytes(sizes, proposed)
    mask = np.zeros(len(cost), bool)
    for index in sorted(np.flatnonzero(cost > 0), key=lambda i: -statistic[i] / cost[i]):
        if cost[index] <= budget:
            mask[index] = True
            budget -= cost[index]
    return mask


def test_empty_textures_are_chosen_by_every_rule():
    """Three grow from nothing to 2×2, which takes 64 bytes, and one from 1×1, which takes 48."""
    sizes = np.array([[0, 0], [0, 0], [0, 0], [1, 1]])
    statistic = np.array([3.0, 1.0, 0.0, 2.0])
    proposed = next_sizes(sizes, np.full((4, 2), 0.1), **PAPER)
    assert select(statistic, sizes, proposed, threshold=0.5).tolist() == [True, True, False, True]
    assert select(statistic, sizes, proposed, fraction=0.5).tolist() == [True, False, False, True]
    assert select(statistic, sizes, proposed, budget_bytes=64 + 48 + 63).tolist() == [True, False, False, True]
    assert select(statistic, sizes, proposed, budget_bytes=3 * 64 + 48).all()


@pytest.mark.parametrize("budget", [0, 15, 16, 1000, 7777, 20_000, 10**9])
def test_budget_is_the_greedy_choice_and_leaves_less_than_the_cheapest(budget):
    for seed in range(6):
        statistic, sizes, proposed = random_event(300, seed)
        mask = select(statistic, sizes, proposed, budget_bytes=budget)
        np.testing.assert_array_equal(mask, greedy(statistic, sizes, proposed, budget))
        cost = added_bytes(sizes, proposed)
        left = budget - cost[mask].sum()
        possible = cost[~mask & (cost > 0)]
        assert left >= 0 and (len(possible) == 0 or left < possible.min())


@pytest.mark.parametrize("dtype", [np.uint8, np.int32, np.uint64])
def test_sizes_may_be_integers_of_any_kind(dtype):
    sizes = np.asarray([[1, 1], [2, 2]], dtype)
    larger = np.asarray([[2, 2], [2, 1]], dtype)
    textures = allocate_textures(sizes)
    assert textures.sizes.tolist() == sizes.tolist()
    assert reallocate(textures, larger).textures.sizes.tolist() == larger.tolist()
    mask = select(np.ones(2), sizes, larger, budget_bytes=1000)
    assert mask.tolist() == [True, False], "a texture that would shrink is not chosen"


@pytest.mark.parametrize(
    ("function", "message"),
    [
        (lambda: select(*random_event(5, 0)), "exactly one of"),
        (lambda: select(*random_event(5, 0), threshold=1, fraction=0.5), "exactly one of"),
        (lambda: select(*random_event(5, 0), fraction=0.1, budget_bytes=5), "exactly one of"),
        (lambda: select(*random_event(5, 0), fraction=1.5), "fraction"),
        (lambda: select(*random_event(5, 0), budget_bytes=-1), "budget_bytes"),
        (lambda: select(np.zeros(3), np.ones((4, 2), int), np.ones((4, 2), int), threshold=0), r"sizes must be \[3, 2"),
        (lambda: next_sizes(np.ones((4, 2), int), np.ones((3, 2)), **PAPER), r"scales must be \[4, 2\]; got \[3, 2\]"),
        (lambda: event_budget(999, 1000, 1, 2), "below"),
        (lambda: event_budget(1000, 400, 3, 2), "event_index"),
        (lambda: reallocate(allocate_textures(np.ones((3, 2), int)), np.ones((4, 2), int)), r"must be \[3, 2\]"),
        *(
            (lambda size=size: allocate_textures(np.array([size])), r"texture sides must be in 1\.\.16, or both 0")
            for size in ((0, 1), (1, 0), (17, 1), (-1, -1))
        ),
    ],
)
def test_wrong_arguments_are_named(function, message):
    with pytest.raises(ValueError, match=message):
        function()


def test_events_never_exceed_the_budget_and_end_near_it():
    """Whole stages: all events in turn, at several budgets, of which each event shares what is left."""
    assert [event_budget(1000, used, *at) for used, at in ((400, (1, 2)), (700, (2, 2)), (1000, (1, 3)))] == [
        300,
        300,
        0,
    ]
    rng = np.random.default_rng(0)
    scales = np.exp(rng.normal(-5, 1.5, (500, 2)))
    for total in (500 * 16, 10_000, 55_555):
        sizes = np.ones((500, 2), int)
        for event in (1, 2, 3):
            proposed = next_sizes(sizes, scales, k_a=4, k_s=0.01, cap=8)
            budget = event_budget(total, 16 * np.prod(sizes, 1).sum(), event, 3)
            mask = select(rng.exponential(size=500), sizes, proposed, budget_bytes=budget)
            cost = added_bytes(sizes, proposed)
            sizes = np.where(mask[:, None], proposed, sizes)
        used = 16 * np.prod(sizes, 1).sum()
        assert used <= total and total - used < cost[~mask & (cost > 0)].min()


@pytest.mark.parametrize(
    "cap, anisotropic, start", [(4, True, (0, 0)), (8, True, (1, 1)), (8, False, (0, 0)), (3, True, (1, 2))]
)
def test_there_is_room_for_all_that_textures_can_become(cap, anisotropic, start):
    """Whole stages from one size: whatever is chosen within the bytes fits the buckets that are planned before."""
    rng = np.random.default_rng(cap)
    sizes = np.tile(start, (200, 1))
    budget = 16 * (int(np.prod(sizes, 1).sum()) + 500)
    planned = most_textures(sizes, budget, cap)
    room = dict(zip(*planned, strict=True))
    assert list(room) == sorted(room), "resolutions ascend"
    for event in range(1, 6):
        scales = np.exp(rng.normal(-5, 1.5, (200, 2)))
        proposed = next_sizes(sizes, scales, k_a=4, k_s=1.0, cap=cap, anisotropic=anisotropic)
        left = event_budget(budget, 16 * np.prod(sizes, 1).sum(), event, 5)
        mask = select(rng.exponential(size=200), sizes, proposed, budget_bytes=left)
        sizes = np.where(mask[:, None], proposed, sizes)
        resolutions, counts = np.unique(sizes, axis=0, return_counts=True)
        needed = dict(zip(map(tuple, resolutions.tolist()), counts, strict=True))
        assert all(room[size] >= count for size, count in needed.items())
        places = plan_places(sizes, room=planned)
        assert places.layout == planned
        np.testing.assert_array_equal(np.asarray(planned.sizes)[places.bucket], sizes)
    assert len(needed) > 3 - 2 * (not anisotropic) and np.prod(sizes, 1).sum() > 0.9 * budget / 16


def test_textures_that_outgrow_their_room_get_more():
    sizes = np.array([[1, 1]] * 6 + [[2, 2]] * 3)
    places = plan_places(sizes, room=Layout(((1, 1), (2, 2)), (6, 2)))
    assert places.layout == Layout(((1, 1), (2, 2)), (6, 3))


def random_textures(seed, num=40, dtype=np.float32):
    rng = np.random.default_rng(seed)
    sizes = rng.choice([1, 2, 3, 4], (num, 2))
    return [rng.normal(size=(*size, 4)).astype(dtype) for size in sizes], sizes


def with_places(floats, textures):
    """Moments, which are floats only, with the places of the textures."""
    return combine(floats, partition(textures)[1])


def nearest_copy(texture, size):
    """The rule of the rebuild, one texel at a time."""
    (old_v, old_u), (new_v, new_u) = texture.shape[:2], size
    out = np.empty((new_v, new_u, 4), texture.dtype)
    for j in range(new_v):
        for i in range(new_u):
            out[j, i] = texture[int((j + 0.5) * old_v / new_v), int((i + 0.5) * old_u / new_u)]
    return out


@pytest.mark.parametrize("seed", range(2))
def test_reallocate_copies_the_nearest_texel(seed):
    """Growing, shrinking, odd ratios, and moments that go along."""
    arrays, _ = random_textures(seed)
    textures = textures_from_arrays(arrays)
    floats, _ = partition(textures)
    doubled, squared = (jax.tree.map(change, floats) for change in (lambda x: 2 * x, lambda x: x * x))
    new_sizes = np.random.default_rng(seed + 9).choice([1, 2, 4, 7, 16], (len(arrays), 2))
    new_textures, (mu, rest) = reallocate(textures, new_sizes, (doubled, {"nu": squared}))
    np.testing.assert_array_equal(new_textures.sizes, new_sizes)
    trees = (new_textures, mu, rest["nu"])
    for tree, change in zip(trees, (lambda x: x, lambda x: 2 * x, lambda x: x * x), strict=True):
        assert all(bucket.dtype == jnp.float32 for bucket in tree.buckets)
        for got, old, size in zip(texture_arrays(with_places(tree, new_textures)), arrays, new_sizes, strict=True):
            np.testing.assert_array_equal(got, nearest_copy(change(old), size))


@pytest.mark.parametrize("every", [1, 3, 10**6])
def test_doubling_repeats_texels_and_moments_that_are_not_kept_are_zero(every):
    """All, a third, and none are kept."""
    arrays, sizes = random_textures(6)
    textures = textures_from_arrays(arrays)
    kept = np.arange(1, len(arrays) + 1) % every == 0
    larger, moments = reallocate(textures, 2 * sizes, textures, kept=kept)
    for got, moment, old, is_kept in zip(texture_arrays(larger), texture_arrays(moments), arrays, kept, strict=True):
        repeated = np.repeat(np.repeat(old, 2, 0), 2, 1)
        np.testing.assert_array_equal(got, repeated)
        np.testing.assert_array_equal(moment, repeated * is_kept)
    back, nothing = reallocate(larger, sizes)
    assert nothing is None
    jax.tree.map(np.testing.assert_array_equal, texture_arrays(back), arrays)


def test_the_page_says_how_much_copies_change_what_is_shown():
    """Interpolated by scipy at places over ±3σ, weighted by the kernel: the root of the mean squared change over the
    standard deviation."""
    places = (np.arange(240) + 0.5) / 240
    kernel = np.exp(-0.5 * np.square(6 * places - 3))
    weights = np.outer(kernel, kernel) / kernel.sum() ** 2

    def shown(texels):
        along = places * len(texels) - 0.5
        at = np.meshgrid(along, along, indexing="ij")
        return map_coordinates(texels.astype(np.float64), at, order=1, mode="nearest")

    page = (Path(__file__).parents[1] / "docs" / "how-it-works.md").read_text(encoding="utf-8")
    for side in (1, 2, 4):
        # For independent random texels, mean squares are sums over textures with one texel of 1.
        units = np.eye(side**2, dtype=np.float32).reshape(-1, side, side)
        textures = textures_from_arrays([np.repeat(unit[..., None], 4, axis=2) for unit in units])
        larger = texture_arrays(reallocate(textures, 2 * textures.sizes).textures)
        variance = change = 0.0
        for unit, copied in zip(units, larger, strict=True):
            before = shown(unit)
            variance += np.sum(weights * np.square(before - np.sum(weights * before)))
            change += np.sum(weights * np.square(shown(copied[..., 0]) - before))
        if side == 1:
            assert change < 1e-24, "one texel shows the same at any size"
            continue
        share = round(100 * np.sqrt(change / variance))
        assert re.search(rf"\b{share} %[^%]* \({side}×{side} to {2 * side}×{2 * side}\)", page), share


@pytest.mark.parametrize("moments", ["copied", "zero"])
def test_what_adam_remembers_of_a_texture_that_grows(moments):
    """The half with the larger statistic grows; all moments were 1."""
    gaussians = init_from_points(np.eye(3)[np.arange(12) % 3], np.full((12, 3), 0.5))
    model = Model(gaussians, allocate_appearance(Appearance(texture=Texture()), jax.random.key(0), gaussians))
    ones = jax.tree.map(jnp.ones_like, adam_init(partition(model)[0]))
    state = GradientStatistics.init(12, jnp.float32).observe(jnp.arange(12, dtype=jnp.float32), jnp.ones(12, bool))
    change = Upscale(fraction=0.5, moments=moments).apply(Due(), model, ones, state)
    found = texture_arrays(with_places(change.moments.mu.textures, change.model.textures))
    assert [array.shape[0] for array in found] == [1] * 6 + [2] * 6
    assert [float(array.min()) for array in found] == [1] * 6 + [float(moments == "copied")] * 6


def test_padding_is_neutral_and_has_no_moments():
    textures = allocate_textures(np.ones((100, 2), int))
    zeros = jax.tree.map(jnp.zeros_like, partition(textures)[0])
    new_sizes = np.where(np.arange(100)[:, None] < 33, 2, np.ones((100, 2), int))
    new_textures, moments = reallocate(textures, new_sizes, zeros)
    for bucket, moment in zip(new_textures.buckets, moments.buckets, strict=True):
        np.testing.assert_array_equal(bucket, np.broadcast_to(np.float32([0, 0, 0, 1]), bucket.shape))
        np.testing.assert_array_equal(moment, 0)


@pytest.mark.parametrize(
    "event, message",
    [
        (Upscale("threshold"), r"Upscale\.select is 'threshold', so it needs threshold, an average gradient$"),
        (Upscale("budget"), r"Upscale\.select is 'budget', so it needs budget_mb, in MB \(10\^6 bytes\)$"),
        (Upscale(cap=32), r"Upscale\.cap must be at least 1 and at most 16; got 32$"),
        (Upscale(cap=4.0), r"Upscale\.cap must be int; got 4\.0$"),
        (Upscale(fraction=1.5), r"Upscale\.fraction must be at least 0 and at most 1; got 1\.5$"),
    ],
)
def test_impossible_choices_are_refused_before_training(event, message):
    assert Upscale(at=(0.1, 0.2, 0.9)).times(3) == (1, 3), "upscalings that fall together are one"
    stage = A2tg.preset("smoke").stages()[1]
    with pytest.raises(ValueError, match=message):
        dataclasses.replace(stage, events=(event,)).check()


@pytest.mark.parametrize(
    "event, statistics",
    [
        (Upscale("fraction", k_s=0.0, fraction=0.5), [1.0, 2.0, *[0.0] * 8]),
        (Upscale("budget", k_s=0.0, budget_mb=(2 * 248 + 48) / 1e6), [0.0, 0.0, *[9.0] * 8]),
    ],
)
def test_rows_that_do_not_exist_take_no_share(event, statistics):
    """Two Gaussians in ten rows: half of two grow, and a budget is theirs alone."""
    gaussians = init_from_points(np.random.default_rng(0).normal(size=(10, 3)), np.zeros((10, 3)))
    appearance = allocate_appearance(Appearance(texture=Texture()), jax.random.key(0), gaussians)
    model = Model(gaussians, appearance, num_live=jnp.int32(2))
    seen = GradientStatistics(jnp.asarray(statistics), jnp.ones(10, jnp.int32))
    sizes = event.apply(Due(), model, adam_init(partition(model)[0]), seen).model.textures.sizes
    assert np.prod(sizes[:2], axis=1).sum() == 1 + 4 and np.all(sizes[2:] == 1)


def test_an_event_of_a_million_takes_seconds():
    """A loop over Gaussians would take minutes; the bound is loose on purpose."""
    num = 1_000_000
    rng = np.random.default_rng(0)
    textures = allocate_textures(np.ones((num, 2), int))
    scales = np.exp(rng.normal(-5, 1.5, (num, 2)))
    start = time.perf_counter()
    proposed = next_sizes(textures.sizes, scales, **PAPER)
    mask = select(rng.exponential(size=num), textures.sizes, proposed, budget_bytes=5_000_007)
    result = reallocate(textures, np.where(mask[:, None], proposed, 1))
    assert time.perf_counter() - start < 30
    assert result.textures.num_texels - num <= 5_000_007 // 16


def test_statistics_average_over_the_views_that_saw_it():
    stats = GradientStatistics.init(3)
    accumulate = jax.jit(GradientStatistics.observe)
    stats = accumulate(stats, jnp.asarray([1.0, 5.0, jnp.nan]), jnp.asarray([True, True, False]))
    stats = accumulate(stats, jnp.asarray([3.0, 7.0, 0.0]), jnp.asarray([True, False, False]))
    np.testing.assert_array_equal(stats.average(), [2.0, 5.0, 0.0])
    np.testing.assert_array_equal(stats.views, [2, 1, 0])


@pytest.mark.parametrize("new", [(1, 1), (2, 1), (2, 4)])
def test_an_empty_texture_takes_no_bytes_and_grows_from_nothing(new):
    sizes = np.array([[0, 0], [2, 2], [0, 0], [1, 1]])
    textures = allocate_textures(sizes)
    assert textures.num_texels == 5
    textures = dataclasses.replace(textures, buckets=tuple(bucket + 0.25 for bucket in textures.buckets))
    sizes[0] = new
    ones = jax.tree.map(jnp.ones_like, partition(textures)[0])
    grown, moments = reallocate(textures, sizes, ones)
    first, kept, empty, _ = texture_arrays(grown)
    np.testing.assert_array_equal(first, np.broadcast_to([0.0, 0.0, 0.0, 1.0], (*new, 4)))
    np.testing.assert_array_equal(kept, np.full((2, 2, 4), [0.25, 0.25, 0.25, 1.25]))
    assert empty.size == 0
    assert not texture_arrays(with_places(moments, grown))[0].any()
