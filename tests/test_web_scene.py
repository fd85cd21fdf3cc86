"""Scenes for browsers: what they show is within half a step, the first rows show most, and files hold it."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from small_values import some_gaussians
from test_compact import MODELS, every_model, order_of, plain, shaped, tables, textured
from web_header import web_header

from a2tg_jax.appearance import (
    Bands,
    Billboards,
    Exponents,
    MovableKernels,
    TextureOptions,
    allocate_appearance,
    in_words,
)
from a2tg_jax.core.cameras import Camera
from a2tg_jax.core.origin import Origin
from a2tg_jax.finish.compaction import loss_beside_renders
from a2tg_jax.io.model_rows import rows_of_model
from a2tg_jax.io.web_scene import BITS, HEAD, encode_web_scene, importance, rounded_model
from a2tg_jax.model import Model, concatenate


def again(model: Model) -> Model:
    """As browsers show it."""
    return rounded_model(model)


# What comes back


def test_the_viewer_opens_at_a_central_training_camera():
    """The fourth of five cameras in a row, of which the third is a test view."""
    viewmats = np.stack([np.eye(4)] * 5)
    viewmats[:, 0, 3], viewmats[:, 2, 3] = [3.0, 2.0, 0.0, -0.5, -3.0], 4.0
    K = np.diag([60.0, 60.0, 1.0])
    cameras = [Camera(viewmat, K, 64, 48) for viewmat in viewmats]
    origin = Origin.of_cameras(cameras, is_test=[False, False, True, False, False])
    model = dataclasses.replace(plain(), origin=origin)
    assert web_header(encode_web_scene(model))["first"] == 3


@every_model
def test_numbers_come_back_within_half_a_step(name):
    model = MODELS[name]()
    found = again(model)
    order = order_of(model, found)
    wanted, values = tables(model, order), tables(found)
    assert set(wanted) == set(values) and found.num_bytes == model.num_bytes
    assert in_words(found.appearance) == in_words(model.appearance)
    for group in {"log_scales", "opacities", "sh_0", "shapes"} & set(wanted):
        step = np.ptp(wanted[group]) / (2 ** BITS[group] - 2)
        assert np.abs(values[group] - wanted[group]).max() <= step / 2 * 1.001 + 1e-6
    for degree, columns in ((1, slice(0, 3)), (2, slice(3, 8)), (3, slice(8, 15))):
        if values["sh_rest"][:, columns].size:
            step = np.ptp(wanted["sh_rest"][:, columns]) / (2 ** BITS[f"sh_{degree}"] - 2)
            assert (
                np.abs(values["sh_rest"][:, columns] - wanted["sh_rest"][:, columns]).max() <= step / 2 * 1.001 + 1e-6
            )
    for exact in set(wanted) & {"degrees", "sizes"}:
        np.testing.assert_array_equal(values[exact], wanted[exact])
    np.testing.assert_allclose(values["means"], wanted["means"], atol=1e-3)


@every_model
def test_the_picture_is_the_same_up_to_rounding(name):
    model = MODELS[name]()
    loss = loss_beside_renders(model, model.origin.cameras[:1])
    # These random models are no trained ones: their textures and view dependence are noise of full range.
    assert loss(again(model)) < 1.0 and loss(model) == 0.0


def test_cameras_and_background_come_back():
    model = textured()
    loaded = again(model)
    found = loaded.origin
    np.testing.assert_allclose(found.viewmats, model.origin.viewmats, atol=1e-6)
    np.testing.assert_allclose(found.Ks, model.origin.Ks, rtol=1e-6)
    assert found.names == model.origin.names and found.is_test.tolist() == model.origin.is_test.tolist()
    assert found.sizes.tolist() == model.origin.sizes.tolist()
    np.testing.assert_allclose(loaded.background, model.background, rtol=1e-6)
    assert again(dataclasses.replace(model, origin=None)).origin is None


def test_textures_are_kept_as_they_are_seen():
    """The authors' conventions clip residuals and divide alpha: the file holds what is left, and says where to look."""
    options = TextureOptions.official()
    base = textured()
    texture = dataclasses.replace(base.appearance.texture, options=options)
    model = dataclasses.replace(base, appearance=dataclasses.replace(base.appearance, texture=texture))
    found = again(model)
    assert found.appearance.texture_options == dataclasses.replace(options, rgb="signed", alpha="projected")
    camera = model.origin.cameras[0]
    difference = np.abs(np.asarray(found.render(camera).color) - np.asarray(model.render(camera).color))
    assert difference.mean() < 0.01
    texels = found.textures.flat()
    assert texels.min() >= 0 and texels[:, 3].max() <= 1 + 1e-6


def test_rows_that_show_most_come_first():
    model = dataclasses.replace(plain(), origin=None)
    found = again(model)
    weights = importance(rows_of_model(found), None)
    steps = weights[1:] / weights[:-1]
    assert np.all(steps < 1.3) and weights[0] > 4 * weights[-1]


def test_what_is_nearer_to_the_cameras_comes_first():
    gaussians = jax.tree.map(lambda x: jnp.repeat(x[:1], 2, axis=0), some_gaussians())
    origin = plain().origin
    center = -origin.viewmats[0, :3, :3].T @ origin.viewmats[0, :3, 3]
    means = np.stack([center + np.array([0, 0, z]) for z in (30.0, 3.0)])
    model = Model(dataclasses.replace(gaussians, means=jnp.asarray(means, jnp.float32)), origin=origin)
    near, far = importance(rows_of_model(model), origin)[::-1]
    assert near > 50 * far


@pytest.mark.parametrize("name", ["plain 1", "textured", "banded and textured", "shaped"])
def test_a_model_of_no_gaussians(name):
    model = dataclasses.replace(MODELS[name](), num_live=jnp.asarray(0, jnp.int32))
    assert again(model).num == 0


def test_splats_that_are_all_alike_come_back():
    model = Model(jax.tree.map(lambda x: jnp.repeat(x, 200_000, axis=0), plain(1).gaussians[:1]))
    assert again(model).num == 200_000


# What is refused


@pytest.mark.parametrize(
    "template",
    [
        *(MovableKernels(bands=bands, exponents=shapes) for bands in (None, Bands()) for shapes in (None, Exponents())),
        *(Billboards(bands=bands) for bands in (None, Bands())),
    ],
    ids=in_words,
)
def test_other_appearances_are_refused_by_name(template):
    gaussians = some_gaussians()
    model = Model(gaussians, allocate_appearance(template, jax.random.key(0), gaussians))
    with pytest.raises(ValueError, match=f"cannot show {in_words(template)}: it shows Gaussians with"):
        encode_web_scene(model)


def test_numbers_that_are_not_finite_are_refused():
    gaussians = some_gaussians()
    with pytest.raises(ValueError, match=r"gaussians\.sh must be finite"):
        encode_web_scene(Model(dataclasses.replace(gaussians, sh=gaussians.sh.at[2].set(jnp.inf))))


@pytest.mark.parametrize("name", MODELS)
@pytest.mark.parametrize("num_copies", [1, 40])
def test_the_file_holds_the_rounded_numbers(reference, tmp_path, name, num_copies):
    """In one chunk and in several, by the reference reader, which shares no code."""
    model = MODELS[name]()
    if num_copies > 1 and model.textures is None and model.appearance.bands is None:
        model = concatenate([model] * num_copies)
    (tmp_path / "a.a2tgw").write_bytes(encode_web_scene(model))
    found, wanted = reference[0](tmp_path / "a.a2tgw"), rounded_model(model)
    assert len(found["means"]) == wanted.num
    np.testing.assert_allclose(found["means"], wanted.gaussians.means, rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(found["sh"][:, : wanted.sh.shape[1]], wanted.sh, atol=1e-5)
    np.testing.assert_allclose(found["opacities"], wanted.gaussians.opacities, atol=1e-5)
    if wanted.textures is not None:
        np.testing.assert_array_equal(found["sizes"], wanted.textures.sizes)
        np.testing.assert_allclose(found["texels"], wanted.textures.flat(), atol=1e-5)


def test_files_without_shapes_are_those_of_version_1():
    """Readers of version 1 refuse the others by their version alone."""
    versions = [HEAD.unpack_from(encode_web_scene(model))[1] for model in (plain(1), shaped(plain(1)))]
    assert versions == [1, 2]


def test_a_file_is_no_bomb():
    """Of numbers that are all alike: readers refuse what unpacks to more than 64 times its size and 1 MiB."""
    model = Model(jax.tree.map(lambda x: jnp.repeat(x, 200_000, axis=0), plain(1).gaussians[:1]))
    data = encode_web_scene(model)
    assert web_header(data)["bytes"] <= 64 * len(data) + 2**20
