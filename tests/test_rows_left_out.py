"""Rows that cannot be drawn are left out of files of other programs, with a warning that counts and names them."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from small_values import assert_same, some_gaussians, some_world

from a2tg_jax import Model, load_splats, look_at, save_splats, transform_gaussians

SUFFIXES = [".ply", ".ksplat", ".glb", ".splat"]
OTHERS = np.array([0, 1, 3, 4, 5, 6])


def patched(path, before, after):
    """Writes a file of seven Gaussians with the bytes of some numbers replaced, which it holds once."""
    save_splats(path, Model(some_gaussians()))
    data = path.read_bytes()
    assert data.count(before.tobytes()) == 1
    path.write_bytes(data.replace(before.tobytes(), np.asarray(after, before.dtype).tobytes()))


@pytest.mark.parametrize("suffix", SUFFIXES)
@pytest.mark.parametrize(
    ("value", "number"), [(np.nan, "nan"), (np.inf, "inf"), (1e13, r"1e\+13"), (-3e38, r"-3e\+38")]
)
def test_a_mean_that_cannot_be_drawn(tmp_path, suffix, value, number):
    mean = np.array(some_gaussians().means)[2]
    save_splats(tmp_path / f"whole{suffix}", Model(some_gaussians()[OTHERS]))
    patched(tmp_path / f"a{suffix}", mean, [*mean[:2], value])
    wanted = rf"a{suffix}: 1 Gaussian of 7 left out, .*the first is row \d \(from 0\), with means of {number}"
    with pytest.warns(UserWarning, match=wanted) as told:
        found = load_splats(tmp_path / f"a{suffix}").gaussians
    assert len(told) == 1
    assert_same(found, load_splats(tmp_path / f"whole{suffix}").gaussians)


@pytest.mark.parametrize("suffix", [".ply", ".ksplat", ".glb"])
@pytest.mark.parametrize("length", [0.0, 1e-25, 1e14])
def test_quaternions_of_any_length(tmp_path, suffix, length):
    """Those of zeros are unrotated, others keep their direction."""
    save_splats(tmp_path / f"whole{suffix}", Model(some_gaussians()))
    whole = load_splats(tmp_path / f"whole{suffix}").gaussians
    quat = np.asarray(whole.quats)[2]
    wxyz = [1, 2, 3, 0] if suffix == ".glb" else [0, 1, 2, 3]
    patched(tmp_path / f"a{suffix}", quat[wxyz], length * quat[wxyz].astype(np.float64))
    if length:
        found = load_splats(tmp_path / f"a{suffix}").gaussians
        units = (np.asarray(own) / np.linalg.norm(own, axis=1, keepdims=True) for own in (found.quats, whole.quats))
        np.testing.assert_allclose(*units, rtol=1e-5)
        return
    wanted = "1 Gaussian of 7 with the rotation 0 0 0 0, read as unrotated; the first is row 2"
    with pytest.warns(UserWarning, match=wanted) as told:
        found = load_splats(tmp_path / f"a{suffix}").gaussians
    assert len(told) == 1
    np.testing.assert_array_equal(found.quats, whole.quats.at[2].set(jnp.array([1.0, 0, 0, 0])))


def test_a_quaternion_of_zeros_moves_as_it_is_drawn():
    gaussians = some_gaussians()
    zero, unrotated = (
        dataclasses.replace(gaussians, quats=gaussians.quats.at[2].set(jnp.array(quat)))
        for quat in ([0.0, 0, 0, 0], [1.0, 0, 0, 0])
    )
    assert_same(transform_gaussians(zero, some_world()), transform_gaussians(unrotated, some_world()))
    camera = look_at((0, -8, 0), (0, 0, 0), width=32, height=24)
    found, wanted = (np.asarray(Model(each).render(camera).color) for each in (zero, unrotated))
    assert np.ptp(wanted) > 0.1
    np.testing.assert_array_equal(found, wanted)
