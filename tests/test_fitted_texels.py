"""New texels fitted to the old lookup: what they show, sampled densely by scipy, against copies of the nearest."""

import dataclasses
import pathlib

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.ndimage import map_coordinates
from small_models import some_model

import a2tg_jax as a2tg
from a2tg_jax.core.optim import adam_init
from a2tg_jax.core.pytree import partition

OPTIONS = {"texel-centre": a2tg.TextureOptions(), "align-corners": a2tg.TextureOptions(uv="align-corners")}
PLACES = (np.arange(240) + 0.5) / 240
"""Places along an axis of the texture's square, from 0 to 1."""


def looked_up(texels, uv):
    """What a texture [Tv, Tu, C] shows at all places of the square, [V, U, C] float64."""
    axes = [PLACES * side - 0.5 if uv == "texel-centre" else PLACES * (side - 1) for side in texels.shape[:2]]
    at = np.meshgrid(*axes, indexing="ij")
    channels = np.moveaxis(texels.astype(np.float64), 2, 0)
    return np.stack([map_coordinates(channel, at, order=1, mode="nearest") for channel in channels], axis=2)


def resized(arrays, sizes, fit=None):
    return a2tg.texture_arrays(a2tg.reallocate(a2tg.textures_from_arrays(arrays), np.asarray(sizes), fit=fit).textures)


def mean_square(difference):
    """Over the square, [C]."""
    return np.square(difference).mean(axis=(0, 1))


@pytest.mark.parametrize("uv", OPTIONS)
@pytest.mark.parametrize("side", range(1, 9))
def test_no_other_texels_show_the_old_texture_better(side, uv):
    """Neither copies of the nearest nor any of many perturbations, when one axis doubles or both do."""
    rng = np.random.default_rng(side)
    texels = rng.normal(size=(side, 9 - side, 4)).astype(np.float32)
    texels[..., 3] = rng.uniform(0.3, 0.7, texels.shape[:2])  # Far from the limits of alpha.
    shown = looked_up(texels, uv)
    for factors in ((2, 1), (1, 2), (2, 2)):
        size = np.multiply(texels.shape[:2], factors)
        (fitted,), (nearest,) = (resized([texels], [size], fit) for fit in (OPTIONS[uv], None))
        error = mean_square(looked_up(fitted, uv) - shown)
        assert (error <= mean_square(looked_up(nearest, uv) - shown) + 1e-12).all()
        for scale in (0.01, 0.1, 1.0):
            other = fitted + rng.normal(0, scale, fitted.shape)
            assert (error < mean_square(looked_up(other, uv) - shown)).all()


@pytest.mark.parametrize("uv", OPTIONS)
def test_what_can_be_kept_is_kept(uv):
    """One texel at any size, the same size, and, with texels on the edge, a grid that holds the old one's nodes."""
    rng = np.random.default_rng(0)
    texels = rng.uniform(size=(3, 2, 4)).astype(np.float32)
    (same,) = resized([texels], [(3, 2)], OPTIONS[uv])
    np.testing.assert_array_equal(same, texels)
    for size in ((1, 2), (2, 2), (7, 16)):
        (one,) = resized([texels[:1, :1]], [size], OPTIONS[uv])
        np.testing.assert_array_equal(one, np.broadcast_to(texels[0, 0], (*size, 4)))
    (line,) = resized([texels[:1]], [(5, 2)], OPTIONS[uv])
    np.testing.assert_array_equal(line, np.broadcast_to(texels[0], (5, 2, 4)))
    (none,) = resized([texels], [(0, 0)], OPTIONS[uv])
    assert none.size == 0
    if uv == "align-corners":
        (nested,) = resized([texels], [(5, 4)], OPTIONS[uv])
        np.testing.assert_allclose(looked_up(nested, uv), looked_up(texels, uv), atol=1e-6)


@pytest.mark.parametrize(
    "options", [a2tg.TextureOptions(), dataclasses.replace(a2tg.TextureOptions.official(), alpha="projected")]
)
def test_texels_stay_in_their_range(options):
    """Steps from 0 to 1, of which an unlimited fit would overshoot. Cut, they are still nearer than copies."""
    rng = np.random.default_rng(0)
    arrays = [rng.integers(0, 2, (4, 4, 4)).astype(np.float32) for _ in range(20)]
    fitted, nearest = (resized(arrays, [(8, 8)] * 20, fit) for fit in (options, None))
    least, most = np.min(fitted, axis=(0, 1, 2)), np.max(fitted, axis=(0, 1, 2))
    assert (least[3], most[3]) == (0, 1)
    assert (least[:3] >= 0).all() == (most[:3] <= 1).all() == (options.rgb == "unit")
    for old, *others in zip(arrays, fitted, nearest, strict=True):
        one, other = (mean_square(looked_up(new, options.uv) - looked_up(old, options.uv))[3] for new in others)
        assert one < 0.25 * other


def test_moments_copy_the_nearest_and_stay_positive():
    rng = np.random.default_rng(0)
    textures = a2tg.textures_from_arrays([rng.normal(size=(4, 4, 4)).astype(np.float32) for _ in range(5)])
    squares = dataclasses.replace(textures, buckets=tuple(bucket**2 for bucket in textures.buckets))
    sizes = 2 * textures.sizes
    fitted, moments = a2tg.reallocate(textures, sizes, squares, fit=a2tg.TextureOptions())
    copied, expected = a2tg.reallocate(textures, sizes, squares)
    for found, wanted in zip(moments.buckets, expected.buckets, strict=True):
        np.testing.assert_array_equal(found, wanted)
        assert found.min() >= 0
    assert np.abs(fitted.buckets[0] - copied.buckets[0]).max() > 0.1


@pytest.mark.parametrize("uv", OPTIONS)
def test_a_render_changes_less_when_textures_grow(uv):
    """Both of an event, of textures of 2×2 and 4×4 texels."""
    rng, camera = np.random.default_rng(0), a2tg.synthetic_scene(width=48, height=36, num_views=2).train[0].camera
    model = some_model(a2tg.A2tg(sh_degree=0, lookup=OPTIONS[uv]))
    for side in (2, 4):
        arrays = [rng.normal(0, 0.3, (side, side, 4)).astype(np.float32) for _ in range(model.num)]
        for array in arrays:
            array[..., 3] = rng.uniform(0.2, 0.8, (side, side))
        textured = model.with_textures(a2tg.textures_from_arrays(arrays))
        before, changes = textured.render(camera).color, []
        for new_texels in ("nearest", "fitted"):
            event = a2tg.Upscale(fraction=1.0, cap=16, anisotropic=False, new_texels=new_texels)
            seen = event.init(textured).observe(jnp.arange(1.0, 1 + model.num), jnp.ones(model.num, bool))
            grown = event.apply(a2tg.Due(), textured, adam_init(partition(textured)[0]), seen).model
            assert (grown.textures.sizes == 2 * side).all()
            changes.append(float(jnp.square(grown.render(camera).color - before).mean()))
        assert before.std() > 0.01 and changes[1] < 0.2 * changes[0]


def test_the_page_says_how_much_the_shown_texture_changes():
    """Of random texels, weighted by the kernel: root mean square of the change over the standard deviation."""
    page = (pathlib.Path(__file__).parents[1] / "docs" / "how-it-works.md").read_text(encoding="utf-8")
    kernel = np.exp(-0.5 * np.square(6 * PLACES - 3))
    weights = np.outer(kernel, kernel) / kernel.sum() ** 2
    for side in (2, 4):
        # Of independent texels the mean square is the sum over textures with one texel of 1.
        units = np.eye(side * side, dtype=np.float32).reshape(side, side, side * side)
        arrays = [np.repeat(units[..., index, None], 4, axis=2) for index in range(side * side)]
        shown = looked_up(units, "texel-centre")
        variance = np.sum(weights[..., None] * shown**2) - np.square(np.sum(weights[..., None] * shown, (0, 1))).sum()
        shares = []
        for fit in (None, a2tg.TextureOptions()):
            new = np.stack([array[..., 0] for array in resized(arrays, [(2 * side, 2 * side)] * side**2, fit)], axis=2)
            change = np.sum(weights[..., None] * np.square(looked_up(new, "texel-centre") - shown))
            shares.append(f"{np.sqrt(change / variance):.0%}".replace("%", " %"))
        row = f"| {side}×{side} to {2 * side}×{2 * side} | {shares[0]} | {shares[1]} |"
        assert row in page, row
