"""PLY files, archives, configurations as JSON, and the change of world."""

import dataclasses
import json
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracle import sh_basis
from scipy.spatial.transform import Rotation
from small_files import ATTRIBUTES
from small_models import billboards, movable_kernels
from small_values import assert_same, some_gaussians, some_world

from a2tg_jax import (
    Camera,
    Model,
    Origin,
    Similarity,
    allocate_appearance,
    init_from_points,
    load_ply,
    render_image,
    save_model,
    save_ply,
    textures_from_arrays,
    transform_gaussians,
)
from a2tg_jax.base.archive import read_archive, read_archive_header, write_archive
from a2tg_jax.base.config_json import config_from_dict, config_to_dict, flatten_config
from a2tg_jax.io.ply import encode_ply


def write_ply(path, names, rows, encoding="binary_little_endian", types=None) -> None:
    """A PLY file written apart from the package, of floats but for the properties whose types are given."""
    types = {name: (types or {}).get(name, "float") for name in names}
    properties = "".join(f"property {kind} {name}\n" for name, kind in types.items())
    header = f"ply\nformat {encoding} 1.0\ncomment made by hand\nelement vertex {len(rows)}\n{properties}end_header\n"
    kinds = {"float": "f4", "uchar": "u1", "ushort": "u2", "int": "i4"}
    dtype = [(name, (">" if "big" in encoding else "<") + kinds[kind]) for name, kind in types.items()]
    body = np.array([tuple(row) for row in np.asarray(rows).tolist()], dtype)
    text = "".join(" ".join(repr(number) for number in row) + "\n" for row in body.tolist())
    path.write_bytes(header.encode() + (text.encode() if encoding == "ascii" else body.tobytes()))


# PLY


def test_ply_attributes_in_the_order_of_2dgs(tmp_path):
    gaussians = some_gaussians()
    save_ply(tmp_path / "g.ply", gaussians, third_scale=False)
    header, data = (tmp_path / "g.ply").read_bytes().split(b"end_header\n", 1)
    names = [line.split()[-1].decode() for line in header.splitlines() if line.startswith(b"property float ")]
    rows = np.frombuffer(data, "<f4").reshape(7, 61)
    column = dict(zip(names, rows.T, strict=True))
    expected = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"] + [f"f_rest_{i}" for i in range(45)]
    assert names == [*expected, "opacity", "scale_0", "scale_1", "rot_0", "rot_1", "rot_2", "rot_3"]
    np.testing.assert_array_equal(column["opacity"], gaussians.logit_opacities)
    np.testing.assert_array_equal(column["scale_1"], gaussians.log_scales[:, 1])
    np.testing.assert_array_equal(column["rot_0"], gaussians.quats[:, 0])
    np.testing.assert_array_equal(column["f_rest_1"], gaussians.sh[:, 2, 0])
    np.testing.assert_array_equal(column["f_rest_15"], gaussians.sh[:, 1, 1])
    np.testing.assert_array_equal(column["f_rest_44"], gaussians.sh[:, 15, 2])


def test_ply_goes_back_to_the_original_world(tmp_path):
    original = some_gaussians()
    world = some_world()
    save_ply(tmp_path / "g.ply", transform_gaussians(original, world), transform=world)
    unit = original.quats / jnp.linalg.norm(original.quats, axis=-1, keepdims=True)
    loaded = load_ply(tmp_path / "g.ply")
    sign = jnp.sign(jnp.sum(loaded.quats * unit, axis=-1, keepdims=True))
    expected = dataclasses.replace(original, quats=unit)
    assert_same(dataclasses.replace(loaded, quats=loaded.quats * sign), expected, atol=2e-6)


def test_ply_of_lower_degree_is_filled_with_zeros(tmp_path):
    names = [name for name in ATTRIBUTES if not name.startswith(("f_rest_", "n"))] + [f"f_rest_{i}" for i in range(9)]
    rows = np.random.default_rng(0).normal(size=(3, len(names)))
    write_ply(tmp_path / "g.ply", names, rows)
    sh = np.asarray(load_ply(tmp_path / "g.ply").sh)
    np.testing.assert_allclose(sh[:, 1:4, 1], rows[:, names.index("f_rest_3") :][:, :3], rtol=1e-6)
    assert np.all(sh[:, 4:] == 0)


def test_ply_of_degree_4_is_read_to_degree_3(tmp_path):
    names = [name for name in ATTRIBUTES if not name.startswith(("f_rest_", "n"))] + [f"f_rest_{i}" for i in range(72)]
    rows = np.random.default_rng(0).normal(size=(3, len(names))).astype(np.float32)
    write_ply(tmp_path / "g.ply", names, rows)
    with pytest.warns(UserWarning, match=r"g\.ply: has SH of degree 4; degree 3 is read"):
        sh = np.asarray(load_ply(tmp_path / "g.ply").sh)
    for channel in range(3):  # Each has 24 attributes, of which 9 belong to degree 4.
        first = names.index(f"f_rest_{24 * channel}")
        np.testing.assert_array_equal(sh[:, 1:, channel], rows[:, first : first + 15])


@pytest.mark.parametrize("num", [44, 46, 60, 73])
def test_ply_of_other_numbers_of_coefficients_is_refused(tmp_path, num):
    names = [name for name in ATTRIBUTES if not name.startswith(("f_rest_", "n"))]
    names += [f"f_rest_{i}" for i in range(num)]
    write_ply(tmp_path / "g.ply", names, np.ones((2, len(names))))
    with pytest.raises(ValueError, match=rf"has {num} attributes f_rest_\*; .* have 0, 9, 24, 45 or 72"):
        load_ply(tmp_path / "g.ply")


@pytest.mark.parametrize("encoding", ["ascii", "binary_big_endian"])
def test_ply_in_text_and_of_the_other_byte_order(tmp_path, encoding):
    rows = np.random.default_rng(0).normal(size=(5, len(ATTRIBUTES)))
    write_ply(tmp_path / "little.ply", ATTRIBUTES, rows)
    write_ply(tmp_path / "other.ply", ATTRIBUTES, rows, encoding)
    assert_same(load_ply(tmp_path / "other.ply"), load_ply(tmp_path / "little.ply"))


@pytest.mark.parametrize(
    ("kind", "largest", "encoding"),
    [
        ("uchar", 255, "binary_little_endian"),
        ("uchar", 255, "ascii"),
        ("ushort", 65535, "binary_big_endian"),
        ("int", 255, "binary_little_endian"),
        ("float", 1, "binary_little_endian"),
        ("float", 255, "binary_little_endian"),
    ],
)
def test_ply_with_red_green_and_blue(tmp_path, kind, largest, encoding):
    """A colour c is 0.5 + f_dc / (2 √π)."""
    names = [name for name in ATTRIBUTES if not name.startswith(("f_", "n"))] + ["red", "green", "blue"]
    rows = np.random.default_rng(0).normal(size=(4, len(names)))
    colors = np.array([[0, 0.2, 1], [0.4, 0.6, 0.8], [0.2, 0.2, 0], [1, 0, 0.4]])
    rows[:, -3:] = largest * colors
    write_ply(tmp_path / "g.ply", names, rows, encoding, dict.fromkeys(("red", "green", "blue"), kind))
    sh = np.asarray(load_ply(tmp_path / "g.ply").sh)
    assert sh.shape == (4, 1, 3)
    np.testing.assert_allclose(0.5 + sh[:, 0] / (2 * np.sqrt(np.pi)), colors, atol=1e-6)


def test_an_empty_ply_with_colours_is_an_empty_model(tmp_path):
    names = [name for name in ATTRIBUTES if not name.startswith(("f_", "n"))] + ["red", "green", "blue"]
    write_ply(tmp_path / "g.ply", names, np.zeros((0, len(names))))
    assert load_ply(tmp_path / "g.ply").num == 0


@pytest.mark.parametrize("name", ["x", "f_dc_1", "f_rest_44", "opacity", "scale_1", "rot_3"])
def test_rows_of_nan_are_left_out_and_counted(tmp_path, name):
    rows = np.random.default_rng(0).normal(size=(6, len(ATTRIBUTES)))
    write_ply(tmp_path / "whole.ply", ATTRIBUTES, rows[[0, 1, 3, 5]])
    rows[[2, 4], ATTRIBUTES.index(name)] = np.nan
    write_ply(tmp_path / "g.ply", ATTRIBUTES, rows)
    with pytest.warns(UserWarning, match=r"g\.ply: 2 Gaussians of 6 left out.*; the first is row 2 \(from 0\)"):
        found = load_ply(tmp_path / "g.ply")
    assert_same(found, load_ply(tmp_path / "whole.ply"))


def filtered(log_scales, logit, width):
    """Scales and opacity of Mip-Splatting (`get_scaling_with_3D_filter`, `get_opacity_with_3D_filter`), by products."""
    squares = np.exp(log_scales) ** 2
    share = np.sqrt(np.prod(squares) / np.prod(squares + width**2))
    return np.sqrt(squares + width**2), share / (1 + np.exp(-logit))


@pytest.mark.parametrize("encoding", ["ascii", "binary_big_endian"])
@pytest.mark.parametrize("is_flat", [False, True])
def test_the_filter_of_mip_splatting_is_applied(tmp_path, encoding, is_flat):
    names = [*ATTRIBUTES, "scale_2", "filter_3D"]
    rng = np.random.default_rng(0)
    rows = rng.normal(size=(6, len(names)))
    rows[:, names.index("scale_2")] = -9
    rows[:, names.index("filter_3D")] = [0.3, 0.05, 0.0, 2.0, np.nan, -0.3]
    write_ply(tmp_path / "g.ply", names, rows, encoding)
    if is_flat:
        data = (tmp_path / "g.ply").read_bytes()
        (tmp_path / "g.ply").write_bytes(data.replace(b"made by hand", b"SplatRenderMode: 2dgs"))
    with pytest.warns(UserWarning) as told:
        found = load_ply(tmp_path / "g.ply")
    wanted = ["g.ply: 1 Gaussian of 6 left out", "g.ply: holds 3D Gaussians (scale_2), 4 of them not flat"]
    for one, beginning in zip(told, wanted[: 1 if is_flat else 2], strict=True):
        assert str(one.message).startswith(str(tmp_path / beginning))
    assert found.num == 5
    columns = [names.index(name) for name in ("scale_0", "scale_1", *(() if is_flat else ("scale_2",)))]
    for row, scales, opacity in zip(rows[[0, 1, 2, 3, 5]], found.scales, found.opacities, strict=True):
        by_axis, drawn = filtered(row[columns], row[names.index("opacity")], row[names.index("filter_3D")])
        np.testing.assert_allclose(np.sort(scales), np.sort(by_axis)[-2:], rtol=1e-5)
        np.testing.assert_allclose(opacity, drawn, rtol=1e-5)


def test_attributes_that_are_not_read_are_named(tmp_path):
    more = ["beta", "f_offset_0", "f_offset_1", "filter_3D", "red", "green", "blue"]
    names = [*ATTRIBUTES, "scale_2", *more]
    rows = np.ones((2, len(names)))
    rows[:, [names.index("scale_2"), names.index("filter_3D")]] = -20, 0
    write_ply(tmp_path / "g.ply", names, rows)
    with pytest.warns(
        UserWarning, match=r"g\.ply: does not read beta, f_offset_0 to f_offset_1; if the program"
    ) as told:
        load_ply(tmp_path / "g.ply")
    assert "filter" not in str(told[0].message) and "red" not in str(told[0].message)
    names = ["x", "y", "z", "f_anchor_feat_0", "opacity", "scale_0", "scale_1"]
    write_ply(tmp_path / "g.ply", names, np.zeros((2, len(names))))
    with pytest.raises(ValueError, match=r"no attribute f_dc_0.*networks make splats of these anchors"):
        load_ply(tmp_path / "g.ply")


def test_text_with_blank_lines_and_words_for_nan(tmp_path):
    """Programs of Microsoft's compiler write NaN as -nan(ind) or 1.#QNAN."""
    rows = np.random.default_rng(0).normal(size=(5, len(ATTRIBUTES)))
    write_ply(tmp_path / "whole.ply", ATTRIBUTES, rows[:2], "ascii")
    write_ply(tmp_path / "g.ply", ATTRIBUTES, rows, "ascii")
    text = (tmp_path / "g.ply").read_text()
    for row, word in zip(rows[2:], ("-nan(ind)", "1.#QNAN", "nan"), strict=True):
        text = text.replace(repr(float(np.float32(row[0]))), word)
    header, body = text.split("end_header\n")
    (tmp_path / "g.ply").write_text(header + "end_header\n\n" + body.replace("\n", "\n \n"))
    with pytest.warns(UserWarning, match="3 Gaussians of 5 left out"):
        assert_same(load_ply(tmp_path / "g.ply"), load_ply(tmp_path / "whole.ply"))


@pytest.mark.parametrize("words", [" 7", " x", ""])
def test_rows_of_text_with_another_number_of_numbers_are_named(tmp_path, words):
    rows = np.ones((3, len(ATTRIBUTES)))
    write_ply(tmp_path / "g.ply", ATTRIBUTES, rows, "ascii")
    *lines, second, _ = (tmp_path / "g.ply").read_text().splitlines(keepends=True)
    wrong = second.rstrip() + words if words else second.rpartition(" ")[0]
    (tmp_path / "g.ply").write_text("".join([*lines, wrong + "\n", second]))
    with pytest.raises(ValueError, match=r"g\.ply: row 1 \(from 0\) of vertex must be 61 numbers; got 1\.0 1\.0"):
        load_ply(tmp_path / "g.ply")


def test_elements_before_the_vertices_are_skipped(tmp_path):
    write_ply(tmp_path / "g.ply", ATTRIBUTES, np.random.default_rng(0).normal(size=(3, len(ATTRIBUTES))))
    data = (tmp_path / "g.ply").read_bytes()
    element = b"element camera 2\nproperty double focal\nproperty uchar id\nelement vertex"
    header, body = data.replace(b"element vertex", element).split(b"end_header\n", 1)
    (tmp_path / "h.ply").write_bytes(header + b"end_header\n" + bytes(2 * 9) + body)
    assert_same(load_ply(tmp_path / "h.ply"), load_ply(tmp_path / "g.ply"))
    (tmp_path / "h.ply").write_bytes(
        (header + b"end_header\n" + bytes(2 * 9) + body).replace(b"uchar id", b"list uchar int id")
    )
    with pytest.raises(ValueError, match="cannot read the camera property 'list uchar int id'"):
        load_ply(tmp_path / "h.ply")
    (tmp_path / "h.ply").write_bytes(data.replace(b"format binary_little_endian 1.0\n", b""))
    with pytest.raises(ValueError, match="has no format line"):
        load_ply(tmp_path / "h.ply")


def test_a_third_scale_of_0_is_flat(tmp_path):
    """Its logarithm is −inf; in other places that is no number."""
    names = (*ATTRIBUTES, "scale_2")
    rows = np.random.default_rng(0).normal(size=(3, len(ATTRIBUTES) + 1))
    rows[:, -1] = -np.inf
    write_ply(tmp_path / "g.ply", names, rows)
    np.testing.assert_allclose(load_ply(tmp_path / "g.ply").means, rows[:, :3], rtol=1e-6)
    rows[1, names.index("scale_0")] = -np.inf
    write_ply(tmp_path / "g.ply", names, rows)
    with pytest.warns(UserWarning, match="1 Gaussian of 3 left out"):
        assert load_ply(tmp_path / "g.ply").num == 2


def test_infinite_logits_of_opacities_become_finite(tmp_path):
    rows = np.ones((2, len(ATTRIBUTES)))
    rows[:, ATTRIBUTES.index("opacity")] = -np.inf, np.inf
    write_ply(tmp_path / "g.ply", ATTRIBUTES, rows)
    np.testing.assert_allclose(load_ply(tmp_path / "g.ply").opacities, [0, 1], atol=2e-6)


@pytest.mark.long
def test_flat_ellipsoids_show_the_same_whichever_axis_is_thin(tmp_path):
    """The same splats with their axes cycled, so that the first or the second is thin, are the same splats."""
    gaussians = some_gaussians(30)
    camera = Camera(jnp.eye(4).at[2, 3].set(5), jnp.diag(jnp.array([30.0, 30, 1])), 32, 24)
    camera = dataclasses.replace(camera, K=camera.K.at[:2, 2].set(jnp.array([16.0, 12])))
    gaussians = dataclasses.replace(gaussians, log_scales=gaussians.log_scales + 1)
    save_ply(tmp_path / "flat.ply", gaussians)
    header, data = (tmp_path / "flat.ply").read_bytes().split(b"end_header\n", 1)
    names = [line.split()[-1].decode() for line in header.splitlines() if line.startswith(b"property float ")]
    rows = np.frombuffer(data, "<f4").reshape(30, 62).copy()
    scales, quats = ([names.index(f"{kind}_{i}") for i in range(n)] for kind, n in (("scale", 3), ("rot", 4)))
    expected = render_image(gaussians, camera)
    for turn in range(3):
        order = np.roll(np.arange(3), turn)
        turned = rows.copy()
        turned[:, scales] = rows[:, scales][:, order]
        axes = Rotation.from_quat(rows[:, quats], scalar_first=True).as_matrix()[:, :, order]
        turned[:, quats] = Rotation.from_matrix(axes).as_quat(scalar_first=True)
        write_ply(tmp_path / "turned.ply", names, turned)
        found = render_image(load_ply(tmp_path / "turned.ply"), camera)
        np.testing.assert_allclose(found.color, expected.color, atol=1e-4)
        np.testing.assert_allclose(found.alpha, expected.alpha, atol=1e-4)
    assert expected.alpha.mean() > 0.2


@pytest.mark.parametrize("third_scale", [False, True])
def test_flat_gaussians_come_back_exactly_with_and_without_a_third_scale(tmp_path, third_scale):
    save_ply(tmp_path / "g.ply", some_gaussians(), third_scale=third_scale)
    assert b"comment SplatRenderMode: 2dgs\n" in (tmp_path / "g.ply").read_bytes()
    assert_same(load_ply(tmp_path / "g.ply"), some_gaussians())


def test_the_third_scale_of_splats_marked_as_flat_says_nothing(tmp_path):
    """Programs that round scales may leave another axis thinner."""
    gaussians = some_gaussians()
    path = tmp_path / "g.ply"
    path.write_bytes(encode_ply(gaussians, np.asarray(gaussians.log_scales.max(1, keepdims=True)) + 1))
    assert_same(load_ply(path), gaussians)
    path.write_bytes(path.read_bytes().replace(b"2dgs", b"mip "))
    with pytest.warns(UserWarning, match="3D Gaussians"):
        assert not np.array_equal(load_ply(path).quats, gaussians.quats)


def test_ply_of_a_model_is_in_its_original_world(tmp_path):
    world = some_world()
    model = Model(some_gaussians(), num_live=jnp.asarray(5, jnp.int32), origin=Origin.of_cameras([], transform=world))
    save_ply(tmp_path / "model.ply", model)
    save_ply(tmp_path / "gaussians.ply", some_gaussians()[:5], transform=world)
    assert (tmp_path / "model.ply").read_bytes() == (tmp_path / "gaussians.ply").read_bytes()


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda path: path.write_bytes(b"ply\nelement vertex -3\n"), "announces -3 of vertex"),
        (lambda path: path.write_bytes(b"not a ply\n"), "is not a PLY file"),
        (
            lambda path: path.write_bytes(path.read_bytes().replace(b"binary_little_endian", b"ascii")),
            r"row \d+ \(from 0\) of vertex must be",
        ),
        (lambda path: path.write_bytes(b"ply\nformat binary_little_endian 1.0\n"), "header does not end"),
        (lambda path: path.write_bytes(path.read_bytes()[:-1]), "is cut off"),
        (lambda path: write_ply(path, ("x", "y", "z"), np.ones((2, 3))), "no attribute f_dc_0"),
    ],
)
def test_bad_ply_is_one_clear_line(tmp_path, spoil, message):
    path = tmp_path / "bad.ply"
    save_ply(path, some_gaussians())
    spoil(path)
    with pytest.raises(ValueError, match=message) as raised:
        load_ply(path)
    assert "bad.ply" in str(raised.value) and "\n" not in str(raised.value)


def test_missing_ply(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"nowhere\.ply"):
        load_ply(tmp_path / "nowhere.ply")


# Change of world


@pytest.mark.parametrize("seed", range(2))
def test_rotated_sh_have_the_same_colours(x64, seed):
    rng = np.random.default_rng(seed)
    rotation = Rotation.random(rng=rng).as_matrix()
    gaussians = jax.tree.map(lambda x: jnp.asarray(x, jnp.float64), some_gaussians(20))
    rotated = transform_gaussians(gaussians, Similarity(1.0, rotation, np.zeros(3)))
    for before, after in zip(gaussians.sh, rotated.sh, strict=True):
        direction = rng.normal(size=3)
        direction /= np.linalg.norm(direction)
        np.testing.assert_allclose(sh_basis(rotation @ direction) @ after, sh_basis(direction) @ before, atol=1e-13)


@pytest.mark.long
def test_world_and_camera_moved_together_show_the_same(x64):
    rng = np.random.default_rng(0)
    as_double = lambda x: jnp.asarray(x, jnp.float64)  # noqa: E731
    gaussians = jax.tree.map(as_double, some_gaussians(20))
    gaussians = dataclasses.replace(gaussians, log_scales=gaussians.log_scales + 1.5)
    viewmat = np.eye(4)
    viewmat[:3, :3], viewmat[2, 3] = Rotation.random(rng=rng).as_matrix(), 5
    camera = Camera(as_double(viewmat), as_double([[30, 0, 16], [0, 30, 12], [0, 0, 1]]), 32, 24)
    textures = textures_from_arrays([rng.uniform(size=(2, 4, 4)) for _ in range(20)])
    world = some_world()
    moved = dataclasses.replace(camera, viewmat=as_double(world.apply_to_viewmat(viewmat)))
    before = render_image(gaussians, camera, textures)
    after = render_image(transform_gaussians(gaussians, world), moved, textures)
    np.testing.assert_allclose(after.color, before.color, atol=1e-12)
    np.testing.assert_allclose(after.alpha, before.alpha, atol=1e-12)
    np.testing.assert_allclose(after.depth, world.scale * before.depth, atol=1e-12)
    np.testing.assert_allclose(after.normal, before.normal @ world.rotation.T, atol=1e-12)
    assert before.alpha.mean() > 0.2


# Archives


def test_archive_round_trip(tmp_path):
    arrays = {"a/b": np.arange(6.0).reshape(2, 3), "scalar": np.int64(3), "empty": np.zeros((0, 4), np.float32)}
    write_archive(tmp_path / "a.npz", {"stage": 2, "names": ["x"]}, arrays)
    header, loaded = read_archive(tmp_path / "a.npz")
    assert header == {"format": "a2tg-jax checkpoint", "version": 1, "stage": 2, "names": ["x"]}
    assert header == read_archive_header(tmp_path / "a.npz")
    assert set(loaded) == set(arrays)
    for name, array in arrays.items():
        assert loaded[name].dtype == array.dtype
        np.testing.assert_array_equal(loaded[name], array)
    assert [path.name for path in tmp_path.iterdir()] == ["a.npz"]


def test_failed_write_keeps_the_old_archive(tmp_path):
    write_archive(tmp_path / "a.npz", {"stage": 1}, {})
    with pytest.raises(TypeError):
        write_archive(tmp_path / "a.npz", {"stage": object()}, {})
    assert read_archive_header(tmp_path / "a.npz")["stage"] == 1


def test_other_version_is_refused(tmp_path):
    header = json.dumps({"format": "a2tg-jax checkpoint", "version": 99}).encode()
    np.savez(tmp_path / "a.npz", header=np.frombuffer(header, np.uint8))
    with pytest.raises(ValueError, match=r"a\.npz: is an a2tg-jax checkpoint of version 99; .* version 1"):
        read_archive(tmp_path / "a.npz")


def test_other_kind_is_refused(tmp_path):
    save_model(tmp_path / "a.npz", Model(some_gaussians()))
    with pytest.raises(ValueError, match="is an a2tg-jax model, not an a2tg-jax checkpoint"):
        read_archive(tmp_path / "a.npz")


@pytest.mark.parametrize("share", [0.0, 0.1, 0.5, 0.99])
def test_truncated_archive_is_one_clear_line(tmp_path, share):
    path = tmp_path / "cut.npz"
    write_archive(path, {}, {"a": np.arange(1000)})
    path.write_bytes(path.read_bytes()[: int(share * path.stat().st_size)])
    with pytest.raises(ValueError, match=r"cut\.npz: is not an a2tg-jax checkpoint, or is damaged"):
        read_archive(path)


def test_damaged_archive_is_one_clear_line(tmp_path):
    path = tmp_path / "bits.npz"
    write_archive(path, {}, {"a": np.arange(1000)})
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 0xFF
    path.write_bytes(bytes(data))
    with pytest.raises(ValueError, match="or is damaged"):
        read_archive(path)


def test_npz_without_header_is_refused(tmp_path):
    np.savez(tmp_path / "other.npz", a=np.arange(3))
    with pytest.raises(ValueError, match="is not an a2tg-jax checkpoint"):
        read_archive(tmp_path / "other.npz")
    with pytest.raises(FileNotFoundError, match="nowhere"):
        read_archive(tmp_path / "nowhere.npz")


# Configurations


@dataclasses.dataclass(frozen=True)
class Cake:
    """An option of options."""

    layers: int = 3
    sugar: float = 1


@dataclasses.dataclass(frozen=True)
class Options:
    """Every kind of option."""

    cake: Cake = Cake()
    times: tuple[float, ...] | None = None
    background: Literal["black", "white"] = "black"
    seed: int = 0
    budget: float | None = None


@pytest.mark.parametrize(
    "config", [Options(), Options(Cake(2), (0.1, 0.5), "white", 7, 3), Options(cake=Cake(sugar=0.5), budget=2.5)]
)
def test_config_round_trip(config):
    text = json.dumps(config_to_dict(config))
    assert config_from_dict(Options, json.loads(text)) == config


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda data: data.update(colour=1), "config.colour is an unknown key"),
        (lambda data: data["cake"].update(layers="many"), "config.cake.layers must be int; got 'many'"),
        (lambda data: data.update(background="green"), "config.background must be one of black, white; got 'green'"),
        (lambda data: data.update(seed=True), "config.seed must be int; got True"),
        (lambda data: data.update(cake=3), "config.cake must hold the fields of Cake; got 3"),
    ],
)
def test_bad_config_names_the_field(spoil, message):
    data = config_to_dict(Options())
    spoil(data)
    with pytest.raises(ValueError, match=message):
        config_from_dict(Options, data)


def test_flat_names_are_those_of_the_command_line():
    leaves = flatten_config(Options(Cake(7)))
    assert leaves["cake.layers"] == 7 and leaves["seed"] == 0


def test_an_option_that_is_missing_has_its_default():
    """As an option has that is newer than the file; one without a default is asked for."""
    data = config_to_dict(Options())
    del data["cake"]["layers"]
    assert config_from_dict(Options, data) == Options()

    @dataclasses.dataclass
    class Strict:
        needed: int

    with pytest.raises(ValueError, match=r"config\.needed is missing"):
        config_from_dict(Strict, {})


@pytest.mark.long
@pytest.mark.parametrize("template", [movable_kernels(), billboards(side=4)])
def test_ply_of_splats_with_opacities_of_their_own(tmp_path, template):
    gaussians = init_from_points(np.eye(3), np.eye(3), opacity=0.2)
    appearance = allocate_appearance(template, jax.random.key(0), gaussians)
    faint = dataclasses.replace(gaussians, logit_opacities=gaussians.logit_opacities - 3)
    save_ply(tmp_path / "a.ply", Model(faint, appearance))
    opacities = appearance.opacities(faint)
    np.testing.assert_allclose(load_ply(tmp_path / "a.ply").opacities, opacities, rtol=1e-4)
