"""Training in the modes of JAX that people debug with: without jit, and with checks for NaN.

Strict ranks and dtypes hold in all tests (conftest.py).
"""

import functools

import jax
import numpy as np
import pytest

import a2tg_jax as a2tg

WITHOUT_JIT = jax.disable_jit
CHECKS_FOR_NAN = functools.partial(jax.debug_nans, True)


@pytest.mark.long
@pytest.mark.filterwarnings("ignore:.*changed nothing")
@pytest.mark.parametrize(
    ("mode", "name", "cap", "iterations"),
    [
        (WITHOUT_JIT, "gaussians-2d-mcmc", 21, 12),
        (CHECKS_FOR_NAN, "bytewise", 21, 12),
        (CHECKS_FOR_NAN, "supergaussians", 200, 24),
    ],
)
def test_a_system_trains(mode, name, cap, iterations):
    """A few steps of each stage, and events that add Gaussians, of which clones and halves need room."""
    scene = a2tg.synthetic_scene(num_views=4, width=16, height=12, num_points=30)
    changes = {"stage1_iterations": iterations, "stage2_iterations": 1, "initial_gaussians": 20}
    changes |= {"densify": {"cap": cap}, "tile_size": 16}
    system = a2tg.find_system(name).preset("paper", **changes)
    with mode():
        model = a2tg.fit(scene, system).model
    assert model.num != 20
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(model.gaussians))
