"""A training that does not learn is noticed: while it runs, and in what is written of it."""

import dataclasses
import warnings

import jax.numpy as jnp
import numpy as np
import pytest

import a2tg_jax as a2tg
from a2tg_jax.training import LearningRates
from a2tg_jax.training.batches import BatchOrder
from a2tg_jax.training.reports import LearningCheck, flat_psnr

NO_RATES = LearningRates(means=0.0, log_scales=0.0, quats=0.0, logit_opacities=0.0, sh_degree0=0.0, sh_rest=0.0)


@pytest.fixture(scope="module")
def scene():
    return a2tg.synthetic_scene(num_views=6, width=24, height=18, num_points=40)


def test_flat_psnr_is_that_of_the_mean_colour():
    image = np.random.default_rng(0).uniform(size=(13, 17, 3))
    wanted = -10 * np.log10(np.mean((image - image.mean(axis=(0, 1))) ** 2))
    assert flat_psnr(jnp.asarray(image)) == pytest.approx(wanted, rel=1e-5)
    mask = np.arange(13 * 17).reshape(13, 17) % 3 == 0
    kept = image[mask]
    wanted = -10 * np.log10(np.mean((kept - kept.mean(axis=0)) ** 2))
    assert flat_psnr(jnp.asarray(image), jnp.asarray(mask)) == pytest.approx(wanted, rel=1e-5)


def frozen(scene, **changes):
    """A system that cannot learn from bad initial colours."""
    colors = np.zeros_like(scene.colors)
    colors[0] = 0.1  # a cloud of one colour would start grey
    black = dataclasses.replace(scene, colors=colors)
    numbers = {"stage1_iterations": 210, "initial_opacity": 0.9, "densify": a2tg.Mcmc(cap=0)}
    return black, a2tg.Gaussians2dMcmc(**{**numbers, "rates": NO_RATES, **changes})


def test_training_that_does_not_learn_is_told(scene):
    black, system = frozen(scene)
    with pytest.warns(UserWarning, match=r"does not learn: [\d.]+ dB .* after 200 iterations, .* flat colour .* try "):
        a2tg.fit(black, system, progress=False)


def test_training_that_learns_is_left_alone(scene):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        a2tg.fit(scene, a2tg.Gaussians2dMcmc(stage1_iterations=210, initial_opacity=0.5), progress=False)


def test_short_and_later_stages_are_not_judged(scene):
    order = BatchOrder(scene.train, 1, 0)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for iterations, is_first in ((199, True), (600, False)):
            check = LearningCheck(scene.train, order, iterations, "black", is_first=is_first)
            for iteration in range(1, iterations + 1):
                check.observe(iteration, 0.0)


def test_the_check_comes_after_a_fifth_and_once(scene):
    check = LearningCheck(scene.train, BatchOrder(scene.train, 1, 0), 1_000, "black", is_first=True)
    told = []
    for iteration in range(1, 1_001):
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            check.observe(iteration, 3.0)
        told += [iteration] * len(caught)
    assert told == [200]


def test_photographs_of_one_colour_prove_nothing(scene):
    views = tuple(dataclasses.replace(view, picture=np.full((18, 24, 3), 90, np.uint8)) for view in scene.train)
    check = LearningCheck(views, BatchOrder(views, 1, 0), 200, "black", is_first=True)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for iteration in range(1, 201):
            check.observe(iteration, 20.0)


def test_evaluation_knows_what_a_flat_colour_reaches(scene):
    black, system = frozen(scene, stage1_iterations=1)
    found = a2tg.evaluate(scene.train, a2tg.fit(black, system, progress=False).model)
    assert not found.has_learned
    flat = [-10 * np.log10(np.mean((own - own.mean((0, 1))) ** 2)) for own in map(a2tg.view_image, scene.train)]
    assert found.flat_psnr == pytest.approx(np.mean(flat), rel=1e-4)


def test_a_small_budget_is_the_advice(scene):
    order = BatchOrder(scene.train, 1, 0)
    check = LearningCheck(scene.train, order, 200, "black", is_first=True, small_budget="room for 3 Gaussians")
    with pytest.warns(UserWarning, match=r"dB\. room for 3 Gaussians: raise it$"):
        for iteration in range(1, 201):
            check.observe(iteration, 3.0)
