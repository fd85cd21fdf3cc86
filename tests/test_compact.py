"""Compact scene files: what comes back is within half a step, shows the same, and no damaged file does harm."""

import dataclasses
import json
import math
import tracemalloc
import zlib

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import zstandard
from scenes_random import as_camera, as_gaussians, draw_scene
from scipy.spatial import cKDTree
from small_values import some_gaussians

from a2tg_jax.appearance import (
    Appearance,
    Bands,
    Billboards,
    Exponents,
    MovableKernels,
    Texture,
    TextureOptions,
    allocate_appearance,
    template_of,
)
from a2tg_jax.appearance.files import arrays_of
from a2tg_jax.appearance.parts import bands_of_dense, log_exponents_of, shapes_of
from a2tg_jax.core.gaussians import Gaussians, rotation_matrices
from a2tg_jax.core.origin import Origin
from a2tg_jax.io import compact
from a2tg_jax.io.columns import (
    CODERS,
    AxisSteps,
    ColumnReader,
    ColumnWriter,
    Ends,
    decode,
    dequantised,
    encode,
    from_byte_planes,
    from_morton,
    from_planes,
    morton,
    quantised,
    to_byte_planes,
    to_planes,
    with_green,
    with_w,
)
from a2tg_jax.io.compact import GROUPS, HEAD, CompactChoices, decode_model, encode_model, load_compact, save_compact
from a2tg_jax.io.model_rows import nearest_half_turn
from a2tg_jax.io.ply import load_ply, save_ply
from a2tg_jax.model import Model
from a2tg_jax.render import RenderSettings
from a2tg_jax.texture import textures_from_arrays

EXACT = CompactChoices().keeping(dict.fromkeys(GROUPS, "float32"))
SCENE = draw_scene(4)
NUM = len(SCENE.means)
SETTINGS = RenderSettings(capacity=4096)


def origin() -> Origin:
    camera = as_camera(SCENE, "float32")
    return Origin.of_cameras([camera, camera], ["a é.png", "b.png"], is_test=[True, False])


def some_model(gaussians: Gaussians, appearance: Appearance) -> Model:
    return Model(gaussians, appearance, background=(0.1, 0.2, 0.3), origin=origin())


def plain(num_bases: int = 16) -> Model:
    gaussians = as_gaussians(SCENE, "float32")
    return some_model(dataclasses.replace(gaussians, sh=gaussians.sh[:, :num_bases]), Appearance(max_alpha=0.9))


def some_textures(has_empty: bool = False):
    arrays = [np.asarray(texture, np.float32) for texture in SCENE.textures]
    return textures_from_arrays(
        [np.zeros((0, 0, 4), np.float32) if has_empty and i % 3 == 0 else array for i, array in enumerate(arrays)]
    )


def textured(has_empty: bool = False) -> Model:
    texture = Texture(some_textures(has_empty), (2, 2), TextureOptions(max_alpha=0.95))
    return some_model(as_gaussians(SCENE, "float32"), Appearance(texture=texture))


def shaped(inner: Model) -> Model:
    exponents = Exponents(jnp.asarray(np.random.default_rng(2).normal(size=inner.gaussians.num), jnp.float32))
    return dataclasses.replace(inner, appearance=dataclasses.replace(inner.appearance, exponents=exponents))


def banded(base_degree: int, inner: Model) -> Model:
    degrees = np.random.default_rng(1).integers(base_degree, 4, NUM)
    num_bases = (base_degree + 1) ** 2
    bands = Bands(bands_of_dense(np.asarray(inner.gaussians.sh)[:, num_bases:], degrees, base_degree))
    gaussians = dataclasses.replace(inner.gaussians, sh=inner.gaussians.sh[:, :num_bases])
    return some_model(gaussians, dataclasses.replace(inner.appearance, bands=bands))


MODELS = {
    **{f"plain {bases}": lambda bases=bases: plain(bases) for bases in (1, 4, 9, 16)},
    "textured": textured,
    "textured or not": lambda: textured(True),
    "banded 0": lambda: banded(0, plain()),
    "banded 1": lambda: banded(1, plain()),
    "banded 3": lambda: banded(3, plain()),
    "banded and textured": lambda: banded(0, textured(True)),
    "shaped": lambda: shaped(plain()),
    "banded, shaped and textured": lambda: banded(0, shaped(textured(True))),
}
every_model = pytest.mark.parametrize("name", MODELS)


def order_of(model: Model, found: Model) -> np.ndarray:
    """Which row of the model became each of the found."""
    order = cKDTree(np.asarray(model.gaussians.means)).query(np.asarray(found.gaussians.means))[1]
    assert len(set(order.tolist())) == model.num
    return order


def tables(model: Model, order=None) -> dict[str, np.ndarray]:
    """All numbers by group, in an order of rows. Textures as what they have in common with all their mirrored ones."""
    order = np.arange(model.num) if order is None else order
    sh = model.sh[order]
    found = {
        "means": np.asarray(model.gaussians.means)[order],
        "log_scales": np.asarray(model.gaussians.log_scales)[order],
        "opacities": np.asarray(model.gaussians.opacities)[order],
        "sh_0": sh[:, :1],
        "sh_rest": sh[:, 1:],
    }
    arrays = arrays_of(model.appearance, model.gaussians.sh_degree)
    if "shapes" in arrays:
        found["shapes"] = log_exponents_of(arrays["shapes"][order])
    if "degrees" in arrays:
        found["degrees"] = arrays["degrees"][order]
    if "sizes" in arrays:
        found["sizes"] = np.asarray(arrays["sizes"])[order]
        pieces = np.split(arrays["texels"], np.cumsum(np.prod(arrays["sizes"], axis=1))[:-1])
        found["texels"] = np.array(
            [np.sort(pieces[row], axis=0).mean(0) if len(pieces[row]) else np.zeros(4) for row in order]
        )
    return found


# Round trips


@every_model
def test_floats_come_back_as_they_were_in_another_order(name, tmp_path):
    model = MODELS[name]()
    save_compact(tmp_path / "m.a2tgz", model, choices=EXACT)
    found = load_compact(tmp_path / "m.a2tgz")
    assert template_of(found.appearance) == template_of(model.appearance)
    assert found.background == model.background and found.origin == model.origin
    assert found.num_bytes == model.num_bytes and found.num == model.num
    order = order_of(model, found)
    for group, values in tables(found).items():
        wanted = tables(model, order)[group]
        np.testing.assert_allclose(values, wanted, rtol=0, atol=1e-6 if group == "texels" else 0)
    wanted, got = (np.asarray(rotation_matrices(m.gaussians.quats)) for m in (model, found))
    np.testing.assert_allclose(np.abs(got[:, :, 2]), np.abs(wanted[order][:, :, 2]), atol=2e-6)


@every_model
@pytest.mark.parametrize("choices", [EXACT, CompactChoices().keeping(dict.fromkeys(GROUPS, 12))], ids=["exact", "fine"])
def test_what_comes_back_looks_the_same(name, choices):
    """Mirrored textures and half-turned splats included."""
    model = MODELS[name]()
    camera = model.origin.cameras[0]
    image = np.asarray(model.render(camera, settings=SETTINGS).color)
    again = np.asarray(decode_model(encode_model(model, choices)).render(camera, settings=SETTINGS).color)
    assert np.std(image) > 0.02
    difference = np.abs(image - again)
    assert np.quantile(difference, 0.99) < (1e-4 if choices is EXACT else 0.02)
    assert difference.mean() < (1e-4 if choices is EXACT else 0.003)


@pytest.mark.parametrize("coder", ["smallest", *CODERS])
def test_coders_do_not_change_what_comes_back(coder):
    model = banded(0, textured(True))
    data = encode_model(model, CompactChoices(coder=coder))
    wanted, found = decode_model(encode_model(model, CompactChoices(coder="none"))), decode_model(data)
    assert len(encode_model(model)) < len(data) or coder == "smallest"
    assert jax.tree.structure(found) == jax.tree.structure(wanted)
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(wanted), strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("precision", [3, 8, 11, 16, "float16"])
@pytest.mark.parametrize("group", [group for group in GROUPS if group not in ("means", "quats", "texels")])
def test_errors_are_half_a_step_at_most(group, precision):
    model = banded(0, shaped(plain()))
    found = decode_model(encode_model(model, EXACT.keeping({group: precision})))
    order = order_of(model, found)
    wanted, values = tables(model, order)[group], tables(found)[group]
    assert np.abs(values - wanted).max() <= half_step(wanted, precision)
    for other in set(tables(model)) - {group}:
        np.testing.assert_array_equal(tables(found)[other], tables(model, order)[other])


def half_step(values: np.ndarray, precision) -> float:
    """The largest error; of float16 relative to numbers that lie within a few units of 0."""
    if precision == "float16":
        return float(np.abs(values).max()) * 2**-10
    return float(np.ptp(values)) / (2**precision - 2) / 2 * 1.001 + 1e-6


@pytest.mark.parametrize("bits", [4, 8, 12, 16])
def test_rotations_are_within_the_diagonal_of_a_step(bits):
    model = plain()
    found = decode_model(encode_model(model, EXACT.keeping({"quats": bits})))
    order = order_of(model, found)
    quats, axis = nearest_half_turn(np.asarray(model.gaussians.quats)[order])
    wanted, step = quats[:, 1:], np.ptp(quats[:, 1:]) / (2**bits - 2)
    # w follows from the others, which change it by three times as much at most: it is no smaller than they are.
    assert np.abs(np.asarray(found.gaussians.quats)[:, 1:] - wanted).max() <= 2 * step + 1e-6
    assert np.linalg.norm(np.asarray(found.gaussians.quats) - quats, axis=1).max() <= 3 * step + 1e-6
    assert set(axis) == {0, 1, 2, 3}


@pytest.mark.parametrize("bits", [6, 10, 14, 16])
def test_means_are_within_a_step_that_grows_with_the_distance(bits):
    means = np.random.default_rng(0).standard_t(2, size=(3, 400)).astype(np.float32) * 5
    writer = ColumnWriter("none")
    order = writer.means("means", means, bits)
    found = ColumnReader(writer.body, writer.layout, 10**6).means("means", 400, bits)
    for axis, values in zip(means[:, order], found, strict=True):
        contraction = AxisSteps.of(axis, bits)
        step = np.ptp(contraction.contracted(axis)) / (2**bits - 2)
        # The derivative of sinh, at the end of half a step.
        slope = np.cosh(np.abs(contraction.contracted(axis)) + step / 2)
        assert np.all(np.abs(values - axis) <= contraction.spread * slope * step / 2 * 1.001 + 1e-5 * np.abs(axis))


@pytest.mark.parametrize("precision", [2, 8, 13, "float16", "float32"])
def test_texels_keep_their_places(precision):
    """Splats whose rotations need no half-turn, so that nothing is mirrored."""
    gaussians = dataclasses.replace(some_gaussians(5), quats=jnp.tile(jnp.asarray([1.0, 0.1, 0.0, 0.0]), (5, 1)))
    rng = np.random.default_rng(0)
    arrays = [rng.normal(size=(*size, 4)).astype(np.float32) for size in ((1, 1), (2, 3), (0, 0), (4, 1), (2, 3))]
    model = Model(gaussians, Appearance(texture=Texture(textures_from_arrays(arrays))))
    found = decode_model(encode_model(model, CompactChoices(texels=precision)))
    order = order_of(model, found)
    wanted = np.concatenate([arrays[row].reshape(-1, 4) for row in order])
    texels = found.textures.flat()
    for columns in (slice(0, 3), slice(3, 4)):
        error = np.abs(texels[:, columns] - wanted[:, columns]).max()
        assert error <= (0 if precision == "float32" else half_step(wanted[:, columns], precision))


@pytest.mark.parametrize("name", ["plain 1", "textured", "banded and textured", "shaped"])
@pytest.mark.parametrize("choices", [EXACT, CompactChoices(), CompactChoices(coder="webp")])
def test_a_model_of_no_gaussians(name, choices):
    model = dataclasses.replace(MODELS[name](), num_live=jnp.asarray(0, jnp.int32))
    found = decode_model(encode_model(model, choices))
    assert found.num == 0 and template_of(found.appearance) == template_of(model.appearance)
    assert found.background == model.background and found.origin == model.origin
    assert found.gaussians.sh.shape == (0, *model.gaussians.sh.shape[1:])
    image = found.render(found.origin.cameras[0], settings=SETTINGS).color
    np.testing.assert_allclose(image[0, 0], found.background, rtol=1e-6)


def test_only_rows_that_exist_are_kept():
    model = dataclasses.replace(textured(), num_live=jnp.asarray(7, jnp.int32))
    found = decode_model(encode_model(model))
    assert found.num == 7 and found.num_bytes == model.num_bytes


def test_splats_that_are_all_alike_take_more_room_than_they_need_and_come_back():
    """The file of so few bytes would be refused as a bomb: it is written without a coder."""
    one = plain(1).gaussians[:1]
    model = Model(jax.tree.map(lambda x: jnp.repeat(x, 300_000, axis=0), one))
    found = decode_model(encode_model(model))
    assert found.num == 300_000
    np.testing.assert_allclose(found.gaussians.means[-1], one.means[0], atol=1e-6)


def test_extreme_numbers_are_kept():
    gaussians = plain(1).gaussians
    gaussians = dataclasses.replace(
        gaussians,
        means=gaussians.means.at[0].set(jnp.asarray([1e11, -1e11, 9e11])),
        quats=gaussians.quats.at[1].set(0.0),
        logit_opacities=gaussians.logit_opacities.at[:2].set(jnp.asarray([-200.0, 200.0])),
    )
    found = decode_model(encode_model(Model(gaussians), CompactChoices(means=16)))
    largest = int(np.argmax(np.asarray(found.gaussians.means)[:, 0]))
    np.testing.assert_allclose(found.gaussians.means[largest], [1e11, -1e11, 9e11], rtol=2e-3)
    assert np.asarray(found.gaussians.opacities).min() < 1e-6 and np.asarray(found.gaussians.opacities).max() > 1 - 1e-6


def test_files_without_shapes_are_those_of_version_1():
    """Readers of version 1 refuse the others by their version alone."""
    version = lambda data: HEAD.unpack_from(data)[1]  # noqa: E731
    data = encode_model(plain(1))
    assert version(data) == 1 and "shapes" not in compact._unframed(data)[0]["choices"]
    assert version(encode_model(shaped(plain(1)))) == 2


@pytest.mark.parametrize("bits", [1, 2, 5, 8])
def test_shapes_of_any_precision_are_finite(bits):
    """The ends of the range included, which even steps may move outwards."""
    model = shaped(plain(1))
    shapes = jnp.asarray(np.resize([-30.0, 30.0, 0.0, 0.3], NUM), jnp.float32)
    model = dataclasses.replace(model, appearance=model.appearance.with_shapes(shapes))
    found = decode_model(encode_model(model, CompactChoices(shapes=bits)))
    wanted, values = tables(model, order_of(model, found))["shapes"], tables(found)["shapes"]
    assert np.abs(values - wanted).max() <= {1: 1.0, 2: 0.5}.get(bits, half_step(wanted, max(bits, 2))) + 1e-6


@pytest.mark.parametrize("value", [np.nan, np.inf, -1e30, 1.6])
def test_exponents_out_of_range_are_refused(value):
    with pytest.raises(ValueError, match="logarithms of the exponents of kernels must be within ±1"):
        shapes_of(np.asarray([0.0, value]))


# What is refused


@pytest.mark.parametrize("kind", [MovableKernels, Billboards])
@pytest.mark.parametrize(("bands", "words"), [(None, ""), (Bands(), " with bands")])
def test_other_appearances_are_refused(kind, bands, words):
    gaussians = some_gaussians()
    appearance = allocate_appearance(kind(bands=bands), jax.random.key(0), gaussians)
    with pytest.raises(ValueError, match=f"shows {kind.__name__}{words}: a compact file holds .*save_model"):
        encode_model(Model(gaussians, appearance))


@pytest.mark.parametrize("field", [field.name for field in dataclasses.fields(Gaussians)])
def test_numbers_that_are_not_finite_are_refused(field):
    gaussians = some_gaussians()
    spoiled = dataclasses.replace(gaussians, **{field: getattr(gaussians, field).at[3].set(jnp.nan)})
    with pytest.raises(ValueError, match=rf"{field}\S* must be finite"):
        encode_model(Model(spoiled))


def test_what_float16_cannot_hold_is_refused():
    model = Model(dataclasses.replace(some_gaussians(), sh=1e6 * some_gaussians().sh))
    with pytest.raises(ValueError, match="sh_1 must be finite as float16"):
        encode_model(model, CompactChoices(sh_rest="float16"))


@pytest.mark.parametrize(
    ("choice", "value"),
    [("means", 0), ("means", 17), ("quats", True), ("texels", 2.5), ("sh_0", "float64"), ("coder", "zip")],
)
def test_choices_that_cannot_be_are_refused(choice, value):
    with pytest.raises(ValueError, match=rf"choices\.{choice} must be"):
        encode_model(plain(1), dataclasses.replace(CompactChoices(), **{choice: value}))


def test_missing_file(tmp_path):
    with pytest.raises(FileNotFoundError, match="nowhere"):
        load_compact(tmp_path / "nowhere.a2tgz")


# Damage, and malice


def whole() -> bytes:
    return encode_model(banded(0, shaped(textured(True))))


def refused(tmp_path, data: bytes, match: str | None = None) -> None:
    """The file is an error that names it, and takes little memory."""
    path = tmp_path / "bad.a2tgz"
    path.write_bytes(data)
    tracemalloc.start()
    try:
        with pytest.raises(ValueError, match=match) as caught:
            load_compact(path)
        assert tracemalloc.get_traced_memory()[1] < 40e6
    finally:
        tracemalloc.stop()
    assert "bad.a2tgz" in str(caught.value)


def sealed(header: dict, body: bytes) -> bytes:
    """A file with a right checksum, whatever it says."""
    return compact._framed(header, body)


def test_truncated_files_are_refused(tmp_path):
    data = whole()
    for length in (0, 3, HEAD.size - 1, HEAD.size, HEAD.size + 5, len(data) // 2, len(data) - 1):
        refused(tmp_path, data[:length])
    refused(tmp_path, data + b"\0", "damaged")
    refused(tmp_path, b"PK\x03\x04" + data, "not a compact scene")


def test_every_changed_byte_is_noticed(tmp_path):
    data = whole()
    for place in np.random.default_rng(0).integers(0, len(data), 60):
        spoiled = bytearray(data)
        spoiled[place] ^= 1 << int(place % 8)
        refused(tmp_path, bytes(spoiled))


@pytest.mark.parametrize("coder", CODERS)
def test_changed_bytes_under_a_right_checksum_do_no_harm(coder):
    """A model of other numbers, or a ValueError; nothing else."""
    data = encode_model(banded(0, textured(True)), CompactChoices(coder=coder))
    rng = np.random.default_rng(1)
    num_refused = 0
    for _ in range(150):
        rest = bytearray(data[HEAD.size :])
        for place in rng.integers(0, len(rest), rng.integers(1, 4)):
            rest[place] = rng.integers(256)
        cut = rng.integers(0, 3)
        rest = rest[: len(rest) - int(cut)]
        fields = list(HEAD.unpack_from(data))
        fields[-1] = zlib.crc32(bytes(rest))
        try:
            decode_model(HEAD.pack(*fields) + bytes(rest))
        except ValueError as error:
            num_refused += 1
            assert "the compact scene" in str(error)
    assert num_refused > 40


def header_with(**changes):
    def change(header):
        for name, value in changes.items():
            *path, last = name.split("__")
            inner = header
            for key in path:
                inner = inner[key]
            inner[last] = value

    return change


def sizes_of(*size):
    def change(header):
        header["sizes"] = [size] * len(header["sizes"])

    return change


@pytest.mark.parametrize(
    ("change", "match"),
    [
        (header_with(num=2**60), "means would take .* the file is too small"),
        (header_with(num=10**400), "a number of 401 digits is too large"),
        (header_with(num=-1), "must be of a number of rows"),
        (header_with(num=True), "must be of a number of rows"),
        (header_with(num=50.0), "must be of a number of rows"),
        (header_with(num=49), "the part means"),
        (header_with(num=0), "the part means holds bytes where there should be none"),
        (header_with(base_degree=4), "base degree"),
        (header_with(base_degree=3), "degrees must lie in 3..3"),
        (header_with(degrees=[0, 1, 2, 7]), "degrees must lie in 0..3"),
        (header_with(degrees=[]), "degrees are of a table that is empty"),
        (header_with(degrees=[0, 3]), "must be below 2|the part degrees"),
        (header_with(degrees="0123"), "degrees must lie"),
        (sizes_of(16, 16), "the part texel_colors"),
        (sizes_of(10**9, 10**9), "texture sides must lie in 0..16"),
        (sizes_of(0, 5), "the part texel_colors holds bytes where there should be none"),
        (sizes_of(1, 1, 1), "texture sides must be pairs"),
        (header_with(sizes=None), "damaged"),
        (header_with(lengths={}), "its parts must have"),
        (header_with(lengths__means=-4), "its parts must have"),
        (header_with(lengths__means=2**70), "its parts must have"),
        (header_with(lengths__means="many"), "its parts must have"),
        (header_with(lengths=[1, 2]), "damaged"),
        (header_with(coders={}), "damaged"),
        (header_with(coders__quats="pickle"), "the part quats is of the coder pickle, which is not known"),
        (header_with(coders__quats=["lzma"]), "not known"),
        (header_with(coders__means="none"), "the part means"),
        (header_with(ends__means=[0.0]), "the ends of means must be 12 numbers"),
        (header_with(ends__means=[1e30] * 12), "means|the part"),
        (header_with(ends__means=[0.0, 1e38, -1e3, 1e3] * 3), "means must be finite"),
        (header_with(ends__sh_1=[-1e39, 1e39]), "the ends of sh_1 must be 2 numbers"),
        (header_with(ends__sh_1=["a", "b"]), "the ends of sh_1 must be 2 numbers"),
        (header_with(ends__sh_1=[0.5, 0.5]), "the part sh_1 holds bytes where there should be none"),
        (header_with(ends__shapes=[-3.0, 3.0]), "exponents of kernels must be within"),
        (header_with(ends__shapes=[1e30, 1e31]), "exponents of kernels must be within"),
        (header_with(ends__shapes=[0.0, "NaN"]), "the ends of shapes must be 2 numbers"),
        (header_with(lengths__shapes=3), "its parts must have"),
        (header_with(choices__shapes=16), "the part shapes"),
        (header_with(choices__shapes="float32"), "the part shapes"),
        (header_with(ends={}), "damaged"),
        (header_with(choices__means=40), r"choices\.means must be"),
        (header_with(choices__coder="pickle"), r"choices\.coder must be"),
        (header_with(choices__texels="float64"), r"choices\.texels must be"),
        (header_with(choices=7), "choices must hold"),
        (header_with(appearance__name="Billboards"), "Billboards|options"),
        (header_with(appearance__module="os", appearance__name="system"), "not known here"),
        (header_with(appearance__parts__texture__start=7), "options of Texture"),
        (header_with(appearance__parts={}), "degrees must lie in 0..0"),
        (lambda header: header["appearance"]["parts"].pop("exponents"), r"\['shapes'\] came"),
        (header_with(appearance__parts={"wings": {}}), "damaged"),
        (header_with(appearance=None), "damaged"),
        (header_with(origin__names=["x"] * 1000), "the part origin_viewmats|too small"),
        (header_with(background=[0, 1]), "unpack"),
        (lambda header: header.pop("origin"), "the part origin_viewmats is not known"),
        (lambda header: header.pop("num"), "damaged"),
    ],
)  # fmt: skip
def test_headers_that_lie_are_refused(tmp_path, change, match):
    header, body = compact._unframed(whole())
    change(header)
    refused(tmp_path, sealed(header, body), match)


def test_headers_that_are_no_headers_are_refused(tmp_path):
    def framed(text: bytes, num_text: int | None = None, coded: bytes | None = None) -> bytes:
        coded = zstandard.compress(text) if coded is None else coded
        num_text = len(text) if num_text is None else num_text
        return HEAD.pack(compact.MAGIC, 1, len(coded), num_text, zlib.crc32(coded)) + coded

    refused(tmp_path, framed(b"[1, 2]"), "has no header")
    refused(tmp_path, framed(b"{"))
    refused(tmp_path, framed(b"[" * 100_000))
    refused(tmp_path, framed(b"\xff\xfe{}"))
    refused(tmp_path, framed(b"{}"), "damaged")
    refused(tmp_path, framed(json.dumps({"num": math.nan}).encode()))
    refused(tmp_path, framed(b"{}", num_text=3), "frame is of 2 bytes")
    refused(tmp_path, framed(b"{}", num_text=2**32 - 1), "announces a header")
    refused(tmp_path, HEAD.pack(compact.MAGIC, 1, 2**31, 5, zlib.crc32(b"")), "announces a header")
    refused(
        tmp_path, HEAD.pack(compact.MAGIC, 3, 0, 0, zlib.crc32(b"")), "version 3; this program reads versions 1 and 2"
    )


@pytest.mark.parametrize("coder", CODERS)
def test_bombs_are_refused_before_they_unpack(coder):
    """Millions of zeros where 1000 bytes should be."""
    bomb = encode(coder, np.zeros((3, 10**6 if coder == "webp" else 10**7), np.uint8))
    tracemalloc.start()
    try:
        with pytest.raises(ValueError, match=coder if coder != "none" else "1000 were announced"):
            decode(coder, bomb, 1, 1000)
        assert tracemalloc.get_traced_memory()[1] < 2e6
    finally:
        tracemalloc.stop()


def test_a_file_of_many_rows_and_few_bytes_is_refused(tmp_path):
    """Zeros code well: a small file of 20 million splats is what a bomb looks like."""
    header, _ = compact._unframed(encode_model(plain(1), CompactChoices(coder="zstd")))
    num = 10**7
    means = encode("zstd", np.zeros((6, num), np.uint8))
    header |= {"num": num, "lengths": {"means": len(means)}, "coders": {"means": "zstd"}}
    refused(tmp_path, sealed(header, means), "too small")


# Parts


@pytest.mark.parametrize("bits", [1, 5, 8, 12, 16])
def test_laws_of_quantisation(bits):
    rng = np.random.default_rng(bits)
    codes = rng.integers(0, 1 << bits, (3, 100))
    np.testing.assert_array_equal(from_planes(to_planes(codes, bits), 3), codes)
    np.testing.assert_array_equal(with_green(with_green(codes, bits, -1), bits), codes)
    np.testing.assert_array_equal(from_morton(morton(codes, bits), bits), codes)
    ends = Ends(-2.0, 3.0)
    np.testing.assert_array_equal(quantised(dequantised(codes, ends, bits), ends, bits), codes)
    turned, _ = nearest_half_turn(rng.normal(size=(100, 4)))
    np.testing.assert_allclose(with_w(turned[:, 1:].T), turned, atol=1e-12)
    assert np.all(turned[:, 0] >= np.abs(turned).max(axis=1) - 1e-12)


@pytest.mark.parametrize("dtype", ["f2", "f4", "f8", "i4"])
def test_bytes_of_numbers_come_back(dtype):
    values = np.random.default_rng(0).normal(size=(3, 20)).astype(dtype)
    np.testing.assert_array_equal(from_byte_planes(to_byte_planes(values), 3, np.dtype(dtype)), values)


def test_a_reader_reads_all_or_nothing():
    writer = ColumnWriter("zstd")
    writer.numbers("a", np.eye(3), 8)
    writer.numbers("b", np.eye(3), 8)
    reader = ColumnReader(writer.body, writer.layout, 1000)
    with pytest.raises(ValueError, match="the part b is missing"):
        reader.numbers("b", 3, 3, 8)
    reader.numbers("a", 3, 3, 8)
    with pytest.raises(ValueError, match="the part b is not known"):
        reader.end()
    with pytest.raises(ValueError, match="its parts must have"):
        ColumnReader(writer.body[:-1], writer.layout, 1000)
    with pytest.raises(ValueError, match="would take 9 bytes"):
        ColumnReader(writer.body, writer.layout, 8).numbers("a", 3, 3, 8)


def test_fewer_bits_take_fewer_bytes():
    sizes = [
        len(encode_model(banded(0, textured()), CompactChoices().keeping(dict.fromkeys(GROUPS, b)))) for b in (4, 8, 12)
    ]
    assert sizes == sorted(sizes) and 2 * sizes[0] < textured().num_bytes


def test_ply_is_as_it_was(tmp_path):
    model = plain()
    save_ply(tmp_path / "a.ply", model)
    save_ply(tmp_path / "b.ply", decode_model(encode_model(model, EXACT)))
    a, b = (load_ply(tmp_path / name) for name in ("a.ply", "b.ply"))
    order = cKDTree(np.asarray(a.means)).query(np.asarray(b.means))[1]
    np.testing.assert_allclose(b.sh, np.asarray(a.sh)[order], atol=1e-6)
