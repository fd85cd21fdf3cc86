"""A training that does not learn is reported, while it runs and in its results."""

import dataclasses
import warnings

import numpy as np
import pytest

import a2tg_jax as a2tg
from a2tg_jax import LearningRates
from a2tg_jax.training.batches import BatchOrder
from a2tg_jax.training.reports import LearningCheck

NO_RATES = LearningRates(means=0.0, log_scales=0.0, quats=0.0, logit_opacities=0.0, sh_degree0=0.0, sh_rest=0.0)


@pytest.fixture(scope="module")
def scene():
    return a2tg.synthetic_scene(num_views=6, width=24, height=18, num_points=40)


def test_flat_psnr_is_that_of_the_mean_colour(scene):
    mask = np.arange(18 * 24).reshape(18, 24) % 3 == 0
    views = [*scene.train[:2], dataclasses.replace(scene.train[0], mask=mask)]
    measured = a2tg.evaluate(views, a2tg.init_from_points(scene.points, scene.colors))
    images = [np.asarray(a2tg.view_image(view), np.float64) for view in views]
    kept = [images[0].reshape(-1, 3), images[1].reshape(-1, 3), images[2][mask]]
    wanted = [-10 * np.log10(np.mean((colors - colors.mean(axis=0)) ** 2)) for colors in kept]
    np.testing.assert_allclose([view.flat_psnr for view in measured.per_view], wanted, rtol=1e-4)
    assert measured.flat_psnr == pytest.approx(np.mean(wanted), rel=1e-4)


def frozen(scene, **changes):
    """A system that cannot learn from bad initial colours."""
    colors = np.zeros_like(scene.colors)
    colors[0] = 0.1  # a cloud of one colour would start grey
    black = dataclasses.replace(scene, colors=colors)
    numbers = {"stage1_iterations": 210, "initial_opacity": 0.9, "densify": a2tg.Mcmc(cap=0)}
    return black, a2tg.Gaussians2dMcmc(**{**numbers, "rates": NO_RATES, **changes})


def test_a_warning_if_training_does_not_learn(scene):
    black, system = frozen(scene)
    with pytest.warns(UserWarning, match=r"does not learn: [\d.]+ dB .* after 200 iterations, .* flat colour .* try "):
        a2tg.fit(black, system)


@pytest.mark.long
def test_no_warning_if_training_learns(scene):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        a2tg.fit(scene, a2tg.Gaussians2dMcmc(stage1_iterations=210, initial_opacity=0.5))


def checks_of(views, psnr, iterations=200, is_first=True, **options):
    """Iterations at which a check of these training views warns, if the PSNR stays the same, and its last warning."""
    check = LearningCheck(views, BatchOrder(views, 1, 0), iterations, "black", is_first=is_first, **options)
    warned = []
    text = ""
    for iteration in range(1, iterations + 1):
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            check.observe(iteration, psnr)
        warned += [iteration] * len(caught)
        text = str(caught[-1].message) if caught else text
    return warned, text


def test_long_first_stages_are_checked_once_after_a_fifth(scene):
    assert checks_of(scene.train, 3.0, 1000)[0] == [200]
    assert checks_of(scene.train, 0.0, 199)[0] == [] == checks_of(scene.train, 0.0, 600, is_first=False)[0]
    assert checks_of(scene.train, 3.0, small_budget="room for 3 Gaussians")[1].endswith(
        "dB. room for 3 Gaussians: raise it"
    )
    one_colour = np.full((18, 24, 3), 90, np.uint8)
    empty = dataclasses.replace(scene.train[0], picture=np.zeros_like(one_colour))
    assert checks_of((empty, *scene.train[1:]), 3.0)[0] == [200], "one empty photograph hides no failure"
    assert checks_of(tuple(dataclasses.replace(view, picture=one_colour) for view in scene.train), 20.0)[0] == []


def test_empty_photographs_count_in_no_mean(scene):
    """A photograph that shows nothing of a cut-out subject, and a render that shows nothing either."""
    away = a2tg.look_at([0, -3, 0], [0, -9, 0], width=24, height=18)
    empty = a2tg.View("empty", away, np.zeros((18, 24, 4), np.uint8))
    gaussians = a2tg.init_from_points(scene.points, scene.colors)
    for background in (0.0, 0.3, 1.0):
        options = {"background": (background,) * 3}
        others = a2tg.evaluate(scene.train, gaussians, **options)
        found = a2tg.evaluate([*scene.train, empty], gaussians, **options)
        assert found.per_view[-1].psnr > 100 and len(found.per_view) == len(scene.train) + 1
        for name in ("psnr", "ssim", "flat_psnr"):
            assert getattr(found, name) == getattr(others, name)
    assert a2tg.evaluate([empty], gaussians).ssim == 1


@pytest.mark.long
def test_evaluation_says_that_nothing_was_learned(scene):
    black, system = frozen(scene, stage1_iterations=1)
    assert not a2tg.evaluate(scene.train, a2tg.fit(black, system).model).has_learned
