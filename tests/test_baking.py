"""Baking: plain Gaussians in place of textured ones look like them."""

import dataclasses
import itertools
import sys

import jax.numpy as jnp
import numpy as np
import pytest
from run_folders import create_run
from scipy import integrate
from small_models import with_bands
from small_values import some_gaussians

from a2tg_jax import (
    A2tg,
    Appearance,
    Camera,
    Exponents,
    Gaussians,
    Model,
    Origin,
    Texture,
    TextureOptions,
    load_gltf,
    load_splats,
    save_gltf,
    save_model,
    save_splats,
    textures_from_arrays,
)
from a2tg_jax.cli.main import main
from a2tg_jax.data.load import SceneSource
from a2tg_jax.finish import baking
from a2tg_jax.finish.baking import bake, kernels, shares_inside
from a2tg_jax.finish.shrinking import fewest_texels
from a2tg_jax.results import conversion
from a2tg_jax.results.record import RunRecord, write_record

CAMERA = Camera(jnp.eye(4).at[2, 3].set(4), jnp.asarray([[60.0, 0, 24], [0, 60, 18], [0, 0, 1]]), 48, 36)


def textured(num: int = 3, side: int = 4, seed: int = 0) -> Model:
    """A few large splats with random textures, before a camera."""
    rng = np.random.default_rng(seed)
    texels = [rng.uniform(size=(side, side, 4)) * [0.8, 0.8, 0.8, 1] for _ in range(num)]
    textures = textures_from_arrays([np.asarray(t, np.float32) for t in texels])
    gaussians = Gaussians(
        means=jnp.asarray(rng.normal(size=(num, 3)) * 0.5, jnp.float32),
        quats=jnp.asarray(np.c_[np.ones(num), 0.3 * rng.normal(size=(num, 3))], jnp.float32),
        log_scales=jnp.full((num, 2), -1.0),
        logit_opacities=jnp.full(num, 2.0),
        sh=jnp.zeros((num, 1, 3)),
    )
    return Model(gaussians, Appearance(texture=Texture(textures)), origin=Origin.of_cameras([CAMERA]))


def banded(inner: Model) -> Model:
    """The same model with one splat of degree 3 and the others of degree 0."""
    degrees = 3 * (np.arange(inner.num) == 0)
    return with_bands(inner, np.ones((inner.num, 15, 3), np.float32), degrees)


def shaped(inner: Model) -> Model:
    """The same model with kernels of long tails and of sharp edges by turns."""
    shapes = jnp.asarray(np.resize([-2.0, 2.0], inner.num), jnp.float32)
    return dataclasses.replace(inner, appearance=dataclasses.replace(inner.appearance, exponents=Exponents(shapes)))


def psnr(model: Model, other: Model) -> float:
    found, wanted = (np.clip(each.render(CAMERA).color, 0, 1) for each in (model, other))
    return float(-10 * np.log10(np.mean((found - wanted) ** 2)))


def without_textures(model: Model) -> Model:
    return dataclasses.replace(model, appearance=Appearance())


def split_splats(model: Model, growth: float = 2.0) -> Model:
    return bake(model, [CAMERA], growth=growth, iterations=0)


def kernel_at(log_exponent: float, rho: np.ndarray) -> np.ndarray:
    """exp(−((ρ + ε)^β − ε^β) / ((2 + ε)^β − ε^β)) for ε = 0.02: 1 at the centre, 1/e at √2 standard deviations."""
    beta = np.exp(log_exponent)
    epsilon = 0.02
    start = epsilon**beta
    return np.exp(-((rho + epsilon) ** beta - start) / ((2 + epsilon) ** beta - start))


CONVENTIONS = [TextureOptions(), TextureOptions("align-corners")]


@pytest.mark.parametrize(
    ("num", "options"), [(1, TextureOptions()), *itertools.product((2, 4, 8), CONVENTIONS)], ids=str
)
def test_kernels_add_up_to_the_gaussian(num, options):
    means, scales = kernels(num, options)
    u = np.linspace(-4, 4, 401)
    each = np.exp(-0.5 * ((u[:, None] - means) / scales) ** 2)
    peaks = np.linalg.lstsq(each, np.exp(-0.5 * u * u), rcond=None)[0]
    assert peaks.min() > 0
    # Gaussians of a bilinear kernel's variance h²/6, h apart, have a ripple of 2·exp(−2π²/6), 7.5 % of their sum.
    np.testing.assert_allclose(each @ peaks, np.exp(-0.5 * u * u), atol=0.075)


@pytest.mark.parametrize("extent", [0.01, 0.5, 1.5, 20.0])
def test_kernels_have_the_mean_and_the_variance_of_their_texels(extent):
    """By scipy's quadrature, piece by piece; texels far outside are somewhere, with a size."""
    options = TextureOptions(outside="identity", extent=extent)
    num = 4
    means, scales = kernels(num, options)
    assert np.isfinite(means).all() and (scales > 0).all() and (np.diff(means) > 0).all()
    centers = extent * np.array([-0.75, -0.25, 0.25, 0.75])
    ends = sorted({-12.0, 12.0, *(end for end in (*centers, -extent, extent) if abs(end) < 12)})

    def weight(u, j, k):
        return np.interp(u, centers, np.eye(num)[j]) * np.exp(-0.5 * u * u) * u**k

    for j in range(num):
        moments = np.zeros((2, 3))
        for low, high in itertools.pairwise(ends):
            for k in range(3):
                moments[int(abs(low + high) < 2 * extent), k] += integrate.quad(weight, low, high, (j, k))[0]
        mass, first, second = moments.sum(axis=0)
        if mass > 1e-9:
            np.testing.assert_allclose(means[j], first / mass, rtol=1e-3, atol=1e-5)
            np.testing.assert_allclose(scales[j] ** 2, second / mass - (first / mass) ** 2, rtol=2e-3)
            np.testing.assert_allclose(shares_inside(num, options)[j], moments[1, 0] / mass, atol=2e-3)


@pytest.mark.parametrize("outside", ["clamp", "identity"])
def test_textures_of_another_extent_become_splats_where_they_are_shown(outside):
    model = textured()
    options = TextureOptions(outside=outside, extent=1.5)
    texture = dataclasses.replace(model.appearance.texture, options=options)
    model = dataclasses.replace(model, appearance=dataclasses.replace(model.appearance, texture=texture))
    found = split_splats(model)
    assert psnr(found, model) > psnr(without_textures(model), model) + 2


def test_a_splat_per_texel_looks_like_the_texture():
    model = textured()
    split = split_splats(model)
    assert split.num > 3 * model.num and split.num_bytes <= 2 * model.num_bytes
    assert psnr(split, model) > psnr(without_textures(model), model) + 5


@pytest.mark.parametrize("shape", [-0.8, 0.3])
def test_small_splats_are_as_opaque_as_the_kernel_at_their_centres(shape):
    """Their optical depths add up to those of the kernel, but at corners, where some would have to be negative."""
    parent = dataclasses.replace(some_gaussians(1), logit_opacities=jnp.asarray([1.0]))
    means, scales = axis = kernels(4, TextureOptions())
    found = baking._grid(parent, np.asarray([shape]), np.ones((1, 4, 4, 4)), axis, axis)
    mixed = np.exp(-0.5 * ((means[:, None] - means[None]) / scales[None]) ** 2)
    depths = mixed @ -np.log1p(-np.asarray(found.opacities, np.float64)).reshape(4, 4) @ mixed.T
    rho = means[:, None] ** 2 + means[None] ** 2
    kernel = kernel_at(np.tanh(shape), rho)
    np.testing.assert_allclose(1 - np.exp(-depths), parent.opacities[0] * kernel, atol=3e-3)


@pytest.mark.parametrize("log_exponent", [-1.0, 0.0, 0.4])
def test_the_nearest_gaussian_has_the_least_squared_difference(log_exponent):
    gaussians = dataclasses.replace(some_gaussians(1), logit_opacities=jnp.zeros(1))
    shapes = jnp.arctanh(jnp.clip(jnp.asarray([log_exponent]), -1 + 1e-7, 1))
    found = split_splats(Model(gaussians, Appearance(exponents=Exponents(shapes)))).gaussians
    peak = 2 * float(found.opacities[0])
    factor = float(jnp.exp(found.log_scales - gaussians.log_scales)[0, 0])
    rho = np.linspace(0, 144, 100_001)
    kernel = kernel_at(log_exponent, rho)
    difference = lambda a, k: np.mean((a * np.exp(-rho / 2 / k) - kernel) ** 2)  # noqa: E731
    least = difference(peak, factor**2)
    others = [difference(peak * a, factor**2 * k) for a, k in ((0.95, 1), (1.05, 1), (1, 0.9), (1, 1.1), (1.05, 0.95))]
    assert least < min(others) and (log_exponent == 0) == (abs(peak - 1) < 1e-4 and abs(factor - 1) < 1e-4)


def test_texels_are_kept_where_pictures_need_them():
    even = np.ones((4, 4, 4), np.float32)
    striped = np.ones((4, 4, 4), np.float32)
    striped[:, ::2, :3] = 0.2
    textures = textures_from_arrays([even, striped, striped])
    weights = tuple(jnp.ones_like(bucket).at[2].set(1e-6) for bucket in textures.buckets)
    weights = dataclasses.replace(textures, buckets=weights)
    tables = fewest_texels(textures, weights, 6)
    sizes = {int(index): texels.shape[1:3] for ids, texels in tables for index in ids}
    assert sizes == {0: (1, 1), 1: (1, 4), 2: (1, 1)}
    found = next(texels for ids, texels in tables if 1 in ids)
    np.testing.assert_allclose(found[0, 0, :, 0], [0.2, 1, 0.2, 1], rtol=1e-5)


def test_training_brings_a_plain_model_nearer_over_its_background():
    """Cameras in one place, which have no extent, move the means as well."""
    wanted = dataclasses.replace(textured(), background=(1.0, 1.0, 1.0))
    start = split_splats(wanted)
    trained = bake(wanted, [CAMERA], growth=2.0, iterations=30)
    assert trained.num == start.num and trained.origin == wanted.origin
    assert (np.asarray(trained.gaussians.means) != np.asarray(start.gaussians.means)).any()
    assert psnr(trained, wanted) > psnr(start, wanted) + 0.5


@pytest.mark.long
def test_growth_is_kept_where_degrees_differ(monkeypatch):
    monkeypatch.setattr(baking, "least_degree", lambda *_: 3)
    monkeypatch.setattr(baking, "texel_weights", lambda model, *_: model.textures)
    inner = textured(30, side=1)
    for model in (banded(inner), banded(Model(inner.gaussians))):
        baked = split_splats(model, 1.6)
        assert baked.gaussians.sh_degree == 1 and baked.num_bytes <= 1.6 * model.num_bytes
        assert split_splats(model, 9.0).gaussians.sh_degree == 3


@pytest.mark.parametrize(("is_test", "counts"), [([False, True, False], (2, 1)), ([True] * 3, (3, 0))])
def test_held_out_cameras_do_not_train(is_test, counts):
    origin = Origin.of_cameras([CAMERA] * 3, is_test=is_test)
    assert (len(origin.training_cameras), len(origin.held_out_cameras)) == counts


@pytest.mark.long
def test_plain_files_hold_the_nearest_gaussians(tmp_path):
    model = shaped(without_textures(textured()))
    save_splats(tmp_path / "a.ply", model)
    found = without_textures(dataclasses.replace(model, gaussians=load_splats(tmp_path / "a.ply").gaussians))
    assert psnr(found, model) > psnr(without_textures(model), model) + 2
    np.testing.assert_allclose(split_splats(model).gaussians.log_scales, found.gaussians.log_scales, rtol=1e-6)
    save_gltf(tmp_path / "a.glb", model, textures=False)
    np.testing.assert_allclose(load_gltf(tmp_path / "a.glb").gaussians.scales, found.gaussians.scales, rtol=1e-5)


def test_other_appearances_give_their_gaussians():
    model = dataclasses.replace(Model(some_gaussians(5)), origin=Origin.of_cameras([CAMERA]))
    baked = bake(model, [CAMERA], growth=2.0, iterations=0)
    np.testing.assert_array_equal(baked.gaussians.means, model.gaussians.means)
    with pytest.raises(ValueError, match="growth of at least 1"):
        bake(model, [CAMERA], growth=0.5, iterations=0)


@pytest.mark.filterwarnings("ignore::a2tg_jax.rasterize.room.EmptyRenderWarning")
def test_few_gaussians_are_baked():
    model = textured()
    with pytest.raises(ValueError, match="no Gaussians to bake"):
        bake(model[np.zeros(model.num, bool)], [CAMERA], growth=2.0, iterations=3)
    single = model.with_textures(textures_from_arrays([np.zeros((1, 1, 4), np.float32)] * model.num))
    single = single[np.arange(model.num) == 0]
    assert bake(single, [CAMERA], growth=1.0, iterations=3).num == 1


@pytest.mark.long
def test_convert_bakes(tmp_path, capsys):
    model = textured()
    official = Appearance(texture=Texture(model.textures, options=TextureOptions.official()))
    save_model(tmp_path / "a.npz", dataclasses.replace(model, appearance=official))
    arguments = ["convert", str(tmp_path / "a.npz"), str(tmp_path / "b.ply"), "--bake", "--bake-iterations", "0"]
    assert main(arguments) == 0
    printed = capsys.readouterr().out
    assert (
        "baked: 3 splats into" in printed
        and "against the model in 1 training view" in printed
        and "textures" not in printed
    )
    assert load_splats(tmp_path / "b.ply").num > 3
    assert main(["convert", str(tmp_path / "b.ply"), str(tmp_path / "c.ply"), "--bake"]) == 2
    assert "needs a model with cameras" in capsys.readouterr().err


def test_a_bake_of_a_run_is_kept(tmp_path, monkeypatch, capsys):
    """It is used again for the same model and options only."""
    run = create_run(tmp_path / "run")
    model = textured()
    baked = []
    system = A2tg(stage1_iterations=1, stage2_iterations=1)
    write_record(run, RunRecord(SceneSource("/scene"), "a2tg", system))
    save_model(run.own(run.model("a2tg-textures")), model)

    def once(*arguments, **options):
        baked.append(options)
        return bake(*arguments, **options | {"progress": False})

    monkeypatch.setattr(conversion, "bake", once)

    def converts(name, *options):
        words = ["convert", str(run.path), str(tmp_path / name), "--bake", "--bake-iterations", "0", *options]
        assert main(words) == 0
        return capsys.readouterr().out.splitlines()[0]

    first = converts("a.ply")
    again = converts("b.npz")
    assert again == f"{first}; kept in {run.baked('a2tg-textures')}" and len(baked) == 1
    assert load_splats(tmp_path / "b.npz").num == load_splats(tmp_path / "a.ply").num
    converts("c.ply", "--bake-growth", "1.5")
    save_model(run.model("a2tg-textures"), model.with_sh(model.sh + 0.1))
    converts("d.ply", "--bake-growth", "1.5")
    run.baked("a2tg-textures").write_bytes(b"damaged")
    converts("e.ply", "--bake-growth", "1.5")
    assert len(baked) == 4 and "baked/a2tg-textures.npz" in run.written()


def test_a_file_that_cannot_be_written_is_refused_before_baking(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "pxr", None)
    monkeypatch.setattr(conversion, "open_source", lambda *_: pytest.fail("the model was read"))
    (tmp_path / "a.npz").touch()
    assert main(["convert", str(tmp_path / "a.npz"), str(tmp_path / "b.usdz"), "--bake"]) == 2
    assert "pip install" in capsys.readouterr().err
