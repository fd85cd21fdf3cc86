"""The native loops apart from the images they make: threads, lists, errors, other appearances and fallback."""

import dataclasses
import itertools
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import oracle
import pytest
from scenes_random import as_camera, as_gaussians, as_textures, assert_all_close, draw_scene, quick_then_long

from a2tg_jax import (
    Appearance,
    Exponents,
    RenderSettings,
    Texture,
    TextureOptions,
    TextureRegion,
    pytree,
    render_appearance,
    render_image,
    set_num_threads,
    static,
    textures_from_arrays,
)
from a2tg_jax.appearance import StaticShading
from a2tg_jax.rasterize.kernels.native import composite as native
from a2tg_jax.rasterize.splats import project_gaussians
from a2tg_jax.rasterize.tiles import TileGrid, tile_lists, total_pairs
from a2tg_jax.rasterize.views import render_traced

long = pytest.mark.long


@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize("dtype", quick_then_long(["float32"], ["float64"]))
def test_lists_are_those_of_xla(monkeypatch, threads, dtype):
    monkeypatch.setattr(native, "SPLATS_PER_THREAD", 100)
    monkeypatch.setattr(native, "PAIRS_PER_THREAD", 100)
    set_num_threads(3)
    scene = draw_scene(4, num=300)
    gaussians = as_gaussians(scene, dtype)
    camera = as_camera(scene, dtype)
    drawn, cutoff = project_gaussians(gaussians, camera, Appearance(), 0.2, 3)
    # Equal depths, to see ties in order of the index.
    splats = drawn.M.at[:, 2, 2].set(jnp.round(drawn.M[:, 2, 2], 1)), cutoff, 0.2
    for tile_size in (8, 16):
        grid = TileGrid(scene.width, scene.height, tile_size)
        ours = jax.jit(lambda grid=grid: native.tile_lists(*splats, grid, 20_000))()
        expected = jax.jit(lambda grid=grid: tile_lists(*splats, grid, 20_000))()
        np.testing.assert_array_equal(ours.starts, expected.starts)
        num_pairs = int(ours.starts[-1])
        assert num_pairs > 500
        np.testing.assert_array_equal(ours.ids[:num_pairs], expected.ids[:num_pairs])
        assert ours.num_pairs == expected.num_pairs and not ours.overflow
    full = jax.jit(lambda: native.tile_lists(*splats, grid, 100))()
    assert full.overflow and full.starts[-1] == 0


def test_threads_share_the_work_and_nothing_else(monkeypatch, threads):
    """Images are bit for bit the same as with one thread; gradients, summed by thread, are equal to rounding."""
    scene = draw_scene(3, num=60)
    gaussians = as_gaussians(scene, "float32")
    camera = as_camera(scene, "float32")
    textures = as_textures(scene, "float32")
    settings = RenderSettings(capacity=8192)

    @jax.jit
    def differentiate(gaussians, buckets):
        def loss(gaussians, buckets):
            shown = dataclasses.replace(textures, buckets=buckets)
            output = render_image(gaussians, camera, shown, settings=settings)
            return jnp.sum(output.color**2) + jnp.sum(output.depth), output

        return jax.value_and_grad(loss, argnums=(0, 1), has_aux=True)(gaussians, buckets)

    monkeypatch.setattr(native, "PAIRS_PER_THREAD", 10)
    found = []
    for num_threads in (1, 2, 3):
        set_num_threads(num_threads)
        found.append(jax.block_until_ready(differentiate(gaussians, textures.buckets)))
    ((_, one), expected), *others = found
    for (_, many), gradients in others:
        np.testing.assert_array_equal(many.color, one.color)
        np.testing.assert_array_equal(many.depth, one.depth)
        assert_all_close(gradients, expected, 1e-4, 1e-5)


@pytree(kw_only=True)
class Halves(Appearance):
    """An appearance of another kind: two halves [N, 2, 3] of a splat, by the sign of u, and another falloff."""

    halves: jax.Array
    sharpness: float = static()

    def atlas(self):
        first = jnp.arange(len(self.halves), dtype=jnp.int32) * 2
        return self.halves.reshape(-1, 3), TextureRegion(first, jnp.ones_like(first), jnp.full_like(first, 2))

    def texel_position(self, region, u, v):
        return (u > 0).astype(u.dtype), jnp.zeros_like(v)

    def shade(self, numbers, values, u, v):
        a, b, c = values
        return (a, b * u, c), None

    def falloff(self, numbers, rho):
        return jnp.exp(-0.5 * rho) / (1 + self.sharpness * rho)


@pytest.mark.usefixtures("x64")
def test_any_appearance_is_compiled():
    scene = draw_scene(9, num=20, width=19, height=13)
    gaussians = as_gaussians(scene, "float64")
    camera = as_camera(scene, "float64")
    halves = jnp.asarray(np.random.default_rng(0).normal(size=(gaussians.num, 2, 3)))

    def loss(gaussians, halves, compositor):
        settings = RenderSettings(compositor=compositor, capacity=1024)
        output = render_appearance(gaussians, camera, Halves(halves=halves, sharpness=0.2), settings=settings)
        return jnp.sum(output.color**2), output.color

    differentiate = jax.jit(jax.value_and_grad(loss, argnums=(0, 1), has_aux=True), static_argnums=2)
    (_, expected), wanted = differentiate(gaussians, halves, "xla")
    (_, image), found = differentiate(gaussians, halves, "native")
    assert jnp.abs(wanted[1]).max() > 1e-3
    np.testing.assert_allclose(image, expected, atol=1e-10)
    assert_all_close(found, wanted, 1e-9, 1e-10)


@pytree
class Untranslatable(Appearance):
    def falloff(self, numbers, rho):
        return jnp.exp(-0.5 * rho) + 0 * jax.lax.digamma(1 + rho)


def test_an_appearance_without_translation_is_left_to_xla():
    """With "auto", with one warning that names the primitive; with "native" it is an error."""
    scene = draw_scene(9, num=8, width=16, height=16)
    gaussians = as_gaussians(scene, "float32")
    camera = as_camera(scene, "float32")

    def show(**settings):
        return render_appearance(gaussians, camera, Untranslatable(), settings=RenderSettings(**settings)).color

    with pytest.warns(UserWarning, match=r"Untranslatable is composited by XLA.*'digamma'"):
        found = show()
    show(near_plane=0.3)
    np.testing.assert_array_equal(found, show(compositor="xla"))
    with pytest.raises(ValueError, match=r"compositor='native' cannot run Untranslatable.*'digamma'"):
        show(compositor="native")


@jax.custom_jvp
def gaussian(rho):
    return jnp.exp(-0.5 * rho)


@gaussian.defjvp
def gaussian_jvp(primals, tangents):
    value = gaussian(*primals)
    return value, (-0.5 * value + 0 * jax.lax.digamma(1 + primals[0])) * tangents[0]


@pytree
class UntranslatableGradient(Appearance):
    def falloff(self, numbers, rho):
        return gaussian(rho)


def test_a_gradient_alone_without_translation_is_left_to_xla():
    """Native loops draw the image, as that of the plain appearance with the same falloff."""
    scene = draw_scene(9, num=8, width=16, height=16)
    gaussians = as_gaussians(scene, "float32")
    camera = as_camera(scene, "float32")

    def loss(gaussians, appearance, compositor):
        settings = RenderSettings(compositor=compositor, capacity=512)
        color = render_appearance(gaussians, camera, appearance, settings=settings).color
        return jnp.sum(color**2), color

    differentiate = jax.grad(loss, has_aux=True)
    with pytest.warns(UserWarning, match=r"UntranslatableGradient is composited by XLA.*'digamma' in the gradient of"):
        found, image = differentiate(gaussians, UntranslatableGradient(), "auto")
    np.testing.assert_array_equal(image, loss(gaussians, UntranslatableGradient(), "native")[1])
    wanted, expected = differentiate(gaussians, Appearance(), "xla")
    np.testing.assert_allclose(image, expected, atol=1e-5)
    assert_all_close(found, wanted, 1e-4, 1e-5)
    with pytest.raises(ValueError, match=r"compositor='native' cannot run UntranslatableGradient.*'digamma'"):
        differentiate(gaussians, UntranslatableGradient(), "native")


OPTIONS = TextureOptions("align-corners", "identity", "unit")


PLAIN = TextureOptions()


@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize(
    ("compositor", "options"),
    quick_then_long([("native", PLAIN)], [("native", OPTIONS), *itertools.product(["xla", "cuda"], [PLAIN, OPTIONS])]),
)
def test_a_splat_without_a_texture_shows_its_gaussian(compositor, options):
    """As one with a texel that changes nothing: the oracle's image, and the same gradients of all else."""
    scene = draw_scene(4, num=16, width=19, height=13)
    is_empty = np.arange(16) % 3 == 0
    pairs = zip(is_empty, scene.textures, strict=True)
    neutral = [np.array([[[0.0, 0.0, 0.0, 1.0]]]) if none else texture for none, texture in pairs]
    empty = [np.zeros((0, 0, 4)) if none else texture for none, texture in zip(is_empty, neutral, strict=True)]
    gaussians = as_gaussians(scene, "float64")
    camera = as_camera(scene, "float64")
    settings = RenderSettings(compositor=compositor, capacity=1024)

    def loss(gaussians, buckets, probe, textures):
        shown = Appearance(texture=Texture(dataclasses.replace(textures, buckets=buckets), options=options))
        background = jnp.asarray(scene.background)
        output, _ = render_traced(gaussians, camera, shown, background, settings, probe=probe)
        return jnp.sum(output.color**2) + jnp.sum(output.depth), output.color

    def differentiate(textures):
        textures = textures_from_arrays([jnp.asarray(texture) for texture in textures])
        found = jax.jit(jax.value_and_grad(loss, argnums=(0, 1, 2), has_aux=True))
        (_, color), grads = found(gaussians, textures.buckets, jnp.zeros((16, 4)), textures)
        return color, grads[0], dataclasses.replace(textures, buckets=grads[1]).blocks(), grads[2]

    wanted = differentiate(neutral)
    found = differentiate(empty)
    # A neutral texel has a gradient, what is empty has none.
    for arrays in (wanted[2], found[2]):
        arrays[:] = [array for none, array in zip(is_empty, arrays, strict=True) if not none]
    assert_all_close(found, wanted, 1e-10, 1e-12)
    if options == TextureOptions():
        expected = oracle.render(scene._replace(textures=neutral))
        assert expected.margin.min() > 1e-9
        np.testing.assert_allclose(found[0], expected.color, atol=1e-9)


@long
@pytest.mark.usefixtures("x64")
def test_mixed_precisions_are_composited_in_the_larger():
    """Gaussians and textures in float32 under a float64 camera: the gradients keep their dtypes.

    Rounding decides here and there whether a splat reaches 1/255, which moves a gradient by that pixel's share.
    """
    scene = draw_scene(4)
    gaussians = as_gaussians(scene, "float32")
    textures = as_textures(scene, "float32")

    def loss(gaussians, buckets, camera):
        settings = RenderSettings(compositor="native", capacity=1024)
        shown = dataclasses.replace(textures, buckets=buckets)
        color = render_image(gaussians, camera, shown, settings=settings).color
        return jnp.sum(color**2), color

    differentiate = jax.jit(jax.value_and_grad(loss, argnums=(0, 1), has_aux=True))
    with jax.numpy_dtype_promotion("standard"):
        (_, expected), wanted = differentiate(gaussians, textures.buckets, as_camera(scene, "float32"))
        (_, image), found = differentiate(gaussians, textures.buckets, as_camera(scene, "float64"))
    assert image.dtype == jnp.float64
    assert np.mean(abs(np.asarray(image) - np.asarray(expected)) < 1e-5) > 0.99
    assert {leaf.dtype for leaf in jax.tree.leaves((found, wanted))} == {jnp.dtype("float32")}
    assert_all_close(found, wanted, 0, 2e-2)


@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize("compositor", ["native", "xla", "autodiff"])
def test_shapes_of_kernels_stay_in_float32_among_doubles(compositor):
    scene = draw_scene(4, num=8)
    gaussians = as_gaussians(scene, "float32")
    settings = RenderSettings(compositor=compositor, capacity=2048)

    def loss(shapes):
        shown = Appearance(exponents=Exponents(shapes))
        return jnp.sum(render_appearance(gaussians, as_camera(scene, "float32"), shown, settings=settings).color ** 2)

    value, gradient = jax.value_and_grad(loss)(jnp.linspace(-1, 1, 8, dtype=jnp.float32))
    assert value.dtype == gradient.dtype == jnp.float32 and gradient.any()


def test_names_of_kernels_are_the_same_in_every_process_and_others_for_a_class_defined_again():
    """XLA's compilation cache finds them by the name, which contains no address of an object."""
    scene = draw_scene(4, num=8, width=16, height=16)
    textures = as_textures(scene, "float32")
    assert " at 0x" not in repr(StaticShading.of(Appearance(texture=Texture(textures), exponents=Exponents())))

    def image(residual):
        @pytree
        class Again(Appearance):
            def shade(self, numbers, values, u, v):
                return (residual * jnp.ones_like(u),) * 3, None

        return render_appearance(as_gaussians(scene, "float32"), as_camera(scene, "float32"), Again()).color

    assert jnp.max(jnp.abs(image(0.0) - image(0.5))) > 0.1


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"compositor": "XLA"}, "got 'XLA'"),
        ({"tile_size": 65}, "1 to 64"),
        ({"compositor": "cuda"}, "NVIDIA GPU and NVRTC"),
    ],
)
def test_compositors_that_cannot_be_are_refused(settings, words):
    scene = draw_scene(0, num=3)
    with pytest.raises(ValueError, match=words):
        render_image(as_gaussians(scene, "float32"), as_camera(scene, "float32"), settings=RenderSettings(**settings))


def test_large_sums_of_pairs_lose_no_small_count():
    counts = jnp.concatenate([jnp.full(256, 2**20, jnp.int32), jnp.ones(100_000, jnp.int32)])
    assert abs(float(total_pairs(counts)) - (2**28 + 100_000)) <= 64


@long
def test_without_llvmlite_xla_composites():
    script = """
import sys
sys.modules["llvmlite"] = None
import jax.numpy as jnp
from a2tg_jax import Camera, RenderSettings, init_from_points, render_image
gaussians = init_from_points([[0, 0, 2], [0.1, 0, 2], [0, 0.1, 2]], [[1, 1, 1]] * 3)
camera = Camera(jnp.eye(4), jnp.asarray([[20.0, 0, 8], [0, 20, 8], [0, 0, 1]]), 16, 16)
assert render_image(gaussians, camera).alpha.max() > 0.05
try:
    render_image(gaussians, camera, settings=RenderSettings(compositor="native"))
except ValueError as error:
    assert "pip install llvmlite" in str(error)
else:
    raise AssertionError("nothing was refused")
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
