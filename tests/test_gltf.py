"""glTF of splats: what a model shows comes back, the specification's names hold, and no damaged file does harm."""

import base64
import dataclasses
import json
import struct
import tracemalloc
import typing
from pathlib import Path

import jax
import numpy as np
import pytest
from small_models import assert_same_rule, movable_kernels, rule_of
from small_values import matrix_of, rotations, some_gaussians, some_world
from test_compact import MODELS, every_model, plain, shaped, textured

import a2tg_jax as a2tg
from a2tg_jax import Exponents, Model, Origin, Similarity, TextureOptions, allocate_appearance, load_gltf, save_gltf
from a2tg_jax.io import gltf, other_programs
from a2tg_jax.io.gltf_container import Document
from a2tg_jax.io.other_programs import joined_parts, upright

SPLATS = "KHR_gaussian_splatting"
EXTENSION = "A2TG_splat_textures"


def parts_of(path):
    """The JSON and the binary chunk of a *.glb."""
    data = path.read_bytes()
    length = struct.unpack_from("<I", data, 12)[0]
    return json.loads(data[20 : 20 + length]), data[28 + length :]


def write_parts(path, described, binary):
    text = json.dumps(described).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<II", len(text), 0x4E4F534A) + text + struct.pack("<II", len(binary), 0x004E4942) + binary
    path.write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks)


def rewritten(path, model, change):
    """A file of a model whose JSON went through a function."""
    save_gltf(path, model)
    described, binary = parts_of(path)
    change(described)
    write_parts(path, described, binary)


def attribute(described, binary, name):
    """An attribute of floats, as a reader of its own takes it from the file."""
    accessor = described["accessors"][described["meshes"][0]["primitives"][0]["attributes"][name]]
    view = described["bufferViews"][accessor["bufferView"]]
    columns = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[accessor["type"]]
    values = np.frombuffer(binary, "<f4", accessor["count"] * columns, view["byteOffset"])
    return values.reshape(-1, columns)


def unit(quats):
    return np.asarray(quats) / np.linalg.norm(quats, axis=1, keepdims=True)


def assert_shows_the_same(found, model):
    for name, atol in (("means", 0), ("log_scales", 1e-5), ("logit_opacities", 1e-3)):
        wanted = np.asarray(getattr(model.gaussians, name))
        np.testing.assert_allclose(np.asarray(getattr(found.gaussians, name)), wanted, atol=atol, rtol=0)
    np.testing.assert_allclose(found.gaussians.quats, unit(model.gaussians.quats), atol=1e-6)
    np.testing.assert_array_equal(found.sh, model.sh)


# What comes back


@every_model
def test_models_come_back(tmp_path, name):
    model = MODELS[name]()
    path = tmp_path / ("a b.gltf" if name == "textured" else "m.glb")
    save_gltf(path, model)
    found = load_gltf(path)
    assert_shows_the_same(found, model)
    assert_same_rule(found, model)
    assert found.origin == model.origin
    assert found.num_bytes == model.num_bytes
    for x, y in zip(jax.tree.leaves(found.textures), jax.tree.leaves(model.textures), strict=True):
        np.testing.assert_array_equal(x, y)
    shapes = found.appearance.shapes
    wanted = model.appearance.shapes
    assert (shapes is None) == (wanted is None)
    if shapes is not None:
        np.testing.assert_allclose(np.tanh(shapes), np.tanh(wanted), atol=1e-6)


def test_an_upper_limit_of_alpha_beside_textures_comes_back(tmp_path):
    model = textured()
    model = dataclasses.replace(model, appearance=dataclasses.replace(model.appearance, max_alpha=0.5))
    save_gltf(tmp_path / "m.glb", model)
    assert extension_of(parts_of(tmp_path / "m.glb")[0])["maxAlpha"] == 0.5
    assert_same_rule(load_gltf(tmp_path / "m.glb"), model)


@pytest.mark.parametrize("options", [TextureOptions(), TextureOptions.official()])
def test_textures_in_bytes_come_back_within_half_a_step(tmp_path, options):
    model = textured()
    texture = dataclasses.replace(model.appearance.texture, options=options)
    model = dataclasses.replace(model, appearance=dataclasses.replace(model.appearance, texture=texture))
    save_gltf(tmp_path / "m.glb", model, texels="uint8")
    found = load_gltf(tmp_path / "m.glb")
    assert_same_rule(found, model)
    values = found.textures.flat()
    wanted = model.textures.flat()
    for columns in (slice(0, 3), slice(3, 4)):
        step = np.ptp(wanted[:, columns]) / 254
        assert 0 < np.abs(values - wanted)[:, columns].max() <= step / 2 * 1.001
    save_gltf(tmp_path / "exact.glb", model)
    num_texels = len(wanted)
    saved = (tmp_path / "exact.glb").stat().st_size - (tmp_path / "m.glb").stat().st_size
    assert saved > 0.9 * 12 * num_texels - 200


def test_programs_that_know_no_textures_see_plain_splats(tmp_path):
    """Without the extension the file holds what `save_ply` holds."""
    path = tmp_path / "m.glb"
    model = textured()
    save_gltf(path, model)
    described, binary = parts_of(path)
    assert EXTENSION in described["extensionsUsed"] and "extensionsRequired" not in described
    del described["meshes"][0]["primitives"][0]["extensions"][SPLATS]["extensions"]
    write_parts(path, described, binary)
    found = load_gltf(path)
    assert found.textures is None and found.origin == model.origin
    assert_shows_the_same(found, model)


def test_what_the_extension_cannot_hold_is_refused_or_left_out(tmp_path):
    gaussians = some_gaussians()
    template = movable_kernels(exponents=Exponents())
    model = Model(gaussians, allocate_appearance(template, jax.random.key(0), gaussians))
    with pytest.raises(ValueError, match=r"has MovableKernels with .*: a glTF file holds .*textures=False here"):
        save_gltf(tmp_path / "m.glb", model)
    save_gltf(tmp_path / "m.glb", model, textures=False)
    a2tg.save_ply(tmp_path / "m.ply", model)
    wanted = a2tg.load_ply(tmp_path / "m.ply")
    np.testing.assert_allclose(
        load_gltf(tmp_path / "m.glb").gaussians.logit_opacities, wanted.logit_opacities, atol=1e-4
    )
    with pytest.raises(ValueError, match="at least one"):
        save_gltf(tmp_path / "n.glb", plain()[:0])
    with pytest.raises(ValueError, match="texels must be one of float32, uint8; got 'float16'"):
        save_gltf(tmp_path / "n.glb", textured(), texels="float16")
    with pytest.raises(ValueError, match="save_gltf writes"):
        save_gltf(tmp_path / "n.ply", textured())
    assert not (tmp_path / "n.glb").exists()


def test_long_names_of_other_scripts_come_back(tmp_path):
    """Percent-encoded, the name of the buffer has three times as many bytes as on disk."""
    path = tmp_path / f"{'場' * 70}.gltf"
    save_gltf(path, plain())
    assert_shows_the_same(load_gltf(path), plain())


# The specification


def test_attributes_are_those_of_the_specification(tmp_path):
    """Activated numbers, quaternions xyzw, covariance M·C·Cᵀ·Mᵀ, coefficients by degree and order."""
    model = plain(16)
    path = tmp_path / "m.glb"
    save_gltf(path, model)
    described, binary = parts_of(path)
    primitive = described["meshes"][0]["primitives"][0]
    assert primitive["mode"] == 0 and described["extensionsUsed"] == [SPLATS]
    assert primitive["extensions"][SPLATS] == {
        "kernel": "ellipse", "colorSpace": "srgb_rec709_display", "projection": "perspective",
        "sortingMethod": "cameraDistance",
    }  # fmt: skip
    means = attribute(described, binary, "POSITION")
    opacities = attribute(described, binary, f"{SPLATS}:OPACITY")
    scales = attribute(described, binary, f"{SPLATS}:SCALE")
    quats = attribute(described, binary, f"{SPLATS}:ROTATION")
    accessor = described["accessors"][primitive["attributes"]["POSITION"]]
    np.testing.assert_array_equal([accessor["min"], accessor["max"]], [means.min(axis=0), means.max(axis=0)])
    np.testing.assert_allclose(np.linalg.norm(quats, axis=1), 1, atol=1e-6)
    np.testing.assert_allclose(opacities[:, 0], model.gaussians.opacities, rtol=1e-5)
    np.testing.assert_allclose(scales[:, :2], model.gaussians.scales, rtol=1e-5)
    np.testing.assert_allclose(scales[:, 2], scales[:, :2].min(axis=1) / 1000, rtol=1e-5)
    np.testing.assert_allclose(rotations(quats[:, [3, 0, 1, 2]]), rotations(model.gaussians.quats), atol=1e-5)
    sh = np.asarray(model.sh)
    index = 0
    for degree in range(4):
        for order in range(2 * degree + 1):
            values = attribute(described, binary, f"{SPLATS}:SH_DEGREE_{degree}_COEF_{order}")
            np.testing.assert_array_equal(values, sh[:, index])
            index += 1
    assert len(primitive["attributes"]) == 5 + index


def test_coefficients_go_up_to_the_highest_degree_of_a_splat(tmp_path):
    model = MODELS["banded and textured"]()
    low = model[model.degrees < 2]
    save_gltf(tmp_path / "m.glb", low)
    described, _ = parts_of(tmp_path / "m.glb")
    names = described["meshes"][0]["primitives"][0]["attributes"]
    assert f"{SPLATS}:SH_DEGREE_1_COEF_2" in names and f"{SPLATS}:SH_DEGREE_2_COEF_0" not in names
    found = load_gltf(tmp_path / "m.glb")
    assert_shows_the_same(found, low)
    assert found.num_bytes == low.num_bytes


def test_the_node_stands_upright_in_the_lengths_of_the_original_world(tmp_path):
    model = dataclasses.replace(plain(), origin=dataclasses.replace(plain().origin, transform=some_world()))
    save_gltf(tmp_path / "m.glb", model)
    described, _ = parts_of(tmp_path / "m.glb")
    matrix = np.reshape(described["nodes"][0]["matrix"], (4, 4)).T
    scale = some_world().scale
    np.testing.assert_allclose(matrix @ [*model.origin.vertical, 1], [0, 1 / scale, 0, 1], atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(matrix[:3, :3]), scale**-3)
    assert load_gltf(tmp_path / "m.glb").origin == model.origin


# Files of others


def test_a_moved_node_moves_the_model_and_its_cameras(tmp_path):
    model = textured()
    path = tmp_path / "m.glb"
    move = some_world(3)
    save_gltf(path, model)
    described, binary = parts_of(path)
    own = np.reshape(described["nodes"][0]["matrix"], (4, 4)).T
    described["nodes"] = [{"children": [1], "matrix": matrix_of(move).T.ravel().tolist()}, described["nodes"][0]]
    write_parts(path, described, binary)
    found = load_gltf(path)
    wanted = joined_parts([(model, matrix_of(upright(model.origin, "y").then(move)))], "y")
    assert_shows_the_same(found, wanted)
    np.testing.assert_allclose(own, matrix_of(upright(model.origin, "y")))
    assert np.abs(np.asarray(found.gaussians.means) - np.asarray(model.gaussians.means)).max() > 0.1
    np.testing.assert_allclose(found.origin.viewmats, wanted.origin.viewmats, atol=1e-12)


def test_integers_that_stand_for_fractions(tmp_path):
    """Quantised attributes, interleaved in one view, in a node of translation, rotation and scale, and an embedded
    buffer."""
    path = tmp_path / "m.gltf"
    gaussians = some_gaussians(5)
    quats = unit(gaussians.quats)[:, [1, 2, 3, 0]]
    scales = np.exp(np.asarray(gaussians.log_scales))
    dtype = np.dtype([("p", "<f4", 3), ("q", "<i2", 4), ("s", "<u2", 4), ("o", "u1", 4), ("c", "<f4", 3)])
    rows = np.zeros(5, dtype)
    rows["p"], rows["c"] = gaussians.means, gaussians.sh[:, 0]
    rows["q"] = np.rint(quats * 32767)
    rows["s"][:, 1:3] = np.rint(scales / 2 * 65535)
    rows["o"][:, 0] = np.rint(np.asarray(gaussians.opacities) * 255)
    uri = "data:application/octet-stream;base64," + base64.b64encode(rows.tobytes()).decode()

    def accessor(name, code, kind):
        normal = {} if code == 5126 else {"normalized": True}
        return {
            "bufferView": 0, "byteOffset": dtype.fields[name][1], "componentType": code, "count": 5, "type": kind,
        } | normal  # fmt: skip

    names = ["POSITION", *(f"{SPLATS}:{name}" for name in ("ROTATION", "SCALE", "OPACITY", "SH_DEGREE_0_COEF_0"))]
    described = {
        "asset": {"version": "2.0"}, "extensionsUsed": [SPLATS], "buffers": [{"byteLength": rows.nbytes, "uri": uri}],
        "bufferViews": [{"buffer": 0, "byteLength": rows.nbytes, "byteStride": dtype.itemsize}],
        "accessors": [
            accessor("p", 5126, "VEC3"), accessor("q", 5122, "VEC4"), accessor("s", 5123, "VEC3"),
            accessor("o", 5121, "SCALAR"), accessor("c", 5126, "VEC3"),
        ],
        "meshes": [{"primitives": [{
            "attributes": {name: index for index, name in enumerate(names)}, "mode": 0,
            "extensions": {SPLATS: {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}},
        }]}],
        "nodes": [{"mesh": 0, "translation": [1, 2, 3], "rotation": [0, 0, 1, 0], "scale": [2, 2, 2]}],
    }  # fmt: skip
    path.write_text(json.dumps(described))
    found = load_gltf(path)
    turned = np.asarray(gaussians.means) * [-2, -2, 2] + [1, 2, 3]
    np.testing.assert_allclose(found.gaussians.means, turned[:, [0, 2, 1]] * [1, -1, 1], atol=1e-5)
    np.testing.assert_allclose(found.gaussians.opacities, gaussians.opacities, atol=1 / 255)
    # The axis that the file has at 0 is the thinnest, the first: the second and third become u and v.
    np.testing.assert_allclose(found.gaussians.scales, 2 * scales / 2, atol=2 * 2 / 65535)
    first = rotations(quats[:, [3, 0, 1, 2]])[:, :, 0] * [-1, -1, 1]
    normals = rotations(found.gaussians.quats)[:, :, 2]
    np.testing.assert_allclose(np.abs(np.sum(normals * (first[:, [0, 2, 1]] * [1, -1, 1]), axis=1)), 1, atol=1e-3)


def test_several_meshes_make_one_model(tmp_path):
    path = tmp_path / "m.glb"
    model = textured()

    def repeat(described):
        node = described["nodes"][0]
        described["nodes"] = [node, {"mesh": 0, "matrix": node["matrix"]}, {"camera": 0}]
        described["scenes"][0]["nodes"] = [0, 1, 2]

    rewritten(path, model, repeat)
    found = load_gltf(path)
    assert found.num == 2 * model.num and found.origin == model.origin
    np.testing.assert_array_equal(found.gaussians.means[model.num :], model.gaussians.means)


@pytest.mark.parametrize(
    ("changes", "is_kept"),
    [({}, True), ({"uv": "align-corners"}, False), ({"extent": 1.5}, False), ({"maxAlpha": 0.5}, False)],
)
def test_the_extension_counts_more_than_the_extras(tmp_path, saved, changes, is_kept):
    """Options of training come back unless a program has changed how textures are shown."""
    described = json.loads(json.dumps(saved[0]))
    extended(**changes)(described)
    write_parts(tmp_path / "m.glb", described, saved[1])
    appearance = load_gltf(tmp_path / "m.glb").appearance
    assert (rule_of(appearance) == rule_of(textured().appearance)) is is_kept
    options = appearance.texture_options
    assert (options.uv, options.max_alpha) == (changes.get("uv", "texel-centre"), changes.get("maxAlpha", 0.95))
    assert options.extent == changes.get("extent", 3.0)


@pytest.mark.parametrize("wrong", [np.full(50, np.nan), np.full(50, 4.0), np.zeros(49)])
def test_shapes_out_of_range_or_of_another_length_are_refused(tmp_path, monkeypatch, wrong):
    monkeypatch.setattr(gltf, "log_exponents_of", lambda shapes: wrong)
    save_gltf(tmp_path / "m.glb", shaped(plain(1)))
    refused(tmp_path / "m.glb", "shapes must be finite|kernels must be within|shapes must be 50 numbers; got 49")


def test_shapes_are_what_the_extension_says(tmp_path, saved):
    """Extras of another structure do not count."""
    rewritten(tmp_path / "m.glb", shaped(textured()), lambda described: extension_of(described).pop("shapes"))
    found = load_gltf(tmp_path / "m.glb")
    assert found.appearance.exponents is None and found.textures is not None


def test_other_kernels_and_colours_are_reported(tmp_path):
    path = tmp_path / "m.glb"
    linear = {"colorSpace": "lin_rec709_display"}
    rewritten(path, plain(), lambda described: first_primitive(described)["extensions"][SPLATS].update(linear))
    with pytest.warns(UserWarning, match="colorSpace lin_rec709_display; they are read as srgb_rec709_display"):
        load_gltf(path)


def test_degree_4_is_read_to_degree_3(tmp_path):
    path = tmp_path / "m.glb"
    model = plain(16)

    def add_degree(described):
        attributes = first_primitive(described)["attributes"]
        first = attributes[f"{SPLATS}:SH_DEGREE_3_COEF_0"]
        attributes |= {f"{SPLATS}:SH_DEGREE_4_COEF_{n}": first for n in range(9)}

    rewritten(path, model, add_degree)
    with pytest.warns(UserWarning, match=r"m\.glb: has SH of degree 4; degree 3 is read"):
        assert_shows_the_same(load_gltf(path), model)


# Damaged files


def refused(path, match):
    tracemalloc.start()
    try:
        with pytest.raises(ValueError, match=match) as caught:
            load_gltf(path)
        assert tracemalloc.get_traced_memory()[1] < 8e6
    finally:
        tracemalloc.stop()
    assert str(path) in str(caught.value) and "\n" not in str(caught.value) and len(str(caught.value)) < 700


def first_primitive(described):
    return described["meshes"][0]["primitives"][0]


def with_accessor(name, **changes):
    def change(described):
        index = first_primitive(described)["attributes"].get(name)
        index = extension_of(described)[name] if index is None else index
        described["accessors"][index].update(changes)

    return change


def extension_of(described):
    return first_primitive(described)["extensions"][SPLATS]["extensions"][EXTENSION]


def extended(**changes):
    return lambda described: extension_of(described).update(changes)


CHANGES = [
    (with_accessor("POSITION", count=10**12), "its buffer is too short"),
    (with_accessor("POSITION", count=-1), "count must be an int"),
    (with_accessor("POSITION", byteOffset=10**15), "its buffer is too short"),
    (with_accessor("POSITION", type="VEC4"), "POSITION must be VEC3"),
    (with_accessor("POSITION", componentType=5130), "POSITION must be VEC3"),
    (with_accessor("POSITION", bufferView=99), r"has no bufferViews\[99\]"),
    (with_accessor("POSITION", sparse={}), "sparse"),
    (with_accessor("POSITION", count=3), "differ in length"),
    (with_accessor("sizes", count=3), "A2TG_splat_textures.sizes must be"),
    (with_accessor("texels", count=3), r"need \d+ texels, but there are 3"),
    (extended(sizes=0), "sizes must be VEC2"),
    (extended(uv="elsewhere"), "A2TG_splat_textures.uv must be"),
    (extended(maxAlpha=2.0), "maxAlpha must be"),
    (extended(extent=0), "m.glb: extent must be at least 0.001"),
    (extended(extent=1e9), "m.glb: extent must be at least 0.001"),
    (extended(extent="wide"), "A2TG_splat_textures.extent must be float"),
    (extended(texelRanges={"rgb": [0, 1e300], "alpha": [0, 1]}), "must be 2 finite numbers"),
    (extended(texelRanges=3), "damaged"),
    (extended(degrees=1), "degrees must be SCALAR"),
    (extended(shapes=1), "shapes must be SCALAR"),
    (extended(shapes=99), r"has no accessors\[99\]"),
    (extended(shapes=-1), "accessors"),
    (lambda d: d["bufferViews"][0].update(byteStride=4), "stride"),
    (lambda d: d["bufferViews"][0].update(byteLength=10**9), "reaches beyond its buffer"),
    (lambda d: d["buffers"][0].update(byteLength=10**9), "cut off"),
    (lambda d: d["buffers"][0].update(uri="../../etc/passwd"), "is not in the folder"),
    (lambda d: d["buffers"][0].update(uri="/etc/passwd"), "is not in the folder"),
    (lambda d: d["buffers"][0].update(uri="https://a.b/c.bin"), "is not in the folder"),
    (lambda d: d["buffers"][0].update(uri="é" * 200), "too long a name"),
    (lambda d: d["buffers"][0].update(uri="data:;base64,???"), "embedded buffer is damaged"),
    (lambda d: d["buffers"][0].update(uri="data:text/plain,%00"), "buffer is not base64"),
    (lambda d: d.update(extensionsRequired=["KHR_draco_mesh_compression"]), "needs the extension KHR_d"),
    (lambda d: d["asset"].update(version="1.0"), "glTF of version 1.0"),
    (lambda d: d["nodes"][0].update(children=[0]), "occurs twice"),
    (lambda d: d["nodes"][0].update(matrix=[0.0] * 16), "must not scale by 0"),
    (lambda d: d["nodes"][0].update(matrix=[1e29] * 16), "differently|finite"),
    (lambda d: d["nodes"][0].update(matrix=np.diag([1.0, 2.0, 1.0, 1.0]).ravel().tolist()), "axes differently"),
    (lambda d: d["nodes"][0].update(matrix=np.diag([1.0, -1.0, 1.0, 1.0]).ravel().tolist()), "must have a rotation"),
    (lambda d: first_primitive(d)["extras"]["a2tg"]["origin"].update(scale=-1.0), "positive scale"),
    (lambda d: first_primitive(d)["extras"]["a2tg"]["origin"].update(Ks=["a"]), "numbers"),
    (lambda d: first_primitive(d)["extras"]["a2tg"]["appearance"].update(module="os", name="system"), "is unknown"),
    (lambda d: first_primitive(d)["attributes"].pop(f"{SPLATS}:SH_DEGREE_2_COEF_3"), "lack KHR.*SH_DEGREE_2_COEF_3"),
    (lambda d: first_primitive(d).pop("extensions"), "holds no splats"),
    (lambda d: first_primitive(d).pop("attributes"), "damaged"),
    (lambda d: d.update(nodes=3), r"has no nodes\[0\]"),
]  # fmt: skip


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    path = tmp_path_factory.mktemp("gltf") / "m.glb"
    save_gltf(path, textured())
    return parts_of(path)


@pytest.mark.parametrize(("change", "message"), CHANGES)
def test_files_that_lie_are_refused(tmp_path, saved, change, message):
    described = json.loads(json.dumps(saved[0]))
    change(described)
    write_parts(tmp_path / "m.glb", described, saved[1])
    refused(tmp_path / "m.glb", message)


@pytest.mark.parametrize("share", [0.0, 0.001, 0.01, 0.5, 0.999])
def test_files_that_are_cut_off(tmp_path, saved, share):
    path = tmp_path / "m.glb"
    write_parts(path, *saved)
    path.write_bytes(path.read_bytes()[: int(share * path.stat().st_size)])
    refused(path, "cut off|JSON|value|column")


def test_a_buffer_that_is_missing_or_too_short(tmp_path):
    path = tmp_path / "m.gltf"
    save_gltf(path, plain())
    binary = tmp_path / "m.bin"
    binary.write_bytes(binary.read_bytes()[:-4])
    refused(path, "cut off")
    binary.unlink()
    refused(path, "its buffer m.bin is missing")
    path.write_bytes(b"not JSON")
    refused(path, "Expecting value")
    with pytest.raises(FileNotFoundError, match="no such glTF file"):
        load_gltf(tmp_path / "none.glb")


def test_no_more_numbers_than_the_file_can_hold(tmp_path, saved, monkeypatch):
    """However often it refers to the same bytes."""
    path = tmp_path / "m.glb"
    described = json.loads(json.dumps(saved[0]))
    write_parts(path, *saved)
    document = Document(path)
    num_read = 0
    with pytest.raises(ValueError, match="means would take 600 bytes, which the file is too small for"):
        while num_read < 100 * path.stat().st_size:
            num_read += document.numbers(0, "VEC3", "means").nbytes
    assert num_read > 2**20
    monkeypatch.setattr(other_programs, "MOST_PARTS", 2)
    described["meshes"][0]["primitives"] *= 3
    write_parts(path, described, saved[1])
    refused(path, "holds more than 2 sets of splats")


def test_numbers_that_are_not_finite(tmp_path, saved):
    described = json.loads(json.dumps(saved[0]))
    binary = bytearray(saved[1])
    binary[:4] = np.float32(np.nan).tobytes()
    write_parts(tmp_path / "m.glb", described, bytes(binary))
    refused(tmp_path / "m.glb", "means must be finite")


def test_plain_splats_of_nan_are_left_out_and_counted(tmp_path):
    save_gltf(tmp_path / "m.glb", Model(some_gaussians()))
    data = (tmp_path / "m.glb").read_bytes()
    (tmp_path / "m.glb").write_bytes(data.replace(np.asarray(some_gaussians().means)[2, :1].tobytes(), b"\0\0\xc0\x7f"))
    with pytest.warns(UserWarning, match=rf"m\.glb: 1 Gaussian of {some_gaussians().num} left out.*first is row 2"):
        assert load_gltf(tmp_path / "m.glb").num == some_gaussians().num - 1


def test_an_origin_elsewhere_is_taken_along():
    """A model in a world of another scale is placed by its own origin."""
    model = plain()
    origin = Origin.of_cameras(model.origin.cameras, transform=Similarity(2.0, np.eye(3), np.zeros(3)))
    model = dataclasses.replace(model, origin=origin)
    assert joined_parts([(model, matrix_of(upright(origin, "y")))], "y") is model
    assert joined_parts([(model, matrix_of(upright(None, "y")))], "y") is not model


# The schema of the extension


def test_the_schema_knows_what_is_written(saved):
    """All properties, those of the library's options with its choices and defaults."""
    schema = json.loads((Path(__file__).parents[1] / "docs/reference/A2TG_splat_textures.schema.json").read_text())
    hints = typing.get_type_hints(TextureOptions)
    for name, field in gltf.OPTIONS.items():
        described = schema["properties"][name]
        assert described["default"] == getattr(TextureOptions(), field)
        assert name in ("extent", "maxAlpha") or tuple(described["enum"]) == typing.get_args(hints[field])
    written = set(extension_of(saved[0])) | {"texelRanges", "degrees", "baseDegree", "shapes"}
    assert written == set(schema["properties"])
    for name, wanted in schema["dependentRequired"].items():
        assert {name, *wanted} <= set(schema["properties"])
