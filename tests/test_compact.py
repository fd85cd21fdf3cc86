"""Compact scene files, on disk and for browsers: what comes back is within half a step and shows the same, the most
visible rows come first in a page, and no damaged file does harm."""

import dataclasses
import functools
import json
import math
import tracemalloc
import zlib

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes_random import as_camera, as_gaussians, draw_scene
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from small_files import (
    EXACT,
    GROUPS,
    HEAD,
    MAGIC,
    compact_bytes,
    model_in,
    put_together,
    taken_apart,
    with_header_text,
)
from small_models import assert_same_rule, billboards, movable_kernels, with_bands
from small_values import rotations, some_gaussians

from a2tg_jax import (
    Appearance,
    Bands,
    Camera,
    CompactChoices,
    Exponents,
    Gaussians,
    Model,
    Origin,
    RenderSettings,
    Texture,
    TextureOptions,
    allocate_appearance,
    concatenate,
    load_compact,
    save_compact,
    textures_from_arrays,
)
from a2tg_jax.io.columns import decode, encode
from a2tg_jax.io.web_scene import encode_web_scene, importance

CODERS = ("lzma", "zstd", "deflate", "none", "webp")
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
    gaussians = dataclasses.replace(inner.gaussians, sh=inner.gaussians.sh[:, :num_bases])
    return with_bands(some_model(gaussians, inner.appearance), inner.gaussians.sh[:, num_bases:], degrees)


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
FAST = "banded, shaped and textured"
every_model = pytest.mark.parametrize(
    "name", [name if name == FAST else pytest.param(name, marks=pytest.mark.long) for name in MODELS]
)


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
    if model.appearance.shapes is not None:
        found["shapes"] = np.tanh(np.asarray(model.appearance.shapes, np.float64)[order])
    if model.appearance.bands is not None:
        found["degrees"] = model.degrees[order]
    if model.textures is not None:
        sizes = model.textures.sizes
        found["sizes"] = sizes[order]
        pieces = np.split(model.textures.flat(), np.cumsum(np.prod(sizes, axis=1))[:-1])
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
    assert_same_rule(found, model)
    assert found.background == model.background and found.origin == model.origin
    assert found.num_bytes == model.num_bytes and found.num == model.num
    order = order_of(model, found)
    for group, values in tables(found).items():
        wanted = tables(model, order)[group]
        np.testing.assert_allclose(values, wanted, rtol=0, atol=1e-6 if group == "texels" else 0)
    got, wanted = (rotations(quats)[:, :, 2] for quats in (found.gaussians.quats, model.gaussians.quats[order]))
    np.testing.assert_allclose(np.abs(got), np.abs(wanted), atol=2e-6)


@pytest.mark.parametrize(
    "name",
    [*(pytest.param(name, marks=pytest.mark.long) for name in ("plain 16", "textured or not")), FAST],
)
def test_what_comes_back_looks_the_same(name):
    """Mirrored textures and half-turned splats included; from files on disk and of several chunks for browsers."""
    model = MODELS[name]()
    camera = model.origin.cameras[0]
    image = np.asarray(model.render(camera, settings=SETTINGS).color)
    assert np.std(image) > 0.02
    fine = CompactChoices().keeping(dict.fromkeys(GROUPS, 12))
    files = {1e-4: compact_bytes(model, EXACT), 0.02: compact_bytes(model, fine), 0.25: encode_web_scene(model)}
    for tolerance, data in files.items():
        again = model_in(data)
        assert set(tables(again)) == set(tables(model))
        difference = np.abs(image - np.asarray(again.render(camera, settings=SETTINGS).color))
        assert np.quantile(difference, 0.99) < tolerance and difference.mean() < max(tolerance / 7, 1e-4)


@pytest.mark.parametrize("coder", ["smallest", *CODERS])
def test_coders_do_not_change_what_comes_back(coder):
    model = banded(0, textured(True))
    data = compact_bytes(model, CompactChoices(coder=coder))
    wanted = model_in(compact_bytes(model, CompactChoices(coder="none")))
    found = model_in(data)
    assert len(compact_bytes(model)) < len(data) or coder == "smallest"
    assert jax.tree.structure(found) == jax.tree.structure(wanted)
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(wanted), strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("precision", [3, 8, 11, 16, "float16"])
def test_errors_are_half_a_step_at_most(precision):
    model = banded(0, shaped(plain()))
    for group in ("log_scales", "opacities", "sh_0", "sh_rest", "shapes"):
        found = model_in(compact_bytes(model, EXACT.keeping({group: precision})))
        order = order_of(model, found)
        wanted = tables(model, order)
        values = tables(found)
        assert np.abs(values[group] - wanted[group]).max() <= half_step(wanted[group], precision)
        for other in set(wanted) - {group}:
            np.testing.assert_array_equal(values[other], wanted[other])


def test_errors_of_files_for_browsers_are_half_a_step_at_most():
    model = banded(0, shaped(textured(True)))
    found = model_in(encode_web_scene(model))
    wanted = tables(model, order_of(model, found))
    values = tables(found)
    for group in ("log_scales", "opacities", "sh_0", "sh_rest", "shapes"):
        assert np.abs(values[group] - wanted[group]).max() <= half_step(wanted[group], 6 if group == "sh_rest" else 8)
    for exact in ("degrees", "sizes"):
        np.testing.assert_array_equal(values[exact], wanted[exact])
    np.testing.assert_allclose(values["means"], wanted["means"], atol=1e-3)
    assert found.origin == model.origin and found.background == model.background


def half_step(values: np.ndarray, precision) -> float:
    """The largest error; of float16 relative to numbers that lie within a few units of 0."""
    if precision == "float16":
        return float(np.abs(values).max()) * 2**-10
    return float(np.ptp(values)) / (2**precision - 2) / 2 * 1.001 + 1e-6


@pytest.mark.parametrize("bits", [4, 8, 12, 16])
def test_rotations_are_within_the_diagonal_of_a_step(bits):
    model = plain()
    found = model_in(compact_bytes(model, EXACT.keeping({"quats": bits})))
    order = order_of(model, found)
    rotations = Rotation.from_quat(np.asarray(model.gaussians.quats)[order], scalar_first=True)
    turns = Rotation.from_rotvec(np.pi * np.eye(4, 3, -1))
    turned = np.stack([(rotations * turn).as_quat(canonical=True, scalar_first=True) for turn in turns])
    axis = np.argmax(turned[:, :, 0], axis=0)
    quats = turned[axis, np.arange(NUM)]
    wanted = quats[:, 1:]
    step = np.ptp(quats[:, 1:]) / (2**bits - 2)
    # w follows from the others, which change it by three times as much at most: it is no smaller than they are.
    assert np.abs(np.asarray(found.gaussians.quats)[:, 1:] - wanted).max() <= 2 * step + 1e-6
    assert np.linalg.norm(np.asarray(found.gaussians.quats) - quats, axis=1).max() <= 3 * step + 1e-6
    assert set(axis) == {0, 1, 2, 3}


@pytest.mark.parametrize("bits", [6, 10, 14, 16])
def test_means_are_within_a_step_that_grows_with_the_distance(bits):
    means = np.random.default_rng(0).standard_t(2, size=(3, 400)).astype(np.float32) * 5
    gaussians = dataclasses.replace(some_gaussians(400), means=jnp.asarray(means.T), logit_opacities=jnp.arange(400.0))
    decoded = model_in(compact_bytes(Model(gaussians), EXACT.keeping({"means": bits}))).gaussians
    found = np.asarray(decoded.means).T
    order = np.asarray(decoded.logit_opacities).astype(int)
    for axis, values in zip(means[:, order], found, strict=True):
        center = np.median(axis)
        spread = np.quantile(np.abs(axis - center), 0.75)
        places = np.arcsinh((axis - center) / spread)
        step = np.ptp(places) / (2**bits - 2)
        # The derivative of sinh, at the end of half a step.
        slope = np.cosh(np.abs(places) + step / 2)
        assert np.all(np.abs(values - axis) <= spread * slope * step / 2 * 1.001 + 1e-5 * np.abs(axis))


@pytest.mark.parametrize("precision", [2, 8, 13, "float16", "float32"])
def test_texels_keep_their_places(precision):
    """Splats whose rotations need no half-turn, so that nothing is mirrored."""
    gaussians = dataclasses.replace(some_gaussians(5), quats=jnp.tile(jnp.asarray([1.0, 0.1, 0.0, 0.0]), (5, 1)))
    rng = np.random.default_rng(0)
    arrays = [rng.normal(size=(*size, 4)).astype(np.float32) for size in ((1, 1), (2, 3), (0, 0), (4, 1), (2, 3))]
    model = Model(gaussians, Appearance(texture=Texture(textures_from_arrays(arrays))))
    found = model_in(compact_bytes(model, CompactChoices(texels=precision)))
    order = order_of(model, found)
    wanted = np.concatenate([arrays[row].reshape(-1, 4) for row in order])
    texels = found.textures.flat()
    for columns in (slice(0, 3), slice(3, 4)):
        error = np.abs(texels[:, columns] - wanted[:, columns]).max()
        assert error <= (0 if precision == "float32" else half_step(wanted[:, columns], precision))


@pytest.mark.parametrize("name", ["plain 1", "banded, shaped and textured"])
@pytest.mark.parametrize("encode_it", [compact_bytes, lambda model: compact_bytes(model, EXACT), encode_web_scene])
def test_a_model_of_no_gaussians(name, encode_it):
    model = dataclasses.replace(MODELS[name](), num_live=jnp.asarray(0, jnp.int32))
    found = model_in(encode_it(model))
    if encode_it is encode_web_scene:
        assert found.num == 0 and found.origin == model.origin
        return
    assert found.num == 0
    assert_same_rule(found, model)
    assert found.background == model.background and found.origin == model.origin
    assert found.gaussians.sh.shape == (0, *model.gaussians.sh.shape[1:])


def test_only_rows_that_exist_are_kept():
    model = dataclasses.replace(textured(), num_live=jnp.asarray(7, jnp.int32))
    found = model_in(compact_bytes(model))
    assert found.num == 7 and found.num_bytes == model.num_bytes


@pytest.mark.long
@pytest.mark.parametrize("encode_it", [compact_bytes, encode_web_scene])
def test_splats_that_are_all_alike_take_more_room_than_they_need_and_come_back(encode_it):
    """The file of so few bytes would be refused as a bomb: it is written without a coder."""
    one = plain(1).gaussians[:1]
    model = Model(jax.tree.map(lambda x: jnp.repeat(x, 300_000, axis=0), one))
    data = encode_it(model)
    assert {coder for _, coder, _ in taken_apart(data)[0]["parts"]} == {"none"}
    found = model_in(data)
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
    found = model_in(compact_bytes(Model(gaussians), CompactChoices(means=16)))
    largest = int(np.argmax(np.asarray(found.gaussians.means)[:, 0]))
    np.testing.assert_allclose(found.gaussians.means[largest], [1e11, -1e11, 9e11], rtol=2e-3)
    assert np.asarray(found.gaussians.opacities).min() < 1e-6 and np.asarray(found.gaussians.opacities).max() > 1 - 1e-6


@pytest.mark.parametrize("bits", [1, 2, 5, 8])
def test_shapes_of_any_precision_are_finite(bits):
    """The ends of the range included, which even steps may move outwards."""
    model = shaped(plain(1))
    shapes = jnp.asarray(np.resize([-30.0, 30.0, 0.0, 0.3], NUM), jnp.float32)
    model = dataclasses.replace(model, appearance=model.appearance.with_shapes(shapes))
    found = model_in(compact_bytes(model, CompactChoices(shapes=bits)))
    wanted = tables(model, order_of(model, found))["shapes"]
    values = tables(found)["shapes"]
    assert np.abs(values - wanted).max() <= {1: 1.0, 2: 0.5}.get(bits, half_step(wanted, max(bits, 2))) + 1e-6


# What is refused


@pytest.mark.parametrize(("encode_it", "file"), [(compact_bytes, "compact file"), (encode_web_scene, "for browsers")])
def test_models_that_a_file_cannot_hold_are_refused(encode_it, file):
    gaussians = some_gaussians()
    templates = {"MovableKernels with bands": movable_kernels(bands=Bands()), "Billboards": billboards()}
    for words, template in templates.items():
        appearance = allocate_appearance(template, jax.random.key(0), gaussians)
        with pytest.raises(ValueError, match=f"has {words}: a .*{file} holds .*save_model"):
            encode_it(Model(gaussians, appearance))
    for field in dataclasses.fields(Gaussians):
        name = field.name
        spoiled = dataclasses.replace(gaussians, **{name: getattr(gaussians, name).at[3].set(jnp.nan)})
        with pytest.raises(ValueError, match=rf"{name}\S* must be finite"):
            encode_it(Model(spoiled))


def test_what_float16_cannot_hold_is_refused():
    model = Model(dataclasses.replace(some_gaussians(), sh=1e6 * some_gaussians().sh))
    with pytest.raises(ValueError, match="sh_1 must be finite as float16"):
        compact_bytes(model, CompactChoices(sh_rest="float16"))


@pytest.mark.parametrize(
    ("choice", "value"),
    [("means", 0), ("means", 17), ("quats", True), ("texels", 2.5), ("sh_0", "float64"), ("coder", "zip")],
)
def test_choices_that_cannot_be_are_refused(choice, value):
    with pytest.raises(ValueError, match=rf"choices\.{choice} must be"):
        compact_bytes(plain(1), dataclasses.replace(CompactChoices(), **{choice: value}))


def test_missing_file(tmp_path):
    with pytest.raises(FileNotFoundError, match="nowhere"):
        load_compact(tmp_path / "nowhere.a2tgz")


# Damage, and malice


@functools.cache
def whole() -> bytes:
    return compact_bytes(banded(0, shaped(textured(True))))


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


@pytest.mark.parametrize(
    "coder", [coder if coder == "deflate" else pytest.param(coder, marks=pytest.mark.long) for coder in CODERS]
)
def test_changed_bytes_under_a_right_checksum_do_no_harm(coder):
    """A model of other numbers, or a ValueError; nothing else."""
    data = compact_bytes(banded(0, textured(True)), CompactChoices(coder=coder))
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
            model_in(HEAD.pack(*fields) + bytes(rest))
        except ValueError as error:
            num_refused += 1
            assert "scene.a2tgz" in str(error)
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
    return lambda header: header.update(sizes=[size] * len(header["sizes"]))


def part(name, place, value):
    """Change name, coder or length of a part."""

    def change(header):
        next(found for found in header["parts"] if found[0] == name)[place] = value

    return change


@pytest.mark.parametrize(
    ("change", "match"),
    [
        (header_with(num=2**60, chunk=2**60), "means would take .* the file is too small"),
        (header_with(num=2**60), "the part means is missing"),
        (header_with(num=10**400), "a number of 401 digits is too large"),
        (header_with(num=-1), "num must be an int, at least 0"),
        (header_with(num=True), "num must be an int"),
        (header_with(num=50.0), "num must be an int"),
        (header_with(num=49), "the part means"),
        (header_with(num=0), "the part means holds bytes where there should be none"),
        (header_with(chunk=0), "chunk must be an int, at least 1"),
        (header_with(chunk="all"), "chunk must be an int, at least 1"),
        (header_with(chunk=25), "the part means"),
        (header_with(base_degree=4), "base_degree must be an int, 0 to 3"),
        (header_with(base_degree=3), "degrees must be in 3..3"),
        (header_with(degrees=[0, 1, 2, 7]), "degrees must be in 0..3"),
        (header_with(degrees=[]), "degrees refer to an empty table"),
        (header_with(degrees=[0, 3]), "must be below 2|the part degrees"),
        (header_with(degrees="0123"), "degrees must be"),
        (sizes_of(16, 16), "the part texel_colors"),
        (sizes_of(10**9, 10**9), "height of a texture must be an int, 0 to 16"),
        (sizes_of(0, 5), "the part texel_colors holds bytes where there should be none"),
        (sizes_of(1, 1, 1), "unpack"),
        (header_with(sizes=None), "damaged"),
        (header_with(parts=[]), "its parts must have"),
        (header_with(parts=[1, 2]), "damaged"),
        (header_with(parts=7), "damaged"),
        (part("means", 2, -4), "its parts must have"),
        (part("means", 2, 2**70), "its parts must have"),
        (part("means", 2, "many"), "its parts must have"),
        (part("shapes", 2, 3), "its parts must have"),
        (part("quats", 0, "wings"), "the part quats is missing"),
        (part("quats", 0, ["wings"]), "damaged"),
        (part("quats", 1, "pickle"), "the part quats has the unknown coder pickle"),
        (part("quats", 1, ["lzma"]), "unknown coder"),
        (part("means", 1, "none"), "the part means"),
        (header_with(ends__means=[0.0]), "the ends of means must be 12 finite numbers"),
        (header_with(ends__means=[1e30] * 12), "means|the part"),
        (header_with(ends__means=[0.0, 1e38, -1e3, 1e3] * 3), "means must be finite"),
        (header_with(ends__sh_1=[-1e39, 1e39]), "the ends of sh_1 must be 2 finite numbers"),
        (header_with(ends__sh_1=["a", "b"]), "the ends of sh_1 must be 2 finite numbers"),
        (header_with(ends__sh_1=[0.5, 0.5]), "the part sh_1 holds bytes where there should be none"),
        (header_with(ends__shapes=[-1.6, 1.6]), "exponents of kernels must be within"),
        (header_with(ends__shapes=[1e30, 1e31]), "exponents of kernels must be within"),
        (header_with(ends__shapes=[0.0, "NaN"]), "the ends of shapes must be 2 finite numbers"),
        (header_with(choices__shapes=16), "the part shapes"),
        (header_with(choices__shapes="float32"), "the part shapes"),
        (header_with(ends={}), "damaged"),
        (header_with(choices__means=40), r"choices\.means must be"),
        (header_with(choices__coder="pickle"), r"choices\.coder must be"),
        (header_with(choices__texels="float64"), r"choices\.texels must be"),
        (header_with(choices=7), "choices must hold"),
        (header_with(appearance__name="Billboards"), "Billboards|options"),
        (header_with(appearance__module="os", appearance__name="system"), "which is unknown"),
        (header_with(appearance__parts__texture__start=7), "options of Texture"),
        (header_with(appearance__parts={}), "degrees must be in 0..0"),
        (lambda header: header["appearance"]["parts"].pop("exponents"), "the part shapes is unknown"),
        (header_with(appearance__parts={"wings": {}}), "damaged"),
        (header_with(appearance=None), "damaged"),
        (header_with(origin__names=["x"] * 1000), "the part origin_viewmats|too small"),
        (header_with(background=[0, 1]), "unpack"),
        (lambda header: header.pop("origin"), "the part origin_viewmats is unknown"),
        (lambda header: header.pop("num"), "damaged"),
    ],
)  # fmt: skip
def test_headers_that_lie_are_refused(tmp_path, change, match):
    header, body = taken_apart(whole())
    change(header)
    refused(tmp_path, put_together(header, body), match)


def test_headers_that_are_no_headers_are_refused(tmp_path):
    refused(tmp_path, with_header_text(b"[1, 2]"), "has no header")
    for text in (b"{", b"[" * 100_000, b"\xff\xfe{}", json.dumps({"num": math.nan}).encode()):
        refused(tmp_path, with_header_text(text))
    refused(tmp_path, with_header_text(b"{}"), "damaged")
    refused(tmp_path, with_header_text(b"{}", num_text=3), "holds 2 bytes; 3 were announced")
    refused(tmp_path, with_header_text(b"{}", num_text=2**32 - 1), "announces a header")
    refused(tmp_path, HEAD.pack(MAGIC, 3, 2**31, 5, zlib.crc32(b"")), "announces a header")
    refused(tmp_path, HEAD.pack(MAGIC, 4, 0, 0, zlib.crc32(b"")), "version 4; this program reads versions 1 to 3")
    refused(tmp_path, HEAD.pack(MAGIC, 2, 0, 0, zlib.crc32(b"")))


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
    header, _ = taken_apart(compact_bytes(plain(1), CompactChoices(coder="zstd")))
    num = 10**7
    means = encode("zstd", np.zeros((6, num), np.uint8))
    header |= {"num": num, "chunk": num, "parts": [("means", "zstd", len(means))]}
    refused(tmp_path, put_together(header, means), "too small")


def test_fewer_bits_take_fewer_bytes():
    model = banded(0, textured())
    choices = (CompactChoices(**dict.fromkeys(GROUPS, bits)) for bits in (4, 8, 12))
    sizes = [len(compact_bytes(model, each)) for each in choices]
    assert sizes == sorted(sizes) and 2 * sizes[0] < textured().num_bytes


# For browsers


def test_the_viewer_opens_at_a_central_training_camera():
    """The fourth of five cameras in a row, of which the third is a test view."""
    viewmats = np.stack([np.eye(4)] * 5)
    viewmats[:, 0, 3], viewmats[:, 2, 3] = [3.0, 2.0, 0.0, -0.5, -3.0], 4.0
    cameras = [Camera(viewmat, np.diag([60.0, 60.0, 1.0]), 64, 48) for viewmat in viewmats]
    model = dataclasses.replace(plain(1), origin=Origin.of_cameras(cameras, is_test=[False, False, True, False, False]))
    header, _ = taken_apart(encode_web_scene(model, title="a", note="b", near_plane=0.1))
    assert header["page"].pop("subject").startswith("no subject: the cameras look in parallel")
    assert header["page"] == {"title": "a", "note": "b", "near_plane": 0.1, "first": 3}
    header, _ = taken_apart(encode_web_scene(dataclasses.replace(model, origin=None)))
    assert "first" not in header["page"] and "origin" not in header


@pytest.mark.long
def test_textures_are_kept_as_they_are_seen():
    """The authors' conventions clip residuals and divide alpha: the file holds what is left, and says where to look."""
    options = TextureOptions.official()
    base = textured()
    texture = dataclasses.replace(base.appearance.texture, options=options)
    model = dataclasses.replace(base, appearance=dataclasses.replace(base.appearance, texture=texture))
    found = model_in(encode_web_scene(model))
    assert found.appearance.texture_options == dataclasses.replace(options, rgb="signed", alpha="projected")
    shown = dataclasses.replace(texture, texels=texture.shown())
    model = dataclasses.replace(model, appearance=dataclasses.replace(model.appearance, texture=shown))
    wanted = tables(model, order_of(model, found))["texels"]
    texels = found.textures.flat()
    np.testing.assert_allclose(tables(found)["texels"], wanted, atol=half_step(texels, 8))
    assert texels.min() >= 0 and texels[:, 3].max() <= 1 + 1e-6


def test_chunks_that_show_most_come_first():
    model = concatenate([dataclasses.replace(plain(1), origin=None)] * 20)
    scales = jnp.asarray(np.random.default_rng(0).normal(size=(model.num, 2)), jnp.float32)
    model = dataclasses.replace(model, gaussians=dataclasses.replace(model.gaussians, log_scales=scales))
    data = encode_web_scene(model)
    chunk = taken_apart(data)[0]["chunk"]
    weights = importance(model_in(data))
    first, *rest = (weights[start : start + chunk] for start in range(0, model.num, chunk))
    assert len(rest) == 3 and first.min() > 0.9 * rest[0].max() > 0.9 * rest[1].max() > 0
    assert {coder for _, coder, _ in taken_apart(encode_web_scene(model, coder="none"))[0]["parts"]} == {"none"}


def test_what_is_nearer_to_the_cameras_shows_more():
    gaussians = jax.tree.map(lambda x: jnp.repeat(x[:1], 2, axis=0), some_gaussians())
    origin = plain().origin
    center = -origin.viewmats[0, :3, :3].T @ origin.viewmats[0, :3, 3]
    means = np.stack([center + np.array([0, 0, z]) for z in (30.0, 3.0)])
    model = Model(dataclasses.replace(gaussians, means=jnp.asarray(means, jnp.float32)), origin=origin)
    near, far = importance(model)[::-1]
    assert near > 50 * far


@pytest.mark.parametrize("name", [pytest.param("plain 4", marks=pytest.mark.long), FAST])
def test_the_reference_reader_finds_the_numbers(reference, tmp_path, name):
    """In several chunks; it shares no code."""
    model = MODELS[name]()
    model = concatenate([model] * 40) if model.textures is None else model
    (tmp_path / "a.a2tgz").write_bytes(encode_web_scene(model))
    found = reference[0](tmp_path / "a.a2tgz")
    wanted = load_compact(tmp_path / "a.a2tgz")
    assert len(found["means"]) == wanted.num
    np.testing.assert_allclose(found["means"], wanted.gaussians.means, rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(found["sh"][:, : wanted.sh.shape[1]], wanted.sh, atol=1e-5)
    np.testing.assert_allclose(found["opacities"], wanted.gaussians.opacities, atol=1e-5)
    if wanted.textures is not None:
        np.testing.assert_array_equal(found["sizes"], wanted.textures.sizes)
        np.testing.assert_allclose(found["texels"], wanted.textures.flat(), atol=1e-5)
