"""Indices and numbers that come from data: stray ones never lead a kernel outside its arrays, and a splat with a number
that is not finite is seen in the picture.

Places or a list under jit have no values to check. Native loops and GPU kernels read and write through pointers, so
that a stray index would end the process, or return other memory as a gradient.
"""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes_random import as_camera, as_gaussians, as_textures, assert_all_close, draw_scene, quick_then_long
from small_models import billboards

import a2tg_jax as a2tg
from a2tg_jax import Appearance, Texture, TextureRegion
from a2tg_jax.rasterize.compositor import composite
from a2tg_jax.rasterize.kernels.native import composite as native
from a2tg_jax.rasterize.splats import project_gaussians, settings_of_pass
from a2tg_jax.rasterize.tiles import TileGrid, tile_lists
from a2tg_jax.rasterize.views import render_traced

NUM = 50
SCENE = draw_scene(1, num=NUM)
GAUSSIANS = as_gaussians(SCENE, "float32")
CAMERA = as_camera(SCENE, "float32")
LIMITS = np.iinfo(np.int32)
STRAY = [LIMITS.min, -100_000, -1, NUM, 100_000, 100_000_000, LIMITS.max]
WITH_CUDA = quick_then_long(["native"], ["cuda"])
WITH_XLA = quick_then_long(["native"], ["xla"])
ALL = quick_then_long(["native"], ["cuda", "xla"])


def textures_of(sizes):
    """Textures of random texels, in the given sizes."""
    rng = np.random.default_rng(3)
    return a2tg.textures_from_arrays([rng.uniform(size=(*size, 4)).astype(np.float32) for size in sizes])


TEXTURES = textures_of([(2, 2), (1, 4), (8, 8), (1, 1), (0, 0)] * (NUM // 5))


@functools.cache
def rendered(compositor):
    """A traced function of texels and places to the sum of the squared image."""
    settings = a2tg.RenderSettings(compositor=compositor, capacity=4096)

    def total(floats, places):
        textures = a2tg.combine(floats, places)
        return jnp.sum(a2tg.render_image(GAUSSIANS, CAMERA, textures, settings=settings).color ** 2)

    differentiate = jax.jit(jax.value_and_grad(total))
    return lambda textures: differentiate(*a2tg.partition(textures))


@pytest.mark.parametrize("compositor", WITH_CUDA)
def test_traced_places_where_no_texture_is_show_the_nearest_one(compositor):
    render = rendered(compositor)
    by_xla = rendered("xla")
    rng = np.random.default_rng(0)
    for stray in STRAY:
        for field in ("row", "bucket"):
            index = np.where(rng.uniform(size=NUM) < 0.7, stray, getattr(TEXTURES, field)).astype(np.int32)
            moved = dataclasses.replace(TEXTURES, **{field: jnp.asarray(index)})
            (value, gradient), (wanted, wanted_gradient) = render(moved), by_xla(moved)
            np.testing.assert_allclose(value, wanted, rtol=1e-5)
            for own, other in zip(gradient.buckets, wanted_gradient.buckets, strict=True):
                np.testing.assert_allclose(own, other, rtol=1e-3, atol=1e-4)
            last = [len(bucket) - 1 for bucket in TEXTURES.buckets]
            bucket = np.clip(moved.bucket, 0, len(last) - 1)
            row = np.clip(moved.row, 0, np.asarray(last)[bucket])
            np.testing.assert_array_equal(value, render(dataclasses.replace(TEXTURES, bucket=bucket, row=row))[0])


@pytest.mark.long
@pytest.mark.parametrize("dtype", [np.int8, np.uint32])
def test_places_of_any_integers(dtype):
    render = rendered("native")
    most = np.iinfo(dtype).max
    is_stray = np.arange(NUM) % 2 == 0
    row = np.where(is_stray, most, np.asarray(TEXTURES.row)).astype(dtype)
    as_int32 = np.where(is_stray, min(most, LIMITS.max), np.asarray(TEXTURES.row)).astype(np.int32)
    value, other = (render(dataclasses.replace(TEXTURES, row=jnp.asarray(own)))[0] for own in (row, as_int32))
    np.testing.assert_array_equal(value, other)
    np.testing.assert_allclose(
        value, rendered("xla")(dataclasses.replace(TEXTURES, row=jnp.asarray(row)))[0], rtol=1e-5
    )


@pytest.mark.parametrize("compositor", ALL)
def test_places_of_other_textures(compositor):
    """Texels of four textures, or of 5000, with fifty places."""
    plain = rendered(compositor)(a2tg.allocate_textures([(2, 2)] * NUM))[0]
    for num in (4, 5000):
        textures = a2tg.allocate_textures([(2, 2)] * num)
        bucket = jnp.zeros(NUM, jnp.int32)
        row = jnp.arange(NUM, dtype=jnp.int32)
        value, gradient = rendered(compositor)(dataclasses.replace(textures, bucket=bucket, row=row))
        np.testing.assert_array_equal(value, plain)
        assert np.isfinite(gradient.buckets[0]).all() and np.abs(gradient.buckets[0]).max() > 0


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"row": 100_000_000}, r"textures\.row must be below .* 10 in bucket 3; got 100000000 for Gaussian 0"),
        ({"row": -1}, r"textures\.row must be below"),
        ({"bucket": 7}, r"textures\.bucket must be 0 to 4; got 7 to 11"),
        ({"bucket": -1}, r"textures\.bucket must be 0 to 4; got -1 to 3"),
        ({"row": np.float32(0)}, r"textures\.row must be integers"),
    ],
)
def test_an_eager_render_refuses_it_by_name(changes, message):
    moved = {field: np.asarray(getattr(TEXTURES, field)) + np.asarray(by) for field, by in changes.items()}
    moved = {field: own.astype("float32" if "integers" in message else "int32") for field, own in moved.items()}
    with pytest.raises(ValueError, match=message):
        a2tg.render_image(GAUSSIANS, CAMERA, dataclasses.replace(TEXTURES, **moved))


@pytest.mark.long
def test_pictures_with_rows_out_of_range():
    """Refused eagerly, the nearest picture under jit, as with textures."""
    pictures = textures_of([(4, 4)] * NUM)
    stray, last = (dataclasses.replace(pictures, row=jnp.full(NUM, row, jnp.int32)) for row in (
        2**30, len(pictures.buckets[0]) - 1))  # fmt: skip
    with pytest.raises(ValueError, match=r"appearance\.pictures\.row must be below the number"):
        a2tg.Model(GAUSSIANS, billboards(pictures=stray, side=4)).render(CAMERA)

    @functools.partial(jax.jit, static_argnums=0)
    def drawn(compositor, pictures):
        settings = a2tg.RenderSettings(compositor=compositor, capacity=4096)
        return a2tg.Model(GAUSSIANS, billboards(pictures=pictures, side=4)).render(CAMERA, settings=settings).color

    np.testing.assert_array_equal(drawn("native", stray), drawn("native", last))
    np.testing.assert_allclose(drawn("native", stray), drawn("xla", stray), atol=1e-5)


@functools.cache
def view_of(compositor):
    """What a compositor takes for the scene: settings, splats, texels, regions, cutoff, and good lists."""
    appearance = a2tg.Appearance(texture=Texture(TEXTURES))
    grid = TileGrid(CAMERA.width, CAMERA.height, 16)
    splats, cutoff = project_gaussians(GAUSSIANS, CAMERA, appearance, 0.2, 3)
    options = {"has_geometry": False, "statistic": "position", "compositor": compositor, "tile_batch": 1}
    settings, *places = settings_of_pass(appearance, splats, grid, 0.2, **options)
    return settings, splats, *places, cutoff, tile_lists(splats.M, cutoff, 0.2, grid, 1024)


@functools.cache
def differentiated(compositor):
    """A function of regions and lists to the image and gradients of the scene."""
    settings, splats, texels, _, cutoff, _ = view_of(compositor)

    def total(splats, texels, probe, regions, lists):
        channels, transmittance = composite(settings, splats, texels, regions, cutoff, lists, jnp.eye(3), probe)
        return jnp.sum(channels**2) + jnp.sum(transmittance)

    differentiate = jax.jit(jax.value_and_grad(total, argnums=(0, 1, 2)))
    return functools.partial(differentiate, splats, texels, jnp.zeros((NUM, 4)))


def stray_numbers(rng, numbers):
    """The same integers with some of them out of range."""
    is_moved = rng.uniform(size=numbers.shape) < rng.uniform()
    return jnp.asarray(np.where(is_moved, rng.choice(STRAY, numbers.shape), numbers).astype(np.int32))


@pytest.mark.parametrize("compositor", WITH_CUDA)
def test_regions_and_lists_of_any_integers(compositor):
    """Good ones lead to what XLA finds, and nearly so do stray regions."""
    _, _, _, regions, _, lists = view_of("native")
    run = differentiated(compositor)
    by_xla = differentiated("xla")
    assert_all_close(run(regions, lists), by_xla(regions, lists), 1e-3, 1e-3)
    for seed in range(8):
        rng = np.random.default_rng(seed)
        stray = TextureRegion(*(stray_numbers(rng, np.asarray(numbers)) for numbers in regions))
        ids, starts = (stray_numbers(rng, np.asarray(numbers)) for numbers in (lists.ids, lists.starts))
        found = run(stray, lists._replace(ids=ids, starts=starts))
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(found))
        if seed >= 4 or compositor == "cuda":
            continue
        found = run(stray, lists)
        wanted = by_xla(stray, lists)
        np.testing.assert_allclose(found[0], wanted[0], rtol=1e-3)
        for own, other in zip(jax.tree.leaves(found), jax.tree.leaves(wanted), strict=True):
            # Textures of a thousand texels along an axis have slopes that turn rounding into another pixel at 1/255.
            is_same = np.isclose(own, other, rtol=1e-3, atol=1e-3 * float(jnp.abs(other).max(initial=0)))
            assert not is_same.size or is_same.mean() > 0.97


def test_lists_of_any_homographies():
    """NaN, infinities and huge numbers in M and in the cutoff."""
    _, splats, _, _, cutoff, _ = view_of("native")
    odd = np.asarray([np.nan, np.inf, -np.inf, 1e30, -1e30, 0.0, 1e-30], np.float32)
    run = jax.jit(native.tile_lists, static_argnums=(2, 3, 4))
    for seed in range(6):
        rng = np.random.default_rng(seed)
        given = [
            jnp.asarray(np.where(rng.uniform(size=x.shape) < 0.2, rng.choice(odd, x.shape), np.asarray(x)))
            for x in (splats.M, cutoff)
        ]
        lists = run(*given, 0.2, TileGrid(SCENE.width, SCENE.height, 8), 4096)
        assert lists.starts[0] >= 0 and lists.starts[-1] <= 4096 and (np.diff(lists.starts) >= 0).all()
        assert (np.asarray(lists.ids) >= 0).all() and (np.asarray(lists.ids) < NUM).all()


def test_rows_of_regions_and_of_models_are_counted():
    @a2tg.pytree
    class Short(a2tg.Appearance):
        def atlas(self):
            texels, regions = super().atlas()
            return texels, TextureRegion(*(numbers[:9] for numbers in regions))

    with pytest.raises(ValueError, match=r"regions\.first \[N\] of N = 50 gaussians; Short gave \(9,\)"):
        a2tg.render_appearance(GAUSSIANS, CAMERA, Short(texture=Texture(TEXTURES)))
    for num_live in (-1, NUM + 1, 2.5):
        with pytest.raises(ValueError, match=rf"num_live must be a whole number in 0\.\.{NUM}; got {num_live}"):
            a2tg.Model(GAUSSIANS, num_live=num_live).render(CAMERA)


SMALL = draw_scene(4, num=16, width=19, height=13)
FIELDS = ("means", "quats", "log_scales", "logit_opacities", "sh")


def with_number(gaussians, field: str, row: int, number: float):
    array = getattr(gaussians, field)
    flat = array.reshape(len(array), -1).at[row, 0].set(number)
    return dataclasses.replace(gaussians, **{field: flat.reshape(array.shape)})


@pytest.mark.parametrize("compositor", WITH_XLA)
def test_a_splat_that_is_not_a_number_does_not_vanish_unless_it_shows_nowhere(compositor):
    """Behind the camera, too faint, or beyond the live rows, it may hold anything."""
    gaussians = as_gaussians(SMALL, "float32")
    camera = as_camera(SMALL, "float32")
    settings = a2tg.RenderSettings(compositor=compositor, capacity=1024)

    @jax.jit
    @functools.partial(jax.value_and_grad, has_aux=True)
    def differentiate(gaussians, num_live):
        given = gaussians, camera, Appearance(), jnp.zeros(3), settings
        output, _ = render_traced(*given, num_live=num_live)
        return jnp.sum(output.color**2), output

    for field in FIELDS:
        (_, output), gradient = differentiate(with_number(gaussians, field, 1, np.nan), 16)
        assert jnp.isnan(output.color).all() and jnp.isnan(output.alpha).all() and jnp.isnan(output.depth).all()
        assert jnp.isnan(gradient.logit_opacities).any() and not output.overflow
    hidden = with_number(gaussians, "logit_opacities", 0, -20.0)
    for odd, plain, num_live in (
        (with_number(hidden, "sh", 0, np.nan), hidden, 16),
        (with_number(gaussians, "means", 8, np.nan), gaussians, 8),
    ):
        colors = [differentiate(each, num_live)[0][1].color for each in (odd, plain)]
        np.testing.assert_array_equal(*colors)


@pytest.mark.parametrize("compositor", ALL)
def test_a_texel_that_is_not_a_number_is_seen(compositor):
    gaussians = as_gaussians(SMALL, "float32")
    camera = as_camera(SMALL, "float32")
    textures = as_textures(SMALL, "float32")
    settings = a2tg.RenderSettings(compositor=compositor, capacity=1024)
    draw = jax.jit(lambda textures: a2tg.render_image(gaussians, camera, textures, settings=settings))
    shown = draw(textures).alpha > 0.05
    assert shown.any()
    for column in (0, 3):
        broken = dataclasses.replace(textures, buckets=tuple(b.at[..., column].set(jnp.nan) for b in textures.buckets))
        assert jnp.isnan(draw(broken).color[..., 0])[shown].all()
