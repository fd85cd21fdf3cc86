"""Appearances as values: what they start as, keep to, count, and hand to densification and to files."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes_random import as_camera, as_gaussians, draw_scene
from test_oracle import FACING, FOCAL, hand_scene

from a2tg_jax import Model, TextureOptions, Textures, load_model, render_appearance, save_model
from a2tg_jax.appearance import Appearance, Banded, Billboards, MovableKernels, Plain, Shaped, Textured, appearance_for
from a2tg_jax.appearance.copies import share
from a2tg_jax.appearance.layers import layer_without, layers_in_words
from a2tg_jax.appearance.shaped import ShapedLayout, ShapedParams
from a2tg_jax.appearance.textured import shown_textures
from a2tg_jax.core.gaussians import logit
from a2tg_jax.texture import allocate_textures

KEY = jax.random.key(0)
APPEARANCES = {
    "plain": Plain(),
    "textured": Textured(start=(2, 3)),
    "movable kernels": MovableKernels(),
    "billboards": Billboards(side=5),
    "shaped": Shaped(Textured(start=(2, 3))),
}


def allocated(appearance: Appearance, num: int = 40):
    gaussians = as_gaussians(draw_scene(2, num=num), "float32")
    return gaussians, *appearance.allocate(KEY, gaussians)


def moved(params):
    """The parameters with noise, so that no two rows are equal."""
    leaves, treedef = jax.tree.flatten(params)
    rng = np.random.default_rng(0)
    return jax.tree.unflatten(treedef, [leaf + rng.normal(size=leaf.shape).astype(np.float32) for leaf in leaves])


@pytest.mark.parametrize("name", APPEARANCES)
def test_arrays_lead_back(name):
    appearance = APPEARANCES[name]
    _, params, layout = allocated(appearance)
    arrays = appearance.arrays(moved(params), layout)
    again = appearance.arrays(*appearance.from_arrays(arrays))
    assert arrays.keys() == again.keys()
    for key in arrays:
        np.testing.assert_array_equal(arrays[key], again[key])


@pytest.mark.parametrize("name", APPEARANCES)
def test_models_are_saved_with_what_they_show(name, tmp_path):
    gaussians, params, layout = allocated(APPEARANCES[name])
    model = Model(gaussians, moved(params), layout, num_live=jnp.int32(30), appearance=APPEARANCES[name])
    save_model(tmp_path / "model.npz", model)
    loaded, camera = load_model(tmp_path / "model.npz"), as_camera(draw_scene(2, num=3), "float32")
    assert loaded.appearance == model.appearance and loaded.num == 30
    expected = model.render(camera).color
    assert jnp.max(expected) > 0.1
    np.testing.assert_array_equal(loaded.render(camera).color, expected)


@pytest.mark.parametrize("name", ["textured", "movable kernels", "billboards", "shaped"])
def test_rows_move_and_are_cleared(name):
    appearance = APPEARANCES[name]
    _, params, layout = allocated(appearance)
    params = moved(params)
    rows = jnp.asarray(np.random.default_rng(1).integers(0, 40, 40))
    gathered = appearance.gather(params, layout, rows)
    cleared = appearance.clear(params, layout, rows < 20)
    for before, after, without in zip(*map(jax.tree.leaves, (params, gathered, cleared)), strict=True):
        np.testing.assert_array_equal(after[:40], before[rows])
        np.testing.assert_array_equal(
            without[:40], np.where((rows < 20).reshape(-1, *[1] * (before.ndim - 1)), 0, before[:40])
        )


@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize("name", APPEARANCES)
def test_parameters_are_of_the_gaussians_dtype(name):
    gaussians = as_gaussians(draw_scene(2, num=4), "float64")
    params, _ = APPEARANCES[name].allocate(KEY, gaussians)
    assert {leaf.dtype for leaf in jax.tree.leaves(params)} <= {gaussians.means.dtype}


def test_floats_of_a_splat():
    floats = {name: appearance.num_floats(allocated(appearance)[2], 10) for name, appearance in APPEARANCES.items()}
    assert floats == {"plain": 0, "textured": 240, "movable kernels": 270, "billboards": 990, "shaped": 250}
    assert Billboards().num_floats((), 1) == 1081 - 58
    assert MovableKernels().num_published_floats((), 1) == 74 - 58


def test_movable_kernels_start_as_opaque_as_their_gaussians():
    scene = hand_scene([[0.1, 0.1, 4]], [FACING], [[1.0, 1.0]], [0.6], [[0.2, 0.5, 0.7]])
    gaussians, camera = as_gaussians(scene, "float32"), as_camera(scene, "float32")
    appearance = MovableKernels()
    output = render_appearance(gaussians, camera, appearance.rule(*appearance.allocate(KEY, gaussians)))
    # The ray of this pixel meets the mean.
    np.testing.assert_allclose(output.alpha[6, 8], 0.6, rtol=1e-5)
    np.testing.assert_allclose(output.color[6, 8], 0.6 * np.array([0.2, 0.5, 0.7]), rtol=1e-5)


def test_billboards_start_half_opaque_and_colourless():
    scene = hand_scene([[0.1, 0.1, 4]], [FACING], [[0.5, 0.5]], [0.6], [[0.2, 0.5, 0.7]])
    gaussians, camera = as_gaussians(scene, "float32"), as_camera(scene, "float32")
    appearance = Billboards(side=15)
    params, layout = appearance.allocate(KEY, gaussians)
    output = render_appearance(gaussians, camera, appearance.rule(params, layout))
    np.testing.assert_allclose(output.alpha[6, 8], 0.5, rtol=1e-5)
    np.testing.assert_allclose(output.color[6, 8], 0.5 * np.array([0.2, 0.5, 0.7]), rtol=1e-5)
    border = params.buckets[0][0, [0, -1], :, 3]
    assert border.max() < 1 / 255


@pytest.mark.parametrize("side", [3, 5])
def test_billboards_end_one_texel_beyond_the_border(side):
    """By hand: u runs from −1 to 1 over 8 pixels, 8/(S − 1) from texel to texel; the fade takes as many more."""
    scale = 8 / 2 * 4 / FOCAL
    scene = hand_scene([[0, 0, 4]], [FACING], [np.log([scale, 10 * scale])], [0.5], [[1, 1, 1]])
    appearance = Billboards(side=side)
    gaussians, camera = as_gaussians(scene, "float32"), as_camera(scene, "float32")
    params, layout = appearance.allocate(KEY, gaussians)
    params = Textures((params.buckets[0].at[..., 3].set(0.8),))
    alpha = render_appearance(gaussians, camera, appearance.rule(params, layout)).alpha[6]
    pixels_beyond = np.maximum(abs(np.arange(16) + 0.5 - 8) - 4, 0)
    np.testing.assert_allclose(alpha, 0.8 * np.maximum(1 - pixels_beyond * (side - 1) / 8, 0), atol=2e-6)
    assert np.count_nonzero(alpha) == {3: 16, 5: 12}[side]


@pytest.mark.parametrize("name", ["plain", "movable kernels", "billboards", "shaped"])
def test_limited_opacities(name):
    appearance = APPEARANCES[name]
    gaussians, params, layout = allocated(appearance)
    params = appearance.project(moved(params))
    before = appearance.opacities(gaussians, params, layout)
    most = jnp.median(before)
    after = appearance.opacities(*appearance.limit_opacities(gaussians, params, layout, most), layout)
    assert before.shape == (40,) and before.max() > most * 1.1
    np.testing.assert_array_equal(after <= most * 1.0001, True)
    if name != "movable kernels":  # of which each kernel is limited
        np.testing.assert_allclose(after, np.minimum(before, most), rtol=1e-4)


def test_what_is_trained_is_projected():
    _, params, _ = allocated(MovableKernels())
    assert MovableKernels().project(moved(params)).sharpness.min() == 0
    _, params, _ = allocated(Billboards())
    (bucket,) = Billboards().project(moved(params)).buckets
    assert bucket[..., 3].min() == 0 and bucket[..., 3].max() == jnp.float32(0.99) and bucket[..., :3].min() < -3


def test_copies_of_a_billboard_show_what_one_did():
    appearance = Billboards(side=3)
    gaussians, params, layout = allocated(appearance)
    params = appearance.project(moved(params))
    num_shares = jnp.arange(40, dtype=jnp.int32) % 4 + 1
    same, shared = appearance.share(gaussians, params, layout, num_shares)
    assert same is gaussians
    before, after = (np.asarray(one.buckets[0][:40, ..., 3]) for one in (params, shared))
    stacked = 1 - (1 - after) ** np.asarray(num_shares)[:, None, None]
    np.testing.assert_allclose(stacked, before, atol=1e-6)


def test_copies_of_movable_kernels_are_those_of_a_gaussian_as_opaque():
    appearance = MovableKernels()
    gaussians, params, layout = allocated(appearance)
    params = moved(params)
    num_shares = jnp.arange(40, dtype=jnp.int32) % 4 + 1
    before = appearance.opacities(gaussians, params, layout)
    smaller, shared = appearance.share(gaussians, params, layout, num_shares)
    logits, log_scales = share(logit(before), gaussians.log_scales, num_shares)
    np.testing.assert_allclose(appearance.opacities(smaller, shared, layout), jax.nn.sigmoid(logits), rtol=1e-5)
    np.testing.assert_array_equal(smaller.log_scales, log_scales)
    kept = shared.opacities / params.opacities
    np.testing.assert_allclose(kept, jnp.broadcast_to(kept[:, :1], kept.shape), rtol=1e-5)


def test_padding_is_not_the_largest_alpha():
    """33 textures in a bucket of 36, whose padding has alpha 1."""
    textures, layout = allocate_textures(np.ones((33, 2), np.int64))
    (bucket,) = textures.buckets
    assert bucket.shape[0] == 36
    textures = Textures((bucket.at[:33, ..., 3].set(0.25).at[7, ..., 3].set(0.5),))
    (shown,) = shown_textures(textures, layout, TextureOptions.official()).buckets
    np.testing.assert_allclose(shown[:33, 0, 0, 3], np.where(np.arange(33) == 7, 1.0, 0.5), rtol=1e-5)


def test_official_texels_are_kept_where_clips_have_a_gradient():
    appearance = Textured(options=TextureOptions.official())
    _, params, layout = allocated(appearance)
    raw = moved(params)
    rgb, alpha = np.split(np.asarray(raw.buckets[0]), [3], axis=-1)
    kept = np.concatenate([np.clip(rgb, 0, 1), np.maximum(alpha, 0)], axis=-1)
    np.testing.assert_array_equal(appearance.project(raw).buckets[0], kept)
    texels = appearance.rule(raw, layout).texels
    assert texels.min() == 0 and 0.999 < texels[:, 3].max() <= 1


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: Billboards(side=1), r"side must lie in 2\.\.16; got 1"),
        (lambda: Billboards(initial_rgb=0.0), "initial_rgb"),
        (lambda: Billboards(side=4).from_arrays({"sizes": np.ones((1, 2), int), "texels": np.ones((1, 4))}), "sizes"),
    ],
)
def test_wrong_options_are_refused(make, words):
    with pytest.raises(ValueError, match=words):
        make()


# Capabilities


class Own(Textured):
    """A texture shown by a rule of one's own, as far as anyone knows."""


class OwnShapes(Shaped):
    """Kernels shown by a rule of one's own, as far as anyone knows."""


CAPABILITIES = {
    Appearance(): (False, False, None, True),
    Plain(0.9): (True, True, None, True),
    Textured((2, 3)): (True, True, TextureOptions(), True),
    Textured(options=TextureOptions.official()): (True, False, TextureOptions.official(), True),
    Own(): (False, True, TextureOptions(), True),
    MovableKernels(): (False, False, None, False),
    Billboards(): (False, False, None, False),
    Shaped(): (True, True, None, True),
    Shaped(Textured((2, 3))): (True, True, TextureOptions(), True),
    Shaped(Own()): (False, True, TextureOptions(), True),
    Shaped(MovableKernels()): (False, False, None, False),
    OwnShapes(): (False, True, None, True),
}
"""is_portable, is_linear, texture_options, has_own_opacities."""


@pytest.mark.parametrize("appearance", CAPABILITIES, ids=lambda appearance: type(appearance).__name__)
def test_a_wrapper_can_do_what_it_wraps_can(appearance):
    for shown in (appearance, Banded(appearance)):
        found = shown.is_portable, shown.is_linear, shown.texture_options, shown.has_own_opacities
        assert found == CAPABILITIES[appearance]
        assert shown.base is appearance and shown.max_alpha == appearance.max_alpha
    assert not appearance.has_degrees and Banded(appearance).has_degrees
    assert not Banded(Banded(appearance)).is_portable and Banded(Banded(appearance)).base is appearance


def test_messages_name_the_innermost_layer_that_lacks_something():
    def unportable(appearance: Appearance) -> str:
        return layer_without(appearance, lambda layer: layer.is_portable)

    assert unportable(Banded(Shaped(MovableKernels()))) == "MovableKernels"
    assert unportable(Banded(Banded())) == "Banded and Banded around Plain"
    assert unportable(OwnShapes()) == "OwnShapes around Plain"
    assert layer_without(Banded(Textured()), lambda layer: True) == "Textured"
    assert layers_in_words(Banded(Shaped(Textured())).layers) == "Banded and Shaped around Textured"


def test_portable_appearances_come_from_their_options():
    options = TextureOptions.official()
    assert appearance_for(options, has_textures=False) == Plain(options.max_alpha)
    assert appearance_for(options, has_textures=True) == Textured(options=options)
    assert appearance_for(options, has_textures=True, has_degrees=True) == Banded(Textured(options=options))
    shaped = appearance_for(options, has_textures=True, has_degrees=True, has_shapes=True)
    assert shaped == Banded(Shaped(Textured(options=options)))
    assert appearance_for(options, has_textures=False, has_shapes=True) == Shaped(Plain(options.max_alpha))


class OwnFalloff(Plain):
    """Kernels that are no Gaussians."""

    def rule(self, params, layout):
        return Shaped().rule(ShapedParams(jnp.zeros(1), ()), ShapedLayout(()))


def test_shapes_replace_gaussian_falloffs_only():
    words = r"Shaped .* goes around Plain, Textured .* not around {}; .*Banded\(Shaped\(Textured\(\)\)\)$"
    for inner in (Billboards(), Shaped(), Banded(Textured()), Banded(Shaped())):
        with pytest.raises(ValueError, match=words.format(type(inner).__name__)):
            Shaped(inner)
    with pytest.raises(ValueError, match=words.format("OwnFalloff")):
        Shaped(OwnFalloff()).rule(ShapedParams(jnp.zeros(1), ()), ShapedLayout(()))
