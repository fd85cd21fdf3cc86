"""The same seed makes the same bits, whatever a process has trained before; where they could differ, it is said."""

import dataclasses

import jax
import numpy as np
import pytest
from bits import bits_of

from a2tg_jax import A2tg, fit, synthetic_scene
from a2tg_jax.adapt import Upscale
from a2tg_jax.densify.clone_split import CloneSplitPrune
from a2tg_jax.host.machine import Machine, this_machine
from a2tg_jax.mcmc import Mcmc
from a2tg_jax.rasterize.kernels import platforms
from a2tg_jax.systems.baselines import Gaussians2d

FIRST = A2tg(
    stage1_iterations=24, stage2_iterations=20, initial_gaussians=80, densify=Mcmc(cap=90),
    texture=Upscale(at=(0.3, 0.6)), seed=3,
)  # fmt: skip


@pytest.mark.long
def test_what_ran_before_in_the_process_changes_nothing():
    """Runs in between leave larger tile lists, other buckets of textures, other programs, another seed's orders."""
    scene = synthetic_scene(num_views=8, width=40, height=30, num_points=150)
    before = fit(scene, FIRST, progress=False)
    larger = dataclasses.replace(FIRST, densify=Mcmc(cap=130), texture=Upscale(at=(0.5,), cap=8, fraction=0.9), seed=4)
    other = fit(scene, larger, progress=False)
    fit(scene, Gaussians2d(stage1_iterations=20, densify=CloneSplitPrune(cap=200), batch_size=2), progress=False)
    again = fit(scene, FIRST, progress=False)
    assert bits_of(again.model) == bits_of(before.model)
    jax.tree.map(np.testing.assert_array_equal, again.stages[0].model, before.stages[0].model)
    np.testing.assert_array_equal(again.history.loss, before.history.loss)
    assert bits_of(other.model) != bits_of(before.model)


@pytest.mark.parametrize(
    ("flags", "wanted"),
    [
        ("", "cuda"),
        ("--xla_gpu_deterministic_ops=true", "xla"),
        ("--xla_dump_to=x --xla_gpu_exclude_nondeterministic_ops", "xla"),
        ("--xla_gpu_deterministic_ops=true --xla_gpu_deterministic_ops=false", "cuda"),
    ],
)
def test_kernels_with_atomic_sums_are_not_chosen_where_xla_is_to_be_deterministic(monkeypatch, flags, wanted):
    monkeypatch.setattr(platforms, "has_cuda", lambda: True)
    monkeypatch.setenv("XLA_FLAGS", flags)
    assert platforms.choose("auto", "cuda") == wanted


def test_what_may_change_bits_is_reported():
    here = this_machine()
    assert here.differences(here) == []
    other = Machine("0.1", here.jaxlib, "gpu: other", here.processor, here.threads + 1)
    assert [printed.split(" is ")[0] for printed in other.differences(here)[:2]] == ["jax", "device"]
    assert "A2TG_NUM_THREADS=" in other.differences(here)[2]
    on_gpu = dataclasses.replace(here, device="gpu: other")
    assert dataclasses.replace(on_gpu, threads=here.threads + 1).differences(on_gpu) == []
