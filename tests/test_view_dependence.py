"""A degree of spherical harmonics per Gaussian: the same picture as with zeros for what is missing, at fewer bytes."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import oracle
import pytest
from scenes_random import as_camera, as_gaussians, draw_scene
from scipy.spatial.transform import Rotation

from a2tg_jax import Model, load_model, load_ply, plan_render, save_model, save_ply
from a2tg_jax.appearance import Banded, BandedRates, Billboards, MovableKernels, Plain, Shaped, Textured
from a2tg_jax.appearance.banded import BandedLayout, BandedParams
from a2tg_jax.appearance.sh_bands import (
    allocate_bands,
    dense_sh,
    floats_of_band,
    gather_bands,
    reallocate_bands,
    split_sh,
)
from a2tg_jax.core.budget import within_budget
from a2tg_jax.core.optim import adam_init
from a2tg_jax.core.similarity import Similarity
from a2tg_jax.densify.view_dependence import AdaptDegrees, ViewDependence, most_rows, raised, without_idle
from a2tg_jax.events import Due, Seen
from a2tg_jax.mcmc import Mcmc
from a2tg_jax.systems.gaussians_2d_mcmc import Gaussians2dMcmc
from a2tg_jax.training import LearningRates, Stage
from a2tg_jax.training.start import padded

NUM = 40
NUM_FLOATS = (13, 22, 37, 58)
"""Of a Gaussian of degree 0 to 3."""


def random_degrees(seed: int, base: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(base, 4, NUM)


def cut(sh: np.ndarray, degrees: np.ndarray) -> np.ndarray:
    """The coefficients [N, 16, 3] with zeros above each Gaussian's degree."""
    bases = (degrees + 1) ** 2
    return np.where(np.arange(16)[None, :, None] < bases[:, None, None], sh, 0)


def banded(seed: int, base: int = 0, dtype: str = "float32", inner=None):
    """A model of a random degree per Gaussian, and the same of degree 3 with zeros."""
    scene, degrees = draw_scene(seed, num=NUM), random_degrees(seed, base)
    full = as_gaussians(scene, dtype)
    full = dataclasses.replace(full, sh=jnp.asarray(cut(np.asarray(full.sh), degrees), full.means.dtype))
    gaussians = dataclasses.replace(full, sh=full.sh[:, : (base + 1) ** 2])
    bands, layout = split_sh(np.asarray(full.sh), degrees, base)
    inner = inner or Plain()
    params, inner_layout = inner.allocate(jax.random.key(0), gaussians)
    shown = BandedParams(bands, params), BandedLayout(layout, inner_layout)
    plain = Model(full, params, inner_layout, appearance=inner)
    return Model(gaussians, *shown, appearance=Banded(inner)), plain, as_camera(scene, dtype)


@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize("base", range(4))
@pytest.mark.parametrize("seed", range(2))
def test_the_picture_is_that_of_zeros_for_what_is_missing(base, seed):
    model, plain, camera = banded(seed, base, "float64")
    np.testing.assert_allclose(model.render(camera).color, plain.render(camera).color, atol=1e-12)


@pytest.mark.parametrize("base", range(4))
def test_bytes_are_those_of_each_degree(base):
    model, _, _ = banded(1, base)
    degrees = random_degrees(1, base)
    np.testing.assert_array_equal(model.layout.bands.degrees, degrees)
    assert model.num_bytes == 4 * sum(NUM_FLOATS[degree] for degree in degrees)
    first = dataclasses.replace(model, num_live=jnp.int32(25))
    assert first.num_bytes == first.live.num_bytes == 4 * sum(NUM_FLOATS[degree] for degree in degrees[:25])


@pytest.mark.parametrize("degree", range(4))
def test_gaussians_of_one_degree_are_counted_by_it(degree):
    gaussians = as_gaussians(draw_scene(1, num=NUM), "float32")
    assert Model(dataclasses.replace(gaussians, sh=gaussians.sh[:, : (degree + 1) ** 2])).num_bytes == (
        4 * NUM * NUM_FLOATS[degree]
    )


@pytest.mark.usefixtures("x64")
def test_gradients_are_those_of_the_dense_coefficients():
    model, plain, camera = banded(2, dtype="float64")
    settings = plan_render(plain.gaussians, camera, head_room=2.0)
    weights = jnp.asarray(np.random.default_rng(0).normal(size=(camera.height, camera.width, 3)))

    def loss(gaussians, params, shown):
        changed = dataclasses.replace(shown, gaussians=gaussians, params=params)
        return jnp.sum(weights * changed.render(camera, settings=settings).color)

    of_gaussians, of_params = jax.grad(loss, argnums=(0, 1))(model.gaussians, model.params, model)
    expected, _ = jax.grad(loss, argnums=(0, 1))(plain.gaussians, plain.params, plain)
    found = dense_sh(np.asarray(of_gaussians.sh), of_params.bands, model.layout.bands)
    degrees = model.layout.bands.degrees
    np.testing.assert_allclose(found, cut(np.asarray(expected.sh), degrees)[:, : found.shape[1]], atol=1e-12)
    np.testing.assert_allclose(of_gaussians.means, expected.means, atol=1e-10)


@pytest.mark.parametrize(
    "inner", [Plain(), Textured((2, 1)), Textured((0, 0)), MovableKernels(), Billboards(3), Shaped()]
)
def test_whatever_else_is_shown_is_as_without(inner, tmp_path):
    model, plain, camera = banded(3, inner=inner)
    expected = plain.render(camera).color
    np.testing.assert_allclose(model.render(camera).color, expected, atol=1e-6)
    save_model(tmp_path / "m.npz", dataclasses.replace(model, num_live=jnp.int32(30)))
    loaded = load_model(tmp_path / "m.npz")
    assert loaded.appearance == model.appearance and loaded.num == 30
    np.testing.assert_array_equal(loaded.layout.bands.degrees, model.layout.bands.degrees[:30])
    shorter = dataclasses.replace(plain, num_live=jnp.int32(30))
    np.testing.assert_allclose(loaded.render(camera).color, shorter.render(camera).color, atol=1e-6)


def test_view_dependence_turns_with_the_world():
    model, plain, _ = banded(4)
    world = Similarity(1.5, Rotation.random(random_state=0).as_matrix(), np.array([0.3, -0.2, 0.1]))
    moved = model.transform(world)
    np.testing.assert_allclose(
        dense_sh(np.asarray(moved.gaussians.sh), moved.params.bands, moved.layout.bands),
        np.asarray(plain.transform(world).gaussians.sh),
        atol=1e-6,
    )


def test_a_ply_file_holds_all_coefficients(tmp_path):
    model, plain, _ = banded(5)
    save_ply(tmp_path / "m.ply", model)
    np.testing.assert_array_equal(load_ply(tmp_path / "m.ply").sh, np.asarray(plain.gaussians.sh))


@pytest.mark.parametrize("degree", range(4))
def test_a_ply_file_has_the_degree_of_the_gaussians(degree, tmp_path):
    gaussians = as_gaussians(draw_scene(1, num=NUM), "float32")
    gaussians = dataclasses.replace(gaussians, sh=gaussians.sh[:, : (degree + 1) ** 2])
    save_ply(tmp_path / "m.ply", gaussians)
    np.testing.assert_array_equal(load_ply(tmp_path / "m.ply").sh, gaussians.sh)


@pytest.mark.parametrize("seed", range(5))
def test_rows_that_move_take_along_what_there_is_room_for(seed):
    model, plain, _ = banded(seed)
    rows = np.random.default_rng(seed + 10).integers(0, NUM, NUM)
    layout = model.layout.bands
    found = gather_bands(model.params.bands, layout, jnp.asarray(rows))
    expected = cut(np.asarray(plain.gaussians.sh)[rows], layout.degrees)
    found = dense_sh(expected[:, :1], found, layout)
    np.testing.assert_array_equal(found, expected[:, : found.shape[1]])


@pytest.mark.parametrize("seed", range(5))
def test_other_degrees_keep_what_a_gaussian_keeps(seed):
    model, plain, _ = banded(seed)
    moments = adam_init((model.gaussians, model.params))
    ones = jax.tree.map(jnp.ones_like, moments.mu)
    degrees = random_degrees(seed + 20)
    layout = model.layout.bands
    bands, new, mu = reallocate_bands(model.params.bands, layout, degrees, ones)
    np.testing.assert_array_equal(new.degrees, degrees)
    both = np.minimum(degrees, layout.degrees)
    expected = cut(np.asarray(plain.gaussians.sh), both)
    found = dense_sh(expected[:, :1], bands, new)
    np.testing.assert_array_equal(found, expected[:, : found.shape[1]])
    kept = dense_sh(np.ones((NUM, 1, 3), np.float32), mu[1].bands, new)
    np.testing.assert_array_equal(kept, cut(np.ones((NUM, 16, 3)), both)[:, : kept.shape[1]])


def test_the_gradient_of_missing_coefficients_is_that_of_coefficients_that_are_zero():
    """Σ over views of ∂L/∂colour · Y is what JAX finds at zeros."""
    rng = np.random.default_rng(0)
    means, centers = rng.normal(size=(NUM, 3)), rng.normal(size=(6, 3)) + 5
    colors = rng.normal(size=(6, NUM, 3)).astype(np.float32)
    as_array = lambda x: jnp.asarray(x, jnp.float32)  # noqa: E731
    state = ViewDependence.init(NUM).observe(as_array(means), as_array(centers), as_array(colors))
    expected = np.zeros((NUM, 16, 3))
    for center, color in zip(centers, colors, strict=True):
        for i in range(NUM):
            direction = (means[i] - center) / np.linalg.norm(means[i] - center)
            expected[i] += np.outer(oracle.sh_basis(direction), color[i])
    np.testing.assert_allclose(state.total, expected, atol=1e-4)
    norms = [np.linalg.norm(expected[:, (d**2) : (d + 1) ** 2] / 6, axis=(1, 2)) for d in (1, 2, 3)]
    np.testing.assert_allclose(state.strengths(), np.stack(norms, 1), rtol=1e-4)


def test_degrees_rise_where_the_gradient_per_byte_is_largest():
    degrees = np.array([0, 0, 1, 2, 3])
    strengths = np.array([[4.0, 9, 9], [3.0, 9, 9], [9, 6.0, 9], [9, 9, 6.0], [9, 9, 9]])
    # Per byte: 4/36, 3/36, 6/60, 6/84; the last has all.
    np.testing.assert_array_equal(raised(degrees, strengths, 36), [1, 0, 1, 2, 3])
    np.testing.assert_array_equal(raised(degrees, strengths, 96), [1, 0, 2, 2, 3])
    np.testing.assert_array_equal(raised(degrees, strengths, 1000), [1, 1, 2, 3, 3])
    np.testing.assert_array_equal(raised(degrees, strengths, 0), degrees)


def test_idle_bands_are_given_up():
    degrees = np.array([0, 1, 1, 2])
    bands, layout = allocate_bands(degrees, 0)
    tables = [table.at[: len(np.flatnonzero(degrees > k))].set(0.0) for k, table in enumerate(bands.tables)]
    tables[0] = tables[0].at[1].set(1.0)
    found = without_idle(dataclasses.replace(bands, tables=tuple(tables)), layout, 0.01)
    np.testing.assert_array_equal(found, [0, 0, 1, 1])
    np.testing.assert_array_equal(without_idle(bands, layout, 0.0), degrees)


@pytest.mark.parametrize("budget_mb", [0.0025, 0.0031])
def test_an_event_stays_within_its_budget_and_spends_it(budget_mb):
    model, _, camera = banded(6, inner=Textured((0, 0)))
    event = AdaptDegrees(budget_mb, at=(0.5,))
    cameras = jax.tree.map(lambda x: x[None], camera)
    colors = jnp.asarray(np.random.default_rng(0).normal(size=(1, NUM, 3)), jnp.float32)
    nothing = jnp.zeros_like(colors)
    seen = Seen(cameras, nothing, jnp.zeros((1, NUM), bool), colors)
    params, layout = model.appearance.allocate(jax.random.key(0), model.gaussians)
    base = dataclasses.replace(model, params=params, layout=layout)
    state = event.observe(event.init(base), base, seen)
    after = event.apply(Due(), base, adam_init((base.gaussians, base.params)), state).model
    assert 1e6 * budget_mb - 36 < after.num_bytes <= 1e6 * budget_mb
    np.testing.assert_allclose(after.render(camera).color, base.render(camera).color, atol=1e-6)


@pytest.mark.parametrize("base, highest, num_bytes", [(0, 2, 5_000), (1, 3, 900), (0, 3, 100_000)])
def test_there_is_room_for_all_degrees_that_fit(base, highest, num_bytes):
    """Any degrees within the bytes fit the tables that are planned before, and no table has a row too many."""
    rng = np.random.default_rng(highest)
    rows = most_rows(num_bytes, base, highest, NUM)
    bands = range(base + 1, 4)
    for favourite in range(base + 1, highest + 1):  # As many of one degree as fit.
        cost = 4 * sum(floats_of_band(band) for band in bands if band <= favourite)
        count = min(NUM, num_bytes // cost)
        wanted = [count if band <= favourite else 0 for band in bands]
        assert all(room >= need for room, need in zip(rows, wanted, strict=True))
        assert rows[favourite - base - 1] == count
    assert all(room == 0 for room, band in zip(rows, bands, strict=True) if band > highest)
    degrees = rng.integers(base, highest + 1, NUM)
    empty, layout = allocate_bands(np.full(NUM, base), base)
    tables, owners, _ = reallocate_bands(empty, layout, degrees, None, [NUM] * len(layout.owners))
    assert [len(table) for table in tables.tables] == [NUM] * len(bands)
    np.testing.assert_array_equal(owners.degrees, degrees)
    tables, owners, _ = reallocate_bands(tables, owners, degrees, None, [1] * len(bands))
    np.testing.assert_array_equal(owners.degrees, degrees)


@pytest.mark.parametrize("damage", ["bands", "inner", "degree"])
def test_a_file_whose_parts_disagree_is_refused(tmp_path, monkeypatch, damage):
    model, _, _ = banded(3, inner=Textured((2, 1)))
    other, _, _ = banded(4, base=1, inner=Textured((2, 1)))
    if damage == "degree":
        model = dataclasses.replace(model, gaussians=other.gaussians)
    else:
        part = Banded(Textured((2, 1))).first_rows(model.params, model.layout, 20)
        layout = model.layout._replace(**{damage: getattr(part[1], damage)})
        params = model.params._replace(**{damage: getattr(part[0], damage)})
        model = dataclasses.replace(model, params=params, layout=layout)
    with pytest.raises(
        ValueError,
        match=r"^(Banded has (20 degrees, but there are 40|bands above degree 0, but the)|Textured has 20 rows)",
    ):
        save_model(tmp_path / "m.npz", model)
    with monkeypatch.context() as patch:
        patch.setattr("a2tg_jax.io.model_file.check_model", lambda model: None)
        save_model(tmp_path / "m.npz", model)
    with pytest.raises(ValueError, match=r"m\.npz: .*(Banded|Textured) has"):
        load_model(tmp_path / "m.npz")


def test_degrees_that_have_risen_are_not_lost_where_gaussians_are_added():
    model, _, _ = banded(5)
    stage = Stage("more", model.appearance, (Mcmc(2 * NUM),), (), LearningRates(), 100, BandedRates(0.0))
    with pytest.raises(ValueError, match="textures or degrees have grown already"):
        padded(model, stage, Gaussians2dMcmc())


def test_degrees_rise_in_banded_models_only():
    model = Model(as_gaussians(draw_scene(1, num=NUM), "float32"))
    event = AdaptDegrees(1.0)
    with pytest.raises(ValueError, match="Plain has no degrees that could rise; Banded has"):
        event.apply(Due(), model, adam_init((model.gaussians, ())), event.init(model))


def test_a_ply_file_of_nothing(tmp_path):
    gaussians = as_gaussians(draw_scene(1, num=NUM), "float32")[:0]
    save_ply(tmp_path / "m.ply", gaussians)
    assert load_ply(tmp_path / "m.ply").num == 0


def test_nothing_is_bought_with_nothing():
    assert not within_budget(np.ones(3), np.ones(3, bool), np.full(3, 16), 0).any()
