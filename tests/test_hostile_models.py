"""Models, checkpoints and weights whose arrays do not fit each other, or whose files lie: refused, in one line."""

import dataclasses
import io
import pickle
import tracemalloc
import zipfile

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hostile_files import put
from small_files import read_archive, write_archive
from small_models import NUM, some_checkpoint, some_gaussians, some_model

import a2tg_jax as a2tg
from a2tg_jax import (
    Bytewise,
    Model,
    Origin,
    Textures,
    load_checkpoint,
    load_compact,
    load_lpips,
    load_model,
    load_ply,
    plan_render,
    save_checkpoint,
    save_compact,
    save_gltf,
    save_model,
    save_ply,
)
from a2tg_jax.base.json_text import parse_json
from a2tg_jax.base.npz import read_npz
from a2tg_jax.io import ply
from a2tg_jax.model import check_model
from a2tg_jax.rasterize.views import render_traced
from a2tg_jax.training.registry import system_from_dict


def spoiled(path, change):
    """A file whose header and arrays went through a function."""
    header, arrays = read_archive(path)
    change(header, arrays)
    write_archive(path, header, arrays)


def refused(load, path, match):
    with pytest.raises(ValueError, match=match) as caught:
        load(path)
    assert path.name in str(caught.value) and "\n" not in str(caught.value)


def with_number(name, value, place=0):
    def change(_, arrays):
        arrays[name] = arrays[name].copy()
        arrays[name].reshape(-1)[place] = value

    return change


def with_array(name, function):
    return lambda _, arrays: arrays.update({name: function(arrays[name])})


def with_header(**values):
    return lambda header, _: header.update(values)


GAUSSIANS = ("means", "quats", "log_scales", "logit_opacities", "sh")


@pytest.mark.parametrize("name", [*GAUSSIANS, "appearance/texels"])
def test_models_with_numbers_that_are_not_finite_or_too_large(tmp_path, name):
    path = tmp_path / "m.npz"
    field = name.removeprefix("appearance/")
    save_model(path, some_model())
    whole = path.read_bytes()
    limit = rf"{field}.* within ±1e\+12; got"
    for value in (np.nan, np.inf, -np.inf, 1e38, -2e12):
        path.write_bytes(whole)
        spoiled(path, with_number(name, value))
        wanted = limit if np.isfinite(value) else "must be finite; .* rows have NaN or infinite numbers"
        refused(load_model, path, "must" if name == "log_scales" else wanted)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (with_number("log_scales", 28.0), "up to 27.63"),
        (with_number("log_scales", -1e38), r"within ±1e\+12; got"),
        (with_number("log_scales", 100.0), "logarithms of finite scales"),
        (lambda _, a: a.update({name: a[name].astype(np.float16) for name in GAUSSIANS}), "must be float32 or float64"),
        (with_array("appearance/texels", lambda x: x.astype(np.float16)), "must be floats, float32 or float64"),
        (with_array("quats", lambda x: x[1:]), r"quats must be \[12, 4\]"),
        (with_array("appearance/sizes", lambda x: x + 400), "texture sides must be in 1"),
        (with_number("origin/Ks", np.nan), r"camera a\.png: its focal lengths"),
        (with_number("origin/Ks", 1e30), r"camera a\.png: its focal lengths"),
        (with_number("origin/Ks", np.inf, 2), r"camera a\.png: its principal point"),
        (with_number("origin/Ks", 5.0, 8), r"camera a\.png: its K must be upper triangular"),
        (with_number("origin/viewmats", np.nan), r"camera a\.png: its pose must be finite"),
        (with_number("origin/viewmats", 1e13, 3), r"camera a\.png: its pose must be finite"),
        (with_number("origin/viewmats", 7.0), r"camera a\.png: its pose must be a rigid motion"),
        (with_number("origin/sizes", 10**9), r"camera a\.png: its image must have sides"),
        (with_number("origin/sizes", -3), r"camera a\.png: its image must have sides"),
        (with_array("origin/sizes", lambda x: x.astype(float)), "sizes must be integers"),
        (with_array("origin/is_test", lambda x: x.astype(int)), "is_test must be bool"),
        (with_number("origin/scale", 0.0), "positive scale"),
        (with_number("origin/scale", np.inf), "positive scale"),
        (with_number("origin/rotation", 3.0), "must have a rotation"),
        (with_number("origin/translation", np.nan), "finite translation"),
        (with_header(origin={"names": ["a", 5]}), "names must be texts"),
        (with_header(background=[0, 0, 1e400]), "finite|JSON"),
    ],
)  # fmt: skip
def test_models_that_no_camera_sees(tmp_path, change, message):
    path = tmp_path / "m.npz"
    save_model(path, some_model())
    try:
        spoiled(path, change)
    except ValueError as error:  # Not even written: JSON knows no infinity.
        assert "JSON" in str(error)
        return
    refused(load_model, path, message)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (with_number("appearance/shapes", np.nan), "must be finite"),
        (with_number("appearance/shapes", 1e30), "must be within"),
        (with_array("appearance/shapes", lambda x: x[1:]), r"shapes must be \[12\]; got \[11\]"),
        (with_array("appearance/shapes", lambda x: x[:, None]), r"shapes must be floats \[N\]"),
        (with_array("appearance/shapes", lambda x: x.astype(int)), r"shapes must be floats \[N\]"),
        (lambda _, arrays: arrays.pop("appearance/shapes"), "the array shapes of the appearance is missing"),
    ],
)  # fmt: skip
def test_shapes_of_kernels_that_are_none(tmp_path, change, message):
    path = tmp_path / "m.npz"
    save_model(path, some_model(Bytewise(kernel_rate=0.01)))
    spoiled(path, change)
    refused(load_model, path, message)


def test_what_would_not_load_is_not_saved(tmp_path):
    model = some_model()
    origin = Origin.of_cameras([a2tg.Camera(jnp.eye(4), jnp.zeros((3, 3)), 4, 4)])
    with pytest.raises(ValueError, match="focal lengths"):
        save_model(tmp_path / "m.npz", dataclasses.replace(model, origin=origin))
    assert not list(tmp_path.iterdir())


def test_textures_lie_within_their_buckets_and_apart():
    """Native loops read at the places of textures."""

    def placed(bucket, row):
        buckets = jnp.zeros((4, 1, 1, 4)), jnp.zeros((2, 2, 1, 4))
        return Textures(buckets, jnp.asarray(bucket, jnp.int32), jnp.asarray(row, jnp.int32), ((1, 1), (2, 1)))

    def checked(textures):
        check_model(Model(some_gaussians()[:3], a2tg.Appearance(texture=a2tg.Texture(textures))))

    checked(placed([0, 0, 1], [0, 3, 1]))
    for bucket, row, message in [
        ([0, 0, 1], [0, 4, 1], "textures.row must be below the number"),
        ([0, 0, 1], [0, -1, 1], "textures.row must be below the number"),
        ([0, 0, 2], [0, 1, 1], "textures.bucket must be 0 to 1"),
        ([0, -1, 1], [0, 1, 1], "textures.bucket must be 0 to 1"),
        ([0, 0, 1], [2, 2, 0], "some share one"),
    ]:
        with pytest.raises(ValueError, match=message):
            checked(placed(bucket, row))


# Numbers at the limit, and files that are none


@pytest.mark.long
def test_numbers_at_the_limit_are_drawn_and_have_gradients(tmp_path):
    gaussians = some_gaussians()
    extreme = dataclasses.replace(
        gaussians,
        means=gaussians.means.at[0].set(jnp.asarray([1e12, -1e12, 1e12])).at[1].set(jnp.asarray([0, 0, 1e12])),
        log_scales=gaussians.log_scales.at[2].set(27.6),
        quats=gaussians.quats.at[3].set(1e12),
        sh=gaussians.sh.at[4].set(1e12),
    )
    save_model(tmp_path / "m.npz", Model(extreme))
    model = load_model(tmp_path / "m.npz")
    viewmat = jnp.eye(4).at[2, 3].set(4.0)
    camera = a2tg.Camera(viewmat, jnp.asarray([[40.0, 0, 16], [0, 40, 12], [0, 0, 1]]), 32, 24)

    settings = plan_render(extreme, [camera], appearance=model.appearance)

    def brightness(gaussians):
        return render_traced(gaussians, camera, model.appearance, jnp.zeros(3), settings)[0].color.sum()

    gradient = jax.grad(brightness)(model.gaussians)
    assert np.isfinite(np.asarray(model.render(camera).color)).all()
    assert all(np.isfinite(np.asarray(leaf)).all() for leaf in jax.tree.leaves(gradient))


@pytest.mark.parametrize("compositor", ["native", "xla", "autodiff"])
def test_numbers_beyond_the_limit_spoil_no_other_gradient(compositor):
    camera = a2tg.Camera(jnp.eye(4), jnp.asarray([[40.0, 0, 20], [0, 40, 15], [0, 0, 1]]), 40, 30)
    settings = a2tg.RenderSettings(compositor=compositor, capacity=4096)
    near = a2tg.Gaussians(
        means=jnp.asarray([[0.0, 0, 2], [0.3, 0.1, 2.5], [0, 0, 3]]),
        quats=jnp.tile(jnp.asarray([1.0, 0.1, 0.2, 0]), (3, 1)),
        log_scales=jnp.full((3, 2), -1.5),
        logit_opacities=jnp.zeros(3),
        sh=jnp.ones((3, 4, 3)),
    )

    @jax.jit
    def gradients(gaussians):
        def loss(gaussians, camera):
            return jnp.mean(a2tg.render_image(gaussians, camera, settings=settings).color ** 2)

        return jax.grad(loss, argnums=(0, 1))(gaussians, camera)

    def at(distance):
        return dataclasses.replace(near, means=near.means.at[2].set(distance * jnp.asarray([0.1, -0.1, 1])))

    def sized(log_scale):
        return dataclasses.replace(near, log_scales=near.log_scales.at[2].set(log_scale))

    # What is large enough looks the same at any size: a dot at infinity, and a plane.
    for large, larger in [
        (at(1e6), at(1e22)),
        (at(1e6), at(1e36)),
        (sized(20.0), sized(50.0)),
        (sized(20.0), sized(80.0)),
    ]:
        (wanted, _), (found, of_camera) = gradients(large), gradients(larger)
        for one, other in zip(jax.tree.leaves(found), jax.tree.leaves(wanted), strict=True):
            np.testing.assert_allclose(one[:2], other[:2], rtol=1e-4, atol=1e-8)
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves((found, of_camera)))


def test_files_with_numbers_that_are_too_large(tmp_path, monkeypatch):
    gaussians = some_gaussians()
    gaussians = dataclasses.replace(gaussians, means=gaussians.means.at[0, 0].set(-1e13))
    with monkeypatch.context() as patch:
        patch.setattr(ply, "check_model", lambda model: None)
        save_ply(tmp_path / "g.ply", gaussians)
    with pytest.warns(UserWarning, match=rf"1 Gaussian of {NUM} left out.*row 0 \(from 0\), with means of -1e\+13"):
        assert load_ply(tmp_path / "g.ply").num == NUM - 1
    for save, name in ((save_model, "m.npz"), (save_compact, "m.a2tgz"), (save_ply, "m.ply"), (save_gltf, "m.glb")):
        with pytest.raises(ValueError, match=r"gaussians\.means must be within ±1e\+12; got -1e\+13 in row 0"):
            save(tmp_path / name, Model(gaussians))
        assert not (tmp_path / name).exists()


@pytest.mark.parametrize("kind", ["device", "pipe", "sparse"])
def test_models_that_are_no_files(tmp_path, kind):
    others = [(f"m{suffix}", a2tg.load_splats) for suffix in (".spz", ".sog", ".splat", ".ksplat", ".glb")]
    for name, load in (("m.npz", load_model), ("m.a2tgz", load_compact), ("m.ply", load_ply), *others):
        put(tmp_path / name, kind)
        refused(load, tmp_path / name, "is not a regular file" if kind != "sparse" else "has 100,000,000,000 bytes")


# Checkpoints

MU = "[1][0][0].mu.gaussians.means"
EVENTS = "[1][0][2]"


@pytest.fixture(scope="module", params=["a2tg", pytest.param("bytewise", marks=pytest.mark.long)])
def checkpoint_file(request, tmp_path_factory):
    system = {"a2tg": a2tg.A2tg(sh_degree=0), "bytewise": Bytewise()}[request.param]
    path = tmp_path_factory.mktemp(request.param) / "c.npz"
    save_checkpoint(path, some_checkpoint(system))
    return path


@pytest.fixture
def checkpoint(checkpoint_file, tmp_path):
    path = tmp_path / "c.npz"
    path.write_bytes(checkpoint_file.read_bytes())
    return path


def test_a_whole_checkpoint_loads(checkpoint):
    found = load_checkpoint(checkpoint)
    assert found.iteration == 0 and found.model.num == NUM - 2


@pytest.mark.long
def test_every_array_of_another_shape_is_refused(checkpoint):
    """Whichever it is: of Gaussians, what they show, moments, events, counters, history."""
    _, arrays = read_archive(checkpoint)
    whole = checkpoint.read_bytes()
    assert len(arrays) > 20
    for name in arrays:
        for change in (lambda x: x[..., None], lambda x: x.ravel()[1:] if x.size > 1 else np.append(x, x)):
            checkpoint.write_bytes(whole)
            spoiled(checkpoint, with_array(name, change))
            with pytest.raises(ValueError, match=r"c\.npz: "):
                load_checkpoint(checkpoint)
        checkpoint.write_bytes(whole)
        spoiled(checkpoint, lambda _, a, name=name: a.pop(name))
        with pytest.raises(ValueError, match=r"c\.npz: "):
            load_checkpoint(checkpoint)


@pytest.mark.long
def test_every_array_of_nan_is_refused(checkpoint):
    _, arrays = read_archive(checkpoint)
    whole = checkpoint.read_bytes()
    floats = [name for name, array in arrays.items() if array.size and array.dtype.kind == "f"]
    assert len(floats) > 10
    for name in floats:
        checkpoint.write_bytes(whole)
        spoiled(checkpoint, with_number(name, np.nan))
        with pytest.raises(ValueError, match=r"c\.npz: .*NaN|must be finite"):
            load_checkpoint(checkpoint)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (with_header(stage=-1), r"stage must be a number in 0\.\."),
        (with_header(stage=7), r"stage must be a number in 0\.\."),
        (with_header(stage=True), r"stage must be a number in 0\.\."),
        (with_header(stage="0"), r"stage must be a number in 0\.\."),
        (with_header(is_ahead=[True] * 9), "is_ahead must hold"),
        (with_header(is_ahead=3), "is_ahead must hold"),
        (with_header(is_ahead=[1]), "is_ahead must hold"),
        (with_header(system=3), "damaged or of another version"),
        (with_header(system={"name": ["a2tg"], "options": {}}), "damaged|not known here"),
        (with_header(system={"name": "os:system", "options": {}}), "not known here"),
        (with_header(num_restored=-2), "num_restored must be a whole number"),
        (with_header(num_restored="many"), "num_restored must be a whole number"),
        (with_array("[1][0][1]", lambda x: x + 1000), "num_live must be a whole number in 0..12; got"),
        (with_array("[1][0][1]", lambda x: x - 1000), "num_live must be a whole number in 0..12; got"),
        (with_array("[1][0][3]", lambda x: x + 10**9), "iteration must be a whole number in"),
        (with_array("[1][0][3]", lambda x: x - 1), "iteration must be a whole number in"),
        (with_array("[1][0][4]", lambda x: x + 9), "status must be a whole number in 0..4"),
        (with_array("[1][0][0].count", lambda x: x - 9), "moments.count must be at least 0; some are below"),
        (with_number("[1][0][0].nu.gaussians.quats", -1.0), "must be at least 0; .* rows have negative or NaN"),
        (with_array(MU, lambda x: x.astype(np.int32)), "must be float32; got int32"),
        (with_array("[1][1]['iteration']", lambda x: x - 5), "history.iteration must be at least 0"),
    ],
)
def test_checkpoints_out_of_range(checkpoint, change, message):
    spoiled(checkpoint, change)
    refused(load_checkpoint, checkpoint, message)


@pytest.mark.parametrize("data", [3, None, [], "a2tg", {}, {"name": "a2tg"}, {"name": ["a2tg"], "options": {}}])
def test_systems_that_are_none(data):
    with pytest.raises(ValueError, match=r"m\.npz: does not name its system"):
        system_from_dict(data, "m.npz")


# Archives that lie


def member(dtype="<f4", shape="(3,)", data=b"\0" * 12, header=None):
    """The bytes of an .npy that says anything of itself."""
    text = header or f"{{'descr': {dtype!r}, 'fortran_order': False, 'shape': {shape}, }}"
    return b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text.encode() + data


def archive(path, compression=zipfile.ZIP_STORED, **members):
    with zipfile.ZipFile(path, "w", compression) as file:
        for name, data in members.items():
            file.writestr(f"{name}.npy", data)


def pickled():
    buffer = io.BytesIO()
    np.save(buffer, np.asarray([{"a": 1}], object), allow_pickle=True)
    return buffer.getvalue()


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (member(shape="(10000000000,)"), "claims the shape"),
        (member(shape=f"({2**62}, {2**62})"), "claims the shape"),
        (member(shape="(2,)"), "claims the shape"),
        (member(shape="(-3,)"), "has no shape"),
        (member(shape="(3.0,)"), "has no shape"),
        (member(shape="3"), "has no shape"),
        (member(shape="(" + "0," * 40 + ")", data=b""), "has no shape"),
        (member(dtype="|O"), "must be of plain numbers"),
        (member(dtype="<U3"), "must be of plain numbers"),
        (member(dtype="<c8"), "must be of plain numbers"),
        (member(dtype="<f16"), "must be of plain numbers"),
        (member(header="[" * 3000), ""),
        (member(header="{'descr': __import__('os').system('true'), 'fortran_order': False, 'shape': (3,)}"), ""),
        (member(header="{'shape': (3,)}"), "descr"),
        (b"\x93NUMPY\x09\x00" + b"\0" * 40, "version"),
        (b"\x93NUMPY\x02\x00" + b"\xff" * 40, "has a header of"),
        (pickle.dumps([1]), ""),
        (pickled(), "must be of plain numbers"),
        (b"", ""),
    ],
)
def test_arrays_that_lie_are_refused_before_room_is_made(tmp_path, data, message):
    path = tmp_path / "a.npz"
    archive(path, a=data)
    tracemalloc.start()
    try:
        with pytest.raises(ValueError, match=message or None) as caught:
            read_npz(path)
        assert tracemalloc.get_traced_memory()[1] < 4e6 and "\n" not in str(caught.value)
    finally:
        tracemalloc.stop()


def test_archives_that_unpack_to_too_much_are_refused(tmp_path):
    zeros = member(shape=f"({10**7},)", data=bytes(4 * 10**7))
    archive(tmp_path / "a.npz", zipfile.ZIP_DEFLATED, a=zeros)
    with pytest.raises(ValueError, match="would take more than the file may hold"):
        read_npz(tmp_path / "a.npz")
    archive(tmp_path / "b.npz", a=zeros)
    assert read_npz(tmp_path / "b.npz")["a"].shape == (10**7,)


def test_arrays_come_back_as_numpy_reads_them(tmp_path):
    arrays = {
        "c": np.arange(24.0).reshape(2, 3, 4), "f": np.asfortranarray(np.arange(6, dtype=np.int16).reshape(2, 3)),
        "big": np.arange(3, dtype=">f8"), "scalar": np.asarray(True), "none": np.zeros((0, 4), np.uint8),
    }  # fmt: skip
    np.savez_compressed(tmp_path / "a.npz", **arrays)
    found = read_npz(tmp_path / "a.npz", lambda name: name != "c")
    assert set(found) == set(arrays) - {"c"}
    for name, array in found.items():
        np.testing.assert_array_equal(array, arrays[name])
        assert array.dtype == arrays[name].dtype.newbyteorder("=") and array.flags.writeable


@pytest.mark.parametrize(
    "text", ["NaN", "[Infinity]", "1e999", "[" * 10**5, "[" * 70 + "]" * 70, "1" * 26, "{", b"\xff\xfe\xfd", ""]
)
def test_json_that_is_none_is_one_error(text):
    with pytest.raises(ValueError):
        parse_json(text)


def test_json_of_pythons_own_library_is_read():
    assert np.isnan(parse_json("NaN", allow_nan=True)) and parse_json("[1e999]", allow_nan=True) == [np.inf]
    assert parse_json(b'\xef\xbb\xbf{"a": [1, -2.5e3, 18446744073709551616]}') == {"a": [1, -2500.0, 2**64]}


# PLY and weights


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_ply_with_numbers_that_are_not_finite(tmp_path, value):
    path = tmp_path / "g.ply"
    save_ply(path, some_gaussians())
    whole = path.read_bytes()
    number = np.float32(value).tobytes()
    path.write_bytes(whole[:-4] + number)
    with pytest.warns(UserWarning, match=f"1 Gaussian of {NUM} left out"):
        assert load_ply(path).num == NUM - 1
    start = whole.index(b"end_header\n") + len(b"end_header\n")
    path.write_bytes(whole[:start] + number * ((len(whole) - start) // 4))
    refused(load_ply, path, r"gaussians\.\w+ must be finite")


@pytest.mark.parametrize("count", [2**64 - 1, 2 * 10**9, 13])
def test_ply_that_claims_more_than_there_is(tmp_path, count):
    path = tmp_path / "g.ply"
    save_ply(path, some_gaussians())
    path.write_bytes(path.read_bytes().replace(b"element vertex 12", f"element vertex {count}".encode()))
    refused(load_ply, path, "is cut off")


def test_lpips_weights_of_nan_are_refused(tmp_path):
    path = tmp_path / "w.npz"
    archive(path, **{"features.0.weight": member(), "lin0.weight": member()})
    refused(load_lpips, path, "does not hold LPIPS weights")
    archive(path, a=member(shape="(5,)"))
    with pytest.raises(ValueError, match=r"is not an \.npz archive of LPIPS weights"):
        load_lpips(path)
