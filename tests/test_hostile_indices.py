"""Indices that come from data never lead a kernel outside its arrays: layouts, regions, lists of tiles, homographies.

A layout or a list under jit has no values to check. Native loops and GPU kernels read and write through pointers, so
that a stray index would end the process, or return other memory as a gradient.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes_random import as_camera, as_gaussians, draw_scene

import a2tg_jax as a2tg
from a2tg_jax.appearance import Billboards, TextureOptions, textured_rule
from a2tg_jax.core.bilinear import TextureRegion
from a2tg_jax.rasterize import compositor as compositors
from a2tg_jax.rasterize.kernels.native import composite as native
from a2tg_jax.rasterize.splats import CompositingSettings, project_gaussians
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


TEXTURES, LAYOUT = textures_of([(2, 2), (1, 4), (8, 8), (1, 1), (0, 0)] * (NUM // 5))


def rendered(compositor):
    """A traced function of textures and layout to the sum of the squared image."""
    gaussians, camera = as_gaussians(SCENE, "float32"), as_camera(SCENE, "float32")
    settings = a2tg.RenderSettings(compositor=compositor, capacity=4096)

    def total(textures, layout):
        return jnp.sum(a2tg.render_image(gaussians, camera, textures, layout, settings=settings).color ** 2)

    return jax.jit(jax.value_and_grad(total))


@pytest.fixture(scope="module")
def by_xla():
    return rendered("xla")


@pytest.mark.parametrize("compositor", ["native", "cuda"])
def test_a_traced_layout_that_fits_no_texture_shows_the_nearest_one(compositor, by_xla):
    render, rng = rendered(compositor), np.random.default_rng(0)
    for stray in STRAY:
        for field in ("row", "bucket"):
            is_moved = rng.uniform(size=NUM) < 0.7
            index = np.where(is_moved, stray, getattr(LAYOUT, field)).astype(np.int32)
            layout = dataclasses.replace(LAYOUT, **{field: jnp.asarray(index)})
            value, gradient = render(TEXTURES, layout)
            wanted, wanted_gradient = by_xla(TEXTURES, layout)
            np.testing.assert_allclose(value, wanted, rtol=1e-5)
            for own, other in zip(gradient.buckets, wanted_gradient.buckets, strict=True):
                np.testing.assert_allclose(own, other, rtol=1e-3, atol=1e-4)
            last = [len(bucket) - 1 for bucket in TEXTURES.buckets]
            nearest = dataclasses.replace(LAYOUT, bucket=np.clip(layout.bucket, 0, len(last) - 1))
            nearest = dataclasses.replace(nearest, row=np.clip(layout.row, 0, np.asarray(last)[nearest.bucket]))
            np.testing.assert_array_equal(value, render(TEXTURES, jax.tree.map(jnp.asarray, nearest))[0])


@pytest.mark.parametrize("compositor", COMPOSITORS)
@pytest.mark.parametrize("num", [4, 5000])
def test_layouts_of_other_textures(compositor, num):
    """Four textures with the layout of fifty, and fifty Gaussians with a layout that has another bucket."""
    textures, _ = a2tg.allocate_textures([(2, 2)] * 4)
    layout = a2tg.allocate_textures([(2, 2)] * num)[1]
    layout = dataclasses.replace(layout, bucket=jnp.resize(layout.bucket, NUM), row=jnp.arange(NUM, dtype=jnp.int32))
    value, gradient = rendered(compositor)(textures, layout)
    plain = rendered(compositor)(*a2tg.allocate_textures([(2, 2)] * NUM))[0]
    np.testing.assert_array_equal(value, plain)
    assert np.isfinite(gradient.buckets[0]).all() and np.abs(gradient.buckets[0]).max() > 0


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"row": 100_000_000}, r"layout\.row must be below the number .* 10 in bucket 3; got 100000000 for Gaussian 0"),
        ({"row": -1}, r"layout\.row must be below"),
        ({"bucket": 7}, r"layout\.bucket must be 0 to 4; got 7 to 11"),
        ({"bucket": -1}, r"layout\.bucket must be 0 to 4; got -1 to 3"),
    ],
)
def test_an_eager_render_refuses_it_by_name(changes, message):
    gaussians, camera = as_gaussians(SCENE, "float32"), as_camera(SCENE, "float32")
    layout = dataclasses.replace(LAYOUT, **{field: getattr(LAYOUT, field) + by for field, by in changes.items()})
    with pytest.raises(ValueError, match=message):
        a2tg.render_image(gaussians, camera, TEXTURES, layout)
    with pytest.raises(ValueError, match=r"layout\.row must be integers"):
        a2tg.render_image(gaussians, camera, TEXTURES, dataclasses.replace(LAYOUT, row=LAYOUT.row.astype(jnp.float32)))


def view_of(compositor):
    """What a compositor takes for the scene: settings, splats, rule, cutoff, and good lists."""
    camera, rule = as_camera(SCENE, "float32"), textured_rule(TEXTURES, LAYOUT, TextureOptions())
    grid = TileGrid(camera.width, camera.height, 16)
    settings = CompositingSettings(grid, 0.2, False, "position", compositor, tile_batch=1)
    splats, cutoff = project_gaussians(as_gaussians(SCENE, "float32"), camera, rule, 0.2, 3)
    return settings, splats, rule, cutoff, tile_lists(splats.M, cutoff, 0.2, grid, 1024)


def composited(compositor, regions, lists):
    """Image and gradients of the scene with other regions and lists."""
    settings, splats, rule, cutoff, _ = view_of(compositor)

    def total(splats, texels, probe, regions, lists):
        arrays = rule, splats, texels, regions, cutoff, lists, jnp.eye(3), probe
        channels, transmittance = compositors.composite_arrays(settings, *arrays)
        return jnp.sum(channels**2) + jnp.sum(transmittance)

    differentiate = jax.jit(jax.value_and_grad(total, argnums=(0, 1, 2)))
    return differentiate(splats, rule.texels, jnp.zeros((NUM, 4)), regions, lists)


def stray_numbers(rng, numbers):
    """The same integers with some of them out of range."""
    is_moved = rng.uniform(size=numbers.shape) < rng.uniform()
    return jnp.asarray(np.where(is_moved, rng.choice(STRAY, numbers.shape), numbers).astype(np.int32))


@pytest.mark.parametrize("compositor", ["native", "cuda"])
@pytest.mark.parametrize("seed", range(8))
def test_regions_and_lists_of_any_integers(compositor, seed):
    rng = np.random.default_rng(seed)
    _, _, rule, _, lists = view_of(compositor)
    regions = TextureRegion(*(stray_numbers(rng, np.asarray(numbers)) for numbers in rule.regions))
    ids, starts = (stray_numbers(rng, np.asarray(numbers)) for numbers in (lists.ids, lists.starts))
    found = composited(compositor, regions, lists._replace(ids=ids, starts=starts))
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(found))


@pytest.mark.parametrize("compositor", ["native", "cuda"])
def test_indices_in_range_are_kept(compositor):
    _, _, rule, _, lists = view_of(compositor)
    found, wanted = (composited(name, rule.regions, lists) for name in (compositor, "xla"))
    for own, other in zip(jax.tree.leaves(found), jax.tree.leaves(wanted), strict=True):
        np.testing.assert_allclose(own, other, rtol=1e-3, atol=1e-3 * float(jnp.abs(other).max(initial=0)))


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("height", [None, 30, 10_000, -5])
def test_lists_of_any_homographies(seed, height):
    """NaN, infinities and huge numbers in M and in the cutoff, and a traced height beyond the image."""
    rng = np.random.default_rng(seed)
    _, splats, _, cutoff, _ = view_of("native")
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
    rule = textured_rule(TEXTURES, LAYOUT, TextureOptions())
    short = dataclasses.replace(rule, regions=TextureRegion(*(numbers[:9] for numbers in rule.regions)))
    gaussians, camera = as_gaussians(SCENE, "float32"), as_camera(SCENE, "float32")
    with pytest.raises(ValueError, match=r"regions\.first \[N\] of N = 50 gaussians; TexturedRule gave \(9,\)"):
        a2tg.render_appearance(gaussians, camera, short)


def test_pictures_with_rows_out_of_range():
    """Refused eagerly, the nearest picture under jit, as with textures."""
    gaussians, camera = as_gaussians(SCENE, "float32"), as_camera(SCENE, "float32")
    appearance = Billboards(side=4)
    params, layout = appearance.allocate(jax.random.key(0), gaussians)
    noise = jnp.asarray(np.random.default_rng(0).uniform(size=(len(params.buckets[0]), 4, 4, 4)), jnp.float32)
    params = a2tg.Textures((noise,))
    stray = dataclasses.replace(layout, row=jnp.full(NUM, 2**30, jnp.int32))
    with pytest.raises(ValueError, match=r"layout\.row must be below the number"):
        a2tg.Model(gaussians, params, stray, appearance=appearance).render(camera)

    def drawn(compositor, layout):
        settings = a2tg.RenderSettings(compositor=compositor, capacity=4096)
        model = a2tg.Model(gaussians, params, layout, appearance=appearance)
        return jax.jit(lambda model: model.render(camera, settings=settings).color)(model)

    last = dataclasses.replace(layout, row=jnp.full(NUM, len(noise) - 1, jnp.int32))
    np.testing.assert_array_equal(drawn("native", stray), drawn("native", last))
    np.testing.assert_allclose(drawn("native", stray), drawn("xla", stray), atol=1e-5)


@pytest.mark.parametrize("dtype", [np.int8, np.uint8, np.int16, np.uint32])
def test_layouts_of_any_integers(dtype, by_xla):
    render, most = rendered("native"), np.iinfo(dtype).max
    row = jnp.asarray(np.where(np.arange(NUM) % 2, np.asarray(LAYOUT.row), most).astype(dtype))
    value, _ = render(TEXTURES, dataclasses.replace(LAYOUT, row=row))
    as_int32 = np.where(np.arange(NUM) % 2, np.asarray(LAYOUT.row), min(most, LIMITS.max)).astype(np.int32)
    np.testing.assert_array_equal(value, render(TEXTURES, dataclasses.replace(LAYOUT, row=jnp.asarray(as_int32)))[0])
    np.testing.assert_allclose(value, by_xla(TEXTURES, dataclasses.replace(LAYOUT, row=row))[0], rtol=1e-5)


@pytest.mark.parametrize("seed", range(4))
def test_compositors_agree_on_regions_of_any_integers(seed):
    rng = np.random.default_rng(seed)
    _, _, rule, _, lists = view_of("native")
    regions = TextureRegion(*(stray_numbers(rng, np.asarray(numbers)) for numbers in rule.regions))
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
