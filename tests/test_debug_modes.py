"""Training in the modes of JAX that people debug with: without jit, with checks for NaN, with strict ranks."""

import functools

import jax
import numpy as np
import pytest

import a2tg_jax as a2tg
from a2tg_jax.io.config_json import changed_config
from a2tg_jax.training.registry import SYSTEMS

MODES = {
    "disable_jit": jax.disable_jit,
    "debug_nans": functools.partial(jax.debug_nans, True),
    "rank_promotion": functools.partial(jax.numpy_rank_promotion, "raise"),
}
QUICK = {("disable_jit", "gaussians-2d-mcmc"), ("debug_nans", "bytewise"), ("debug_nans", "supergaussians")}
"""Ones that run without --long. Strict ranks, and strict dtypes with them, hold in all tests (conftest.py)."""
GROWS = {"gaussians-2d", "supergaussians"}
"""Systems that clone and split, which want room."""
CASES = [
    pytest.param(mode, name, marks=[] if (mode, name) in QUICK else pytest.mark.long)
    for mode in MODES
    for name in SYSTEMS
]


@pytest.fixture(scope="module")
def scene():
    return a2tg.synthetic_scene(num_views=4, width=16, height=12, num_points=30)


@pytest.mark.filterwarnings("ignore:.*changed nothing")
@pytest.mark.parametrize(("mode", "name"), CASES)
def test_a_system_trains(mode, name, scene):
    """A few steps of each stage, and an event that moves and adds Gaussians."""
    changes = {"stage1_iterations": 12, "initial_gaussians": 20, "densify": {"cap": 200 if name in GROWS else 21}}
    if hasattr(a2tg.find_system(name), "stage2_iterations"):
        changes["stage2_iterations"] = 3
    system = changed_config(a2tg.find_system(name), changes, "test")
    with MODES[mode]():
        model = a2tg.fit(scene, system, progress=False).model
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(model.gaussians))
