"""Where the same seed could make other bits, it is said; that it makes the same ones is in `test_training`."""

import dataclasses

import pytest

from a2tg_jax.base.machine import this_machine
from a2tg_jax.rasterize.kernels import platforms


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
    other = dataclasses.replace(here, jax="0.1", device="gpu: other", threads=here.threads + 1)
    assert [printed.split(" is ")[0] for printed in other.differences(here)[:2]] == ["jax", "device"]
    assert "A2TG_NUM_THREADS=" in other.differences(here)[2]
    on_gpu = dataclasses.replace(here, device="gpu: other")
    assert dataclasses.replace(on_gpu, threads=here.threads + 1).differences(on_gpu) == []
