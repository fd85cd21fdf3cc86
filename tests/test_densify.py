"""Adaptive density control, each rule against a twin in numpy; and its events in training."""

import dataclasses
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.scipy.special import logit
from small_models import some_now
from small_values import rotations

from a2tg_jax import (
    Camera,
    Change,
    CloneSplitPrune,
    EventInfo,
    Gaussians,
    Model,
    OpacityReset,
    Seen,
    adam_init,
    partition,
)
from a2tg_jax.densify.clone_split import CloneSplitPlan, apply_plan
from a2tg_jax.events import read_probe

NUM, LIVE, SCENE_SCALE = 60, 25, 2.0


def random_model(seed: int) -> Model:
    rng = np.random.default_rng(seed)
    as_float = lambda x: jnp.asarray(x, jnp.float32)  # noqa: E731
    gaussians = Gaussians(
        means=as_float(rng.normal(size=(NUM, 3))),
        quats=as_float(rng.normal(size=(NUM, 4))),
        log_scales=as_float(rng.uniform(np.log(0.003), np.log(0.3), (NUM, 2))),
        logit_opacities=logit(as_float(rng.uniform(0.01, 0.5, NUM))),
        sh=as_float(rng.normal(size=(NUM, 16, 3))),
    )
    return Model(gaussians, num_live=jnp.asarray(LIVE, jnp.int32))


def ones(model: Model):
    moments = adam_init(partition(model)[0])
    return dataclasses.replace(moments, mu=jax.tree.map(jnp.ones_like, moments.mu))


def twin_plan(event: CloneSplitPrune, model: Model, gradients, iteration: int, num_iterations: int, num_rows: int):
    """Row by row, in Python."""
    scales = np.asarray(model.gaussians.scales)
    opacities = np.asarray(model.gaussians.opacities)
    between = max(num_iterations // 10, 500)
    kept = set()
    wanted = []
    for row in range(LIVE):
        size = scales[row].max()
        is_late = iteration > between
        if is_late and size > event.largest_share * SCENE_SCALE:
            continue
        if opacities[row] < event.least_opacity and not (is_late and iteration % between < 100):
            continue
        kept.add(row)
        if gradients[row] >= event.threshold:
            wanted.append(row)
    wanted.sort(key=lambda row: -gradients[row])
    room = min(event.cap, num_rows) - len(kept)
    doubled = wanted[:room]
    refused = len(wanted[room:])
    split = {row for row in doubled if scales[row].max() > event.dense_share * SCENE_SCALE}
    return kept, set(doubled) - split, split, refused


@pytest.mark.parametrize("cap", [28, NUM])
def test_plan_is_that_of_the_twin(cap):
    event = CloneSplitPrune(cap)
    plan = jax.jit(event.plan)
    for seed, iteration in itertools.product(range(3), (600, 3_000, 3_050, 3_100, 9_000)):
        model = random_model(seed)
        gradients = np.random.default_rng(seed).uniform(0, 8e-4, NUM).astype(np.float32)
        edit, refused = plan(some_now(iteration, 30_000, scene_scale=SCENE_SCALE), model, jnp.asarray(gradients))
        kept, cloned, split, wanted_refused = twin_plan(event, model, gradients, iteration, 30_000, NUM)
        assert kept and (cloned | split)
        for mask, rows in ((edit.is_kept, kept), (edit.is_cloned, cloned), (edit.is_split, split)):
            assert set(np.flatnonzero(np.asarray(mask)).tolist()) == rows
        assert int(refused) == wanted_refused and (wanted_refused > 0) == (cap == 28)


def test_edit_moves_rows_and_moments_together():
    model = random_model(5)
    moments = ones(model)
    rng = np.random.default_rng(1)
    kept = np.arange(NUM) < LIVE
    kept[rng.choice(LIVE, 6, replace=False)] = False
    rows = rng.permutation(np.flatnonzero(kept))
    cloned = np.isin(np.arange(NUM), rows[:5])
    split = np.isin(np.arange(NUM), rows[5:9])
    edit = CloneSplitPlan(*map(jnp.asarray, (kept, cloned, split)))
    after, after_moments = jax.jit(apply_plan)(jax.random.key(3), edit, model, moments)

    sources = [*np.flatnonzero(kept), *np.flatnonzero(cloned | split)]
    assert int(after.num_live) == len(sources) == 19 + 9
    scales = np.asarray(model.gaussians.scales)
    means = np.asarray(model.gaussians.means)
    for place, row in enumerate(sources):
        is_half = split[row]
        is_copy = place >= kept.sum()
        shrink = 1.6 if is_half else 1.0
        np.testing.assert_allclose(np.asarray(after.gaussians.scales)[place], scales[row] / shrink, rtol=1e-5)
        np.testing.assert_array_equal(after.gaussians.sh[place], model.gaussians.sh[row])
        is_moved = not np.array_equal(np.asarray(after.gaussians.means)[place], means[row])
        assert is_moved == is_half
        expected = 0.0 if is_half or is_copy else 1.0
        assert all(np.all(np.asarray(leaf)[place] == expected) for leaf in jax.tree.leaves(after_moments.mu))


def test_halves_are_drawn_from_the_gaussian_they_split():
    """In its plane, with its standard deviations."""
    model = random_model(0)
    one = jax.tree.map(lambda x: jnp.repeat(x[:1], 4_000, axis=0), model.gaussians)
    mask = jnp.ones(4_000, bool)
    edit = CloneSplitPlan(mask, mask & False, mask)
    wide = jax.tree.map(lambda x: jnp.concatenate([x, x]), one)
    masks = jax.tree.map(lambda m: jnp.concatenate([m, m & False]), edit)
    split = Model(wide, num_live=jnp.asarray(4_000, jnp.int32))
    after, _ = apply_plan(jax.random.key(7), masks, split, ones(split))
    offsets = np.asarray(after.gaussians.means) - np.asarray(one.means)[0]
    local = offsets @ rotations(one.quats[:1])[0]
    np.testing.assert_allclose(local.std(axis=0)[:2], np.asarray(one.scales)[0], rtol=0.05)
    assert np.abs(local[:, 2]).max() < 1e-5


def test_average_is_of_the_views_that_saw_the_gaussian_in_half_images():
    rng = np.random.default_rng(0)
    gradients = rng.normal(size=(3, NUM, 3)).astype(np.float32)
    is_visible = rng.random((3, NUM)) < 0.6
    gradients[..., 2] = 0
    probe = jnp.asarray(np.concatenate([gradients, np.float32(5) * is_visible[..., None]], axis=-1))
    camera = Camera(jnp.zeros((3, 4, 4)), jnp.zeros((3, 3, 3)), 640, 480)
    event = CloneSplitPrune(NUM)
    model = random_model(0)
    state = event.observe(
        event.init(model), model, Seen(camera, *read_probe(probe, "center", 640, 480), jnp.zeros_like(probe[..., :3]))
    )
    for row in range(NUM):
        seen = [np.hypot(*(gradients[view, row, :2] * (320, 240))) for view in range(3) if is_visible[view, row]]
        np.testing.assert_allclose(state.average()[row], np.mean(seen) if seen else 0, rtol=1e-5)


@pytest.mark.parametrize("is_traced", [False, True])
def test_opacity_reset_and_what_adam_forgets(is_traced):
    """In the step, where leaves that stay as they are must be told by identity, it is a branch of a condition."""
    model = random_model(2)

    def apply(model, moments):
        return OpacityReset(0.05).apply(some_now(3_000, 30_000, num_keys=0), model, moments, ())

    def happen(model, moments):
        unchanged = Change(model, moments, (), EventInfo())
        return jax.lax.cond(jnp.any(model.gaussians.means > 0), apply, lambda *_: unchanged, model, moments)

    change = (jax.jit(happen) if is_traced else apply)(model, ones(model))
    expected = np.minimum(np.asarray(model.gaussians.opacities), 0.05)
    np.testing.assert_allclose(change.model.gaussians.opacities, expected, rtol=1e-5)
    gaussians = change.moments.mu.gaussians
    assert np.all(np.asarray(gaussians.logit_opacities) == 0) and np.all(np.asarray(gaussians.means) == 1)


@pytest.mark.parametrize("num_iterations, interval", [(30_000, 3_000), (7_000, 700), (2_000, 500), (200, 500)])
def test_times_are_the_published_ones_scaled(num_iterations, interval):
    times = CloneSplitPrune(NUM).times(num_iterations)
    resets = OpacityReset().times(num_iterations)
    if num_iterations == 30_000:
        assert times == range(600, 15_000, 100)
        assert list(resets) == [3_000, 6_000, 9_000, 12_000]
    assert all(0 < i < num_iterations / 2 for i in times)


def test_pruning_every_gaussian_is_impossible():
    model = random_model(0)
    event = CloneSplitPrune(NUM, least_opacity=0.9)
    change = event.apply(some_now(600, 30_000), model, ones(model), event.init(model))
    assert not bool(change.info.is_possible)
