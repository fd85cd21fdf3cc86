"""Indices that come from data never lead a kernel outside its arrays: places, regions, lists of tiles, homographies.

Places or a list under jit have no values to check. Native loops and GPU kernels read and write through pointers, so
that a stray index would end the process, or return other memory as a gradient.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes_random import as_camera, as_gaussians, draw_scene

import a2tg_jax as a2tg
from a2tg_jax.appearance import Billboards, Texture
from a2tg_jax.core.bilinear import TextureRegion
from a2tg_jax.rasterize.compositor import composite
from a2tg_jax.rasterize.kernels.native import composite as native
from a2tg_jax.rasterize.splats import project_gaussians, settings_of_pass
from a2tg_jax.rasterize.tiles import TileGrid, tile_lists

NUM = 50
SCENE = draw_scene(1, num=NUM)
LIMITS = np.iinfo(np.int32)
STRAY = [LIMITS.min, -100_000, -1, NUM, 100_000, 100_000_000, LIMITS.max]
COMPOSITORS = ["native", "cuda", "xla"]


def textures_of(sizes):
    """Textures of random texels, in the given sizes."""
    rng = np.random.default_rng(3)
    return a2tg.textures_from_arrays([rng.uniform(size=(*size, 4)).astype(np.float32) for size in sizes])


TEXTURES = textures_of([(2, 2), (1, 4), (8, 8), (1, 1), (0, 0)] * (NUM // 5))


def rendered(compositor):
    """A traced function of texels and places to the sum of the squared image."""
    gaussians, camera = as_gaussians(SCENE, "float32"), as_camera(SCENE, "float32")
    settings = a2tg.RenderSettings(compositor=compositor, capacity=4096)

    def total(floats, places):
        textures = a2tg.combine(floats, places)
        return jnp.sum(a2tg.render_image(gaussians, camera, textures, settings=settings).color ** 2)

    differentiate = jax.jit(jax.value_and_grad(total))
    return lambda textures: differentiate(*a2tg.partition(textures))


@pytest.fixture(scope="module")
def by_xla():
    return rendered("xla")


@pytest.mark.parametrize("compositor", ["native", "cuda"])
def test_traced_places_where_no_texture_is_show_the_nearest_one(compositor, by_xla):
    render, rng = rendered(compositor), np.random.default_rng(0)
    for stray in STRAY:
        for field in ("row", "bucket"):
            is_moved = rng.uniform(size=NUM) < 0.7
            index = np.where(is_moved, stray, getattr(TEXTURES, field)).astype(np.int32)
            moved = dataclasses.replace(TEXTURES, **{field: jnp.asarray(index)})
            value, gradient = render(moved)
            wanted, wanted_gradient = by_xla(moved)
            np.testing.assert_allclose(value, wanted, rtol=1e-5)
            for own, other in zip(gradient.buckets, wanted_gradient.buckets, strict=True):
                np.testing.assert_allclose(own, other, rtol=1e-3, atol=1e-4)
            last = [len(bucket) - 1 for bucket in TEXTURES.buckets]
            bucket = np.clip(moved.bucket, 0, len(last) - 1)
            row = np.clip(moved.row, 0, np.asarray(last)[bucket])
            np.testing.assert_array_equal(value, render(dataclasses.replace(TEXTURES, bucket=bucket, row=row))[0])


@pytest.mark.parametrize("compositor", COMPOSITORS)
@pytest.mark.parametrize("num", [4, 5000])
def test_places_of_other_textures(compositor, num):
    """Texels of four textures, or of 5000, with fifty places."""
    textures = a2tg.allocate_textures([(2, 2)] * num)
    bucket, row = jnp.zeros(NUM, jnp.int32), jnp.arange(NUM, dtype=jnp.int32)
    textures = dataclasses.replace(textures, bucket=bucket, row=row)
    value, gradient = rendered(compositor)(textures)
    plain = rendered(compositor)(a2tg.allocate_textures([(2, 2)] * NUM))[0]
    np.testing.assert_array_equal(value, plain)
    assert np.isfinite(gradient.buckets[0]).all() and np.abs(gradient.buckets[0]).max() > 0


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"row": 100_000_000},
            r"textures\.row must be below .* 10 in bucket 3; got 100000000 for Gaussian 0",
        ),
        ({"row": -1}, r"textures\.row must be below"),
        ({"bucket": 7}, r"textures\.bucket must be 0 to 4; got 7 to 11"),
        ({"bucket": -1}, r"textures\.bucket must be 0 to 4; got -1 to 3"),
    ],
)
def test_an_eager_render_refuses_it_by_name(changes, message):
    gaussians, camera = as_gaussians(SCENE, "float32"), as_camera(SCENE, "float32")
    moved = {field: getattr(TEXTURES, field) + by for field, by in changes.items()}
    with pytest.raises(ValueError, match=message):
        a2tg.render_image(gaussians, camera, dataclasses.replace(TEXTURES, **moved))
    with pytest.raises(ValueError, match=r"textures\.row must be integers"):
        a2tg.render_image(gaussians, camera, dataclasses.replace(TEXTURES, row=TEXTURES.row.astype(jnp.float32)))


def view_of(compositor):
    """What a compositor takes for the scene: settings, splats, texels, regions, cutoff, and good lists."""
    camera, appearance = as_camera(SCENE, "float32"), a2tg.Appearance(texture=Texture(TEXTURES))
    grid = TileGrid(camera.width, camera.height, 16)
    splats, cutoff = project_gaussians(as_gaussians(SCENE, "float32"), camera, appearance, 0.2, 3)
    options = {"has_geometry": False, "statistic": "position", "compositor": compositor, "tile_batch": 1}
    settings, *places = settings_of_pass(appearance, splats, grid, 0.2, **options)
    return settings, splats, *places, cutoff, tile_lists(splats.M, cutoff, 0.2, grid, 1024)


def composited(compositor, regions, lists):
    """Image and gradients of the scene with other regions and lists."""
    settings, splats, texels, _, cutoff, _ = view_of(compositor)

    def total(splats, texels, probe, regions, lists):
        channels, transmittance = composite(settings, splats, texels, regions, cutoff, lists, jnp.eye(3), probe)
        return jnp.sum(channels**2) + jnp.sum(transmittance)

    differentiate = jax.jit(jax.value_and_grad(total, argnums=(0, 1, 2)))
    return differentiate(splats, texels, jnp.zeros((NUM, 4)), regions, lists)


def stray_numbers(rng, numbers):
    """The same integers with some of them out of range."""
    is_moved = rng.uniform(size=numbers.shape) < rng.uniform()
    return jnp.asarray(np.where(is_moved, rng.choice(STRAY, numbers.shape), numbers).astype(np.int32))


@pytest.mark.parametrize("compositor", ["native", "cuda"])
@pytest.mark.parametrize("seed", range(8))
def test_regions_and_lists_of_any_integers(compositor, seed):
    rng = np.random.default_rng(seed)
    _, _, _, regions, _, lists = view_of(compositor)
    regions = TextureRegion(*(stray_numbers(rng, np.asarray(numbers)) for numbers in regions))
    ids, starts = (stray_numbers(rng, np.asarray(numbers)) for numbers in (lists.ids, lists.starts))
    found = composited(compositor, regions, lists._replace(ids=ids, starts=starts))
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(found))


@pytest.mark.parametrize("compositor", ["native", "cuda"])
def test_indices_in_range_are_kept(compositor):
    _, _, _, regions, _, lists = view_of(compositor)
    found, wanted = (composited(name, regions, lists) for name in (compositor, "xla"))
    for own, other in zip(jax.tree.leaves(found), jax.tree.leaves(wanted), strict=True):
        np.testing.assert_allclose(own, other, rtol=1e-3, atol=1e-3 * float(jnp.abs(other).max(initial=0)))


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("height", [None, 30, 10_000, -5])
def test_lists_of_any_homographies(seed, height):
    """NaN, infinities and huge numbers in M and in the cutoff, and a traced height beyond the image."""
    rng = np.random.default_rng(seed)
    _, splats, _, _, cutoff, _ = view_of("native")
    odd = np.asarray([np.nan, np.inf, -np.inf, 1e30, -1e30, 0.0, 1e-30], np.float32)
    M, cutoff = (
        jnp.asarray(np.where(rng.uniform(size=x.shape) < 0.2, rng.choice(odd, x.shape), np.asarray(x)))
        for x in (splats.M, cutoff)
    )
    grid = TileGrid(SCENE.width, SCENE.height, 8)
    height = None if height is None else jnp.asarray(height, jnp.int32)
    lists = jax.jit(native.tile_lists, static_argnums=(2, 3, 4))(M, cutoff, 0.2, grid, 4096, height)
    assert lists.starts[0] >= 0 and lists.starts[-1] <= 4096 and (np.diff(lists.starts) >= 0).all()
    assert (np.asarray(lists.ids) >= 0).all() and (np.asarray(lists.ids) < NUM).all()


def test_regions_need_a_row_for_each_gaussian():
    @a2tg.pytree
    class Short(a2tg.Appearance):
        def atlas(self):
            texels, regions = super().atlas()
            return texels, TextureRegion(*(numbers[:9] for numbers in regions))

    gaussians, camera = as_gaussians(SCENE, "float32"), as_camera(SCENE, "float32")
    with pytest.raises(ValueError, match=r"regions\.first \[N\] of N = 50 gaussians; Short gave \(9,\)"):
        a2tg.render_appearance(gaussians, camera, Short(texture=Texture(TEXTURES)))


def test_pictures_with_rows_out_of_range():
    """Refused eagerly, the nearest picture under jit, as with textures."""
    gaussians, camera = as_gaussians(SCENE, "float32"), as_camera(SCENE, "float32")
    pictures = textures_of([(4, 4)] * NUM)
    stray = dataclasses.replace(pictures, row=jnp.full(NUM, 2**30, jnp.int32))
    with pytest.raises(ValueError, match=r"appearance\.pictures\.row must be below the number"):
        a2tg.Model(gaussians, Billboards(pictures=stray, side=4)).render(camera)

    def drawn(compositor, pictures):
        settings = a2tg.RenderSettings(compositor=compositor, capacity=4096)
        model = a2tg.Model(gaussians, Billboards(pictures=pictures, side=4))
        return jax.jit(lambda model: model.render(camera, settings=settings).color)(model)

    last = dataclasses.replace(pictures, row=jnp.full(NUM, len(pictures.buckets[0]) - 1, jnp.int32))
    np.testing.assert_array_equal(drawn("native", stray), drawn("native", last))
    np.testing.assert_allclose(drawn("native", stray), drawn("xla", stray), atol=1e-5)


@pytest.mark.parametrize("dtype", [np.int8, np.uint8, np.int16, np.uint32])
def test_places_of_any_integers(dtype, by_xla):
    render, most = rendered("native"), np.iinfo(dtype).max
    row = jnp.asarray(np.where(np.arange(NUM) % 2, np.asarray(TEXTURES.row), most).astype(dtype))
    value, _ = render(dataclasses.replace(TEXTURES, row=row))
    as_int32 = np.where(np.arange(NUM) % 2, np.asarray(TEXTURES.row), min(most, LIMITS.max)).astype(np.int32)
    np.testing.assert_array_equal(value, render(dataclasses.replace(TEXTURES, row=jnp.asarray(as_int32)))[0])
    np.testing.assert_allclose(value, by_xla(dataclasses.replace(TEXTURES, row=row))[0], rtol=1e-5)


@pytest.mark.parametrize("seed", range(4))
def test_compositors_agree_on_regions_of_any_integers(seed):
    rng = np.random.default_rng(seed)
    _, _, _, regions, _, lists = view_of("native")
    regions = TextureRegion(*(stray_numbers(rng, np.asarray(numbers)) for numbers in regions))
    found, wanted = (composited(name, regions, lists) for name in ("native", "xla"))
    np.testing.assert_allclose(found[0], wanted[0], rtol=1e-3)
    for own, other in zip(jax.tree.leaves(found), jax.tree.leaves(wanted), strict=True):
        # Textures of a thousand texels along an axis have slopes that turn rounding into another pixel at 1/255.
        is_same = np.isclose(own, other, rtol=1e-3, atol=1e-3 * float(jnp.abs(other).max(initial=0)))
        assert not is_same.size or is_same.mean() > 0.97


@pytest.mark.parametrize("num_live", [-1, NUM + 1, 2.5])
def test_a_number_of_live_rows_that_there_are_not(num_live):
    model = a2tg.Model(as_gaussians(SCENE, "float32"), num_live=num_live)
    with pytest.raises(ValueError, match=f"num_live must be an integer, 0 to {NUM}; got {num_live}"):
        model.render(as_camera(SCENE, "float32"))
