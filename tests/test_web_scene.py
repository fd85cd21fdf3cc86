"""Scenes for browsers: what comes back is within half a step, the first rows show most, no damaged file does harm."""

import dataclasses
import json
import struct
import tracemalloc
import zlib

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from small_values import some_gaussians
from test_compact import MODELS, banded, every_model, order_of, plain, shaped, tables, textured

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
from a2tg_jax.io import web_scene
from a2tg_jax.io.model_rows import rows_of_model
from a2tg_jax.io.web_codes import BITS, signed_root, signed_square
from a2tg_jax.io.web_scene import HEAD, decode_web_scene, encode_web_scene, importance
from a2tg_jax.model import Model


def again(model: Model) -> Model:
    """Written and read."""
    return decode_web_scene(encode_web_scene(model)).model


# What comes back


def test_the_viewer_opens_at_a_central_training_camera():
    """The fourth of five cameras in a row, of which the third is a test view."""
    viewmats = np.stack([np.eye(4)] * 5)
    viewmats[:, 0, 3], viewmats[:, 2, 3] = [3.0, 2.0, 0.0, -0.5, -3.0], 4.0
    K = np.diag([60.0, 60.0, 1.0])
    cameras = [Camera(viewmat, K, 64, 48) for viewmat in viewmats]
    origin = Origin.of_cameras(cameras, is_test=[False, False, True, False, False])
    model = dataclasses.replace(plain(), origin=origin)
    assert decode_web_scene(encode_web_scene(model)).header["first"] == 3


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
    assert found.appearance.texture_options == dataclasses.replace(
        TextureOptions(), uv="align-corners", outside="identity", max_alpha=options.max_alpha
    )
    camera = model.origin.cameras[0]
    difference = np.abs(np.asarray(found.render(camera).color) - np.asarray(model.render(camera).color))
    assert difference.mean() < 0.01
    texels = found.textures.flat()
    assert texels.min() >= 0 and texels[:, 3].max() <= 1 + 1e-6


def test_residuals_near_zero_are_finer_than_large_ones():
    x = np.array([-4.0, -0.01, 0.0, 0.25, 9.0])
    np.testing.assert_allclose(signed_root(x), [-2, -0.1, 0, 0.5, 3])
    np.testing.assert_allclose(signed_square(signed_root(x)), x)


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


def test_chunks_of_many_rows():
    one = plain(16).gaussians
    model = Model(jax.tree.map(lambda x: jnp.tile(x, (40, *[1] * (x.ndim - 1))), one))
    data = encode_web_scene(model)
    scene = decode_web_scene(data)
    assert scene.header["chunk"] < model.num and scene.model.num == model.num


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
    with pytest.raises(ValueError, match=r"model\.sh must be finite"):
        encode_web_scene(Model(dataclasses.replace(gaussians, sh=gaussians.sh.at[2].set(jnp.inf))))


# Damage, and malice


def whole() -> bytes:
    return encode_web_scene(banded(0, shaped(textured(True))))


def refused(data: bytes, match: str = "") -> None:
    """An error that names the file, and takes little memory."""
    tracemalloc.start()
    try:
        with pytest.raises(ValueError, match=f"^bad.a2tgw: .*{match}"):
            decode_web_scene(data, "bad.a2tgw")
        assert tracemalloc.get_traced_memory()[1] < 40e6
    finally:
        tracemalloc.stop()


def resealed(changes: dict, body: bytes | None = None) -> bytes:
    """A whole file whose header says something else, with a right checksum."""
    data = whole()
    _, version, num_text, _, _ = HEAD.unpack_from(data)
    header = json.loads(data[HEAD.size : HEAD.size + num_text])
    coded = data[HEAD.size + num_text :] if body is None else body
    text = json.dumps(header | changes).encode()
    return HEAD.pack(web_scene.MAGIC, version, len(text), len(coded), zlib.crc32(text)) + text + coded


def test_truncated_files_are_refused():
    data = whole()
    for length in (0, 7, HEAD.size - 1, HEAD.size, HEAD.size + 9, len(data) // 2, len(data) - 1):
        refused(data[:length])
    refused(data + b"\0", "are announced")
    refused(b"PK\x03\x04" + data, "not a web scene")
    refused(data[:8] + struct.pack("<H", 9) + data[10:], "version 9")


def test_every_changed_byte_is_noticed():
    data = whole()
    for place in np.random.default_rng(0).integers(0, len(data), 60):
        spoiled = bytearray(data)
        spoiled[place] ^= 0x55
        refused(bytes(spoiled))


@pytest.mark.parametrize(
    "changes",
    [
        {"num": 1 << 24}, {"num": -1}, {"num": 2.0}, {"num": True}, {"num": 10}, {"num_texels": 1 << 24},
        {"num_texels": "9"}, {"chunk": 0}, {"bytes": 1 << 40}, {"bytes": 99}, {"base_degree": 3},
        {"num_bands": 1}, {"num_bands": 5},
        {"means": []}, {"ends": {}}, {"cameras": [{}]}, {"uv": "elsewhere"}, {"outside": 3}, {"max_alpha": 2.0},
        {"max_alpha": "a"}, {"background": None},
    ],
    ids=str,
)  # fmt: skip
def test_headers_that_lie_are_refused(changes):
    assert decode_web_scene(resealed({})).model.num > 0
    refused(resealed(changes))


@pytest.mark.parametrize(
    ("ends", "match"),
    [
        ([-4.0, 4.0], "the logarithms of the exponents of kernels must be within ±1"),
        ([1e30, 2e30], "the logarithms of the exponents of kernels must be within ±1"),
        ([0.0, float("nan")], "NaN is not JSON"),
        ([0.0], "damaged or of another version .*missing"),
    ],
    ids=str,
)
def test_exponents_of_kernels_out_of_range_are_refused(ends, match):
    data = whole()
    num_text = HEAD.unpack_from(data)[2]
    header = json.loads(data[HEAD.size : HEAD.size + num_text])
    refused(resealed({"ends": header["ends"] | {"shapes": ends}}), match)


def test_files_without_shapes_are_those_of_version_1():
    """Readers of version 1 refuse the others by their version alone."""
    assert HEAD.unpack_from(encode_web_scene(plain(1)))[1] == 1 and HEAD.unpack_from(whole())[1] == 2


def test_a_bomb_is_refused():
    bomb = zlib.compress(bytes(200_000_000), 9)
    refused(resealed({"bytes": 200_000_000}, bomb), "announces bytes")
    refused(resealed({}, bomb), "does not unpack")


def test_texture_sizes_and_degrees_are_checked():
    data = whole()
    _, _, num_text, _, _ = HEAD.unpack_from(data)
    num = json.loads(data[HEAD.size : HEAD.size + num_text])["num"]
    body = bytearray(zlib.decompress(data[HEAD.size + num_text :]))
    for place, value, match in ((15 * num, 7, "degrees"), (16 * num, 200, "sides")):
        spoiled = bytearray(body)
        spoiled[place] = value
        refused(resealed({}, zlib.compress(bytes(spoiled))), match)
