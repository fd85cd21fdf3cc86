"""Which Gaussians are pruned, that all of a Gaussian moves along, and that training goes on with the others."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import oracle
import pytest
from scenes_random import as_camera, as_gaussians, draw_scene
from test_splitting import some_state
from test_view_dependence import banded

import a2tg_jax as a2tg
from a2tg_jax.events import Due
from a2tg_jax.model import Model
from a2tg_jax.optim import adam_init
from a2tg_jax.pruning import Prune, blending_weights
from a2tg_jax.splitting import SplitByGradient
from a2tg_jax.systems.bytewise import PruneConfig


@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize("seed", [0, 3])
def test_weights_are_those_of_the_oracle(seed):
    scene = draw_scene(seed)._replace(textures=None)
    expected = oracle.render(scene).weights.sum(axis=(1, 2))
    model = Model(as_gaussians(scene, "float64"))
    once = blending_weights(model, [as_camera(scene, "float64")])
    np.testing.assert_allclose(once, expected, rtol=1e-9, atol=1e-9)
    assert (expected > 1).sum() > 3


def test_weights_are_summed_over_views_of_any_size():
    model, camera = (
        Model(some_state()[0].gaussians),
        a2tg.synthetic_scene(num_views=3, width=24, height=16).train[0].camera,
    )
    small = dataclasses.replace(camera, width=20, height=10)
    parts = [blending_weights(model, [one]) for one in (camera, small, camera)]
    np.testing.assert_allclose(blending_weights(model, [camera, small, camera]), sum(parts), rtol=1e-6)
    with pytest.raises(ValueError, match="at least one view"):
        blending_weights(model, [])


def pruned(event: Prune):
    """What an event makes of a model with rows to spare, whose moments and statistics are the rows' numbers."""
    model, _, statistics = some_state()
    camera = a2tg.synthetic_scene(num_views=3, width=24, height=16).train[0].camera
    moments = adam_init((model.gaussians, model.params))
    numbers = jnp.arange(model.gaussians.num, dtype=jnp.float32)
    by_row = lambda x: jnp.broadcast_to(numbers.reshape(-1, *[1] * (x.ndim - 1)), x.shape)  # noqa: E731
    moments = dataclasses.replace(moments, mu=jax.tree.map(by_row, moments.mu))
    change = event.apply(Due(cameras=[camera]), model, moments, ())
    return model, camera, statistics, change


def test_those_that_show_least_go_and_all_of_a_gaussian_moves_along():
    model, camera, statistics, change = pruned(Prune(share=0.25))
    weights = blending_weights(model, [camera])
    left = int(change.model.num_live)
    assert left == model.num - round(0.25 * model.num)
    kept, gone = change.rows[:left], change.rows[left : model.num]
    assert weights[kept].min() >= weights[gone].max()
    assert (np.diff(kept) > 0).all()
    assert sorted(change.rows) == list(range(model.gaussians.num))
    for name in ("means", "sh", "logit_opacities"):
        old, new = (np.asarray(getattr(one.gaussians, name)) for one in (model, change.model))
        np.testing.assert_array_equal(new, old[change.rows])
    gaussians, _ = change.moments.mu
    np.testing.assert_array_equal(gaussians.quats[:, 0], change.rows)
    moved = SplitByGradient(400).gather(statistics, change.rows)
    np.testing.assert_array_equal(moved.total, np.asarray(statistics.total)[change.rows])


def test_so_many_are_kept_as_were_asked_for():
    assert pruned(Prune(keep=120))[-1].model.num == 120
    model, _, _, change = pruned(Prune(keep=1_000))
    assert change.model.num == model.num


def test_degrees_stay_with_their_gaussians():
    model, _, camera = banded(0)
    with pytest.raises(ValueError, match="prune before"):
        Prune().apply(Due(cameras=[camera]), model, adam_init((model.gaussians, model.params)), ())


@pytest.mark.parametrize("at", [(0.5, 0.2), (0.0,), (0.5, 1.1)])
def test_times_must_exist(at):
    with pytest.raises(ValueError, match="above 0, up to 1"):
        Prune(at=at).iterations(100)
    assert Prune(at=(0.5, 1.0)).iterations(100) == (50, 100)


def test_others_grow_where_some_were_pruned():
    """Up to the cap again, within the bytes, and down to what is kept at the end."""
    scene = a2tg.synthetic_scene(num_views=4, width=24, height=16, num_points=120)
    system = dataclasses.replace(
        a2tg.Bytewise.preset("smoke"),
        stage1_iterations=200,
        stage2_iterations=10,
        memory_budget="30kB",
        initial_gaussians=None,
        prune=PruneConfig(share=0.4),
    )
    result = a2tg.fit(scene, system, progress=False)
    numbers = result.stages[0].history.num_gaussians
    assert (np.diff(numbers) < 0).any() and numbers.max() == 30_000 // 52
    assert result.history.megabytes.max() <= 0.03
    assert result.stages[0].model.num < numbers.max()
