"""Appearances as values: what they start as, keep to, count, and hand to densification and to files."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.scipy.special import logit
from scenes_random import as_camera, as_gaussians, draw_scene
from small_models import billboards, movable_kernels, rule_of
from test_oracle import FACING, FOCAL, hand_scene

import a2tg_jax as a2tg
from a2tg_jax import (
    Appearance,
    Bands,
    Exponents,
    Model,
    Texture,
    TextureOptions,
    allocate_appearance,
    allocate_textures,
    combine,
    load_model,
    partition,
    project_appearance,
    render_appearance,
    save_model,
)
from a2tg_jax.appearance.base import clear_rows
from a2tg_jax.core.gaussians import share
from a2tg_jax.events import gather_rows

KEY = jax.random.key(0)
TEXTURED = Appearance(texture=Texture(start=(2, 3)))
APPEARANCES = {
    "plain": Appearance(),
    "textured": TEXTURED,
    "movable kernels": movable_kernels(),
    "billboards": billboards(side=5),
    "shaped": dataclasses.replace(TEXTURED, exponents=Exponents()),
}


def allocated(template: Appearance, num: int = 40):
    gaussians = as_gaussians(draw_scene(2, num=num), "float32")
    return gaussians, allocate_appearance(template, KEY, gaussians)


def moved(appearance):
    """The appearance with noise, so that no two rows are equal."""
    floats, rest = partition(appearance)
    rng = np.random.default_rng(0)
    return combine(jax.tree.map(lambda x: x + rng.normal(size=x.shape).astype(np.float32), floats), rest)


@pytest.mark.parametrize("name", APPEARANCES)
def test_models_are_saved_with_what_they_show(name, tmp_path):
    gaussians, appearance = allocated(APPEARANCES[name])
    model = Model(gaussians, moved(appearance), num_live=jnp.int32(30))
    save_model(tmp_path / "model.npz", model)
    loaded = load_model(tmp_path / "model.npz")
    assert rule_of(loaded.appearance) == APPEARANCES[name] and loaded.num == 30
    jax.tree.map(np.testing.assert_array_equal, loaded.live.appearance, model.live.appearance)
    if name == "shaped":
        camera = as_camera(draw_scene(2, num=3), "float32")
        expected = model.render(camera).color
        assert jnp.max(expected) > 0.1
        np.testing.assert_array_equal(loaded.render(camera).color, expected)


@pytest.mark.parametrize("name", ["textured", "movable kernels", "billboards", "shaped"])
def test_rows_move_and_are_cleared(name):
    gaussians, appearance = allocated(APPEARANCES[name])
    model = Model(gaussians, moved(appearance))
    rows = jnp.asarray(np.random.default_rng(1).integers(0, 40, 40))
    trees = (model, gather_rows(model, rows), clear_rows(model, rows < 20))
    floats = [jax.tree.leaves(partition(tree)[0]) for tree in trees]
    for before, after, without in zip(*floats, strict=True):
        np.testing.assert_array_equal(after[:40], before[rows])
        np.testing.assert_array_equal(
            without[:40], np.where((rows < 20).reshape(-1, *[1] * (before.ndim - 1)), 0, before[:40])
        )


@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize("name", APPEARANCES)
def test_parameters_are_of_the_gaussians_dtype(name):
    gaussians = as_gaussians(draw_scene(2, num=4), "float64")
    floats, _ = partition(allocate_appearance(APPEARANCES[name], KEY, gaussians))
    assert {leaf.dtype for leaf in jax.tree.leaves(floats)} <= {gaussians.means.dtype}


def num_floats(template, num):
    """Trained floats of an appearance besides those of its Gaussians."""
    gaussians, appearance = allocated(template)
    return (Model(gaussians, appearance).bytes_of(num) - Model(gaussians).bytes_of(num)) / 4


def test_floats_of_a_splat():
    floats = {name: num_floats(template, 10) for name, template in APPEARANCES.items()}
    assert floats == {"plain": 0, "textured": 240, "movable kernels": 270, "billboards": 990, "shaped": 250}
    assert num_floats(billboards(), 1) == 1081 - 58
    assert movable_kernels().num_published_floats(1) == 74 - 58


@pytest.mark.parametrize(
    ("template", "size", "opacity"),
    [(movable_kernels(), 1.0, 0.6), pytest.param(billboards(side=15), 0.5, 0.5, marks=pytest.mark.long)],
)
def test_appearances_start_colourless_and_as_opaque_as_their_gaussians_or_half(template, size, opacity):
    scene = hand_scene([[0.1, 0.1, 4]], [FACING], [[size, size]], [0.6], [[0.2, 0.5, 0.7]])
    gaussians = as_gaussians(scene, "float32")
    camera = as_camera(scene, "float32")
    appearance = allocate_appearance(template, KEY, gaussians)
    output = render_appearance(gaussians, camera, appearance)
    # The ray of this pixel meets the mean.
    np.testing.assert_allclose(output.alpha[6, 8], opacity, rtol=1e-5)
    np.testing.assert_allclose(output.color[6, 8], opacity * np.array([0.2, 0.5, 0.7]), rtol=1e-5)
    if hasattr(appearance, "pictures"):
        assert appearance.pictures.buckets[0][0, [0, -1], :, 3].max() < 1 / 255


@pytest.mark.parametrize("side", [3, pytest.param(5, marks=pytest.mark.long)])
def test_billboards_end_one_texel_beyond_the_border(side):
    """By hand: u runs from −1 to 1 over 8 pixels, 8/(S − 1) from texel to texel; the fade takes as many more."""
    scale = 8 / 2 * 4 / FOCAL
    scene = hand_scene([[0, 0, 4]], [FACING], [np.log([scale, 10 * scale])], [0.5], [[1, 1, 1]])
    gaussians = as_gaussians(scene, "float32")
    camera = as_camera(scene, "float32")
    pictures = allocate_appearance(billboards(side=side), KEY, gaussians).pictures
    pictures = dataclasses.replace(pictures, buckets=(pictures.buckets[0].at[..., 3].set(0.8),))
    alpha = render_appearance(gaussians, camera, billboards(pictures=pictures, side=side)).alpha[6]
    pixels_beyond = np.maximum(abs(np.arange(16) + 0.5 - 8) - 4, 0)
    np.testing.assert_allclose(alpha, 0.8 * np.maximum(1 - pixels_beyond * (side - 1) / 8, 0), atol=2e-6)
    assert np.count_nonzero(alpha) == {3: 16, 5: 12}[side]


@pytest.mark.parametrize("name", ["plain", "movable kernels", "billboards", "shaped"])
def test_limited_opacities(name):
    gaussians, appearance = allocated(APPEARANCES[name])
    appearance = project_appearance(moved(appearance))
    before = appearance.opacities(gaussians)
    most = jnp.median(before)
    gaussians, appearance = appearance.limit_opacities(gaussians, most)
    after = appearance.opacities(gaussians)
    assert before.shape == (40,) and before.max() > most * 1.1
    np.testing.assert_array_equal(after <= most * 1.0001, True)
    if name != "movable kernels":  # of which each kernel is limited
        np.testing.assert_allclose(after, np.minimum(before, most), rtol=1e-4)


def test_only_appearances_are_allocated_and_only_allocated_ones_projected():
    gaussians, appearance = allocated(TEXTURED, num=2)
    with pytest.raises(ValueError, match="template must be an Appearance; got Model"):
        allocate_appearance(Model(gaussians, appearance), KEY, gaussians)
    with pytest.raises(ValueError, match="appearance must be an Appearance; got Model"):
        project_appearance(Model(gaussians, appearance))
    with pytest.raises(ValueError, match="this appearance is a template, without arrays"):
        project_appearance(TEXTURED)


def test_what_is_trained_is_projected():
    _, appearance = allocated(movable_kernels())
    assert project_appearance(moved(appearance)).sharpness.min() == 0
    _, appearance = allocated(billboards())
    (bucket,) = project_appearance(moved(appearance)).pictures.buckets
    assert bucket[..., 3].min() == 0 and bucket[..., 3].max() == jnp.float32(0.99) and bucket[..., :3].min() < -3


def test_copies_of_a_billboard_show_what_one_did():
    gaussians, appearance = allocated(billboards(side=3))
    appearance = project_appearance(moved(appearance))
    num_shares = jnp.arange(40, dtype=jnp.int32) % 4 + 1
    same, shared = appearance.share(gaussians, num_shares)
    assert same is gaussians
    before, after = (np.asarray(one.pictures.buckets[0][:40, ..., 3]) for one in (appearance, shared))
    stacked = 1 - (1 - after) ** np.asarray(num_shares)[:, None, None]
    np.testing.assert_allclose(stacked, before, atol=1e-6)


@pytest.mark.long
def test_copies_of_movable_kernels_are_those_of_a_gaussian_as_opaque():
    gaussians, appearance = allocated(movable_kernels())
    appearance = moved(appearance)
    num_shares = jnp.arange(40, dtype=jnp.int32) % 4 + 1
    before = appearance.opacities(gaussians)
    smaller, shared = appearance.share(gaussians, num_shares)
    logits, log_scales = share(logit(before), gaussians.log_scales, num_shares)
    np.testing.assert_allclose(shared.opacities(smaller), jax.nn.sigmoid(logits), rtol=1e-5)
    # JAX rounds its logit otherwise.
    np.testing.assert_allclose(smaller.log_scales, log_scales, rtol=1e-6)
    kept = shared.kernel_opacities / appearance.kernel_opacities
    np.testing.assert_allclose(kept, jnp.broadcast_to(kept[:, :1], kept.shape), rtol=1e-5)


def test_padding_is_not_the_largest_alpha():
    """33 textures in a bucket of 36, whose padding has alpha 1."""
    textures = allocate_textures(np.ones((33, 2), np.int64))
    (bucket,) = textures.buckets
    assert bucket.shape[0] == 36
    textures = dataclasses.replace(textures, buckets=(bucket.at[:33, ..., 3].set(0.25).at[7, ..., 3].set(0.5),))
    (shown,) = Texture(textures, options=TextureOptions.official()).shown().buckets
    np.testing.assert_allclose(shown[:33, 0, 0, 3], np.where(np.arange(33) == 7, 1.0, 0.5), rtol=1e-5)


def test_official_texels_are_kept_where_clips_have_a_gradient():
    _, appearance = allocated(Appearance(texture=Texture(options=TextureOptions.official())))
    raw = moved(appearance)
    rgb, alpha = np.split(np.asarray(raw.textures.buckets[0]), [3], axis=-1)
    kept = np.concatenate([np.clip(rgb, 0, 1), np.maximum(alpha, 0)], axis=-1)
    np.testing.assert_array_equal(project_appearance(raw).textures.buckets[0], kept)
    texels, _ = raw.atlas()
    assert texels.min() == 0 and 0.999 < texels[:, 3].max() <= 1


@a2tg.pytree
class OwnFalloff(Appearance):
    """Kernels that are no Gaussians."""

    def falloff(self, numbers, rho):
        return 1 / (1 + rho)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: billboards(side=1), r"side must be in 2\.\.16; got 1"),
        (lambda: billboards(initial_rgb=0.0), "initial_rgb"),
        (lambda: billboards(exponents=Exponents()), "exponents replace a Gaussian falloff, and Billboards has another"),
        (lambda: OwnFalloff(exponents=Exponents()), "exponents replace a Gaussian falloff, and OwnFalloff has another"),
    ],
)
def test_wrong_options_are_refused(make, words):
    with pytest.raises(ValueError, match=words):
        make()


def test_billboards_of_another_size_are_refused(tmp_path):
    gaussians, appearance = allocated(billboards(side=4))
    model = Model(gaussians, appearance.with_textures(allocate_textures(np.full((40, 2), 3))))
    with pytest.raises(ValueError, match=r"pictures must all have 4 × 4 texels; got sizes \(\(3, 3\),\)$"):
        save_model(tmp_path / "model.npz", model)


# Capabilities


@a2tg.pytree
class Own(Appearance):
    """A custom appearance, whatever it shows."""


OFFICIAL = Texture(options=TextureOptions.official())
CAPABILITIES = [
    (Appearance(), (True, True, None, True)),
    (Appearance(max_alpha=0.9), (True, True, None, True)),
    (TEXTURED, (True, True, TextureOptions(), True)),
    (Appearance(texture=OFFICIAL), (True, False, TextureOptions.official(), True)),
    (Own(texture=Texture()), (False, False, TextureOptions(), True)),
    (movable_kernels(), (False, False, None, False)),
    (billboards(), (False, False, None, False)),
    (Appearance(exponents=Exponents()), (True, True, None, True)),
    (Appearance(texture=OFFICIAL, exponents=Exponents()), (True, False, TextureOptions.official(), True)),
    (movable_kernels(exponents=Exponents()), (False, False, None, False)),
]
"""is_portable, is_linear, texture_options, has_own_opacities."""


@pytest.mark.parametrize(("appearance", "wanted"), CAPABILITIES)
def test_parts_leave_to_an_appearance_what_it_can_do(appearance, wanted):
    for shown in (appearance, dataclasses.replace(appearance, bands=Bands())):
        found = shown.is_portable, shown.is_linear, shown.texture_options, shown.has_own_opacities
        assert found == wanted and shown.alpha_limit == appearance.alpha_limit


def test_portable_appearances_come_from_their_options_and_have_words():
    whole = Appearance(texture=OFFICIAL, exponents=Exponents(), bands=Bands())
    assert whole.description == "Gaussians with texture, exponents and bands"
    assert Appearance().description == "plain Gaussians" and movable_kernels().description == "MovableKernels"
    assert movable_kernels(exponents=Exponents()).description == "MovableKernels with exponents"
