"""Scenes in map coordinates: files hold their positions to a millimetre, and say what these are relative to."""

import dataclasses
import json
import struct
import warnings
import zipfile

import jax.numpy as jnp
import numpy as np
import pytest
from run_folders import create_run
from small_values import some_gaussians

import a2tg_jax as a2tg
from a2tg_jax import Origin, Similarity
from a2tg_jax.cli.main import main
from a2tg_jax.data.ply import read_ply_points
from a2tg_jax.io.other_programs import upright
from a2tg_jax.results.model_source import write_first_stage
from a2tg_jax.results.record import RunRecord, SceneSource

UTM = np.array([431234.5, 5411222.25, 312.0])
OFFSET = np.array([431234.0, 5411222.0, 312.0])
TURN = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
RNG = np.random.default_rng(7)


def map_scene(middle=UTM, scale=0.25) -> tuple[a2tg.Model, np.ndarray]:
    """A model of a run in metres of a map with splats of 0.1 m, and its means in the map, computed in float64."""
    gaussians = some_gaussians(40)
    means = RNG.uniform(-1, 1, (40, 3)).astype(np.float32)
    true = (means.astype(np.float64) @ TURN) / scale + middle  # The rotation is undone.
    gaussians = dataclasses.replace(
        gaussians,
        means=jnp.asarray(means),
        log_scales=jnp.full((40, 2), np.log(0.1 * scale), jnp.float32),
        sh=gaussians.sh * 0.1,
    )
    world = Similarity(scale, TURN, -scale * TURN @ middle)
    return a2tg.Model(gaussians, origin=Origin.of_cameras([], transform=world)), true


def ply_parts(data: bytes) -> tuple[list[str], np.ndarray]:
    """The comments and the vertices of a binary PLY, by this file's own reader."""
    head, _, body = data.partition(b"end_header\n")
    lines = head.decode().split("\n")
    kinds = {"float": "<f4", "double": "<f8", "uchar": "u1"}
    dtype = []
    num = 0
    for words in (line.split() for line in lines):
        if words[:1] == ["element"] and words[1] != "vertex":
            break
        if words[:1] == ["element"]:
            num = int(words[2])
        if words[:1] == ["property"]:
            dtype.append((words[2], kinds[words[1]]))
    comments = [line.removeprefix("comment ") for line in lines if line.startswith("comment ")]
    return comments, np.frombuffer(body, dtype, num)


def xyz(rows: np.ndarray) -> np.ndarray:
    return np.stack([rows[name].astype(np.float64) for name in "xyz"], axis=1)


def in_original_world(model: a2tg.Model) -> np.ndarray:
    return model.origin.transform.inverse().apply(np.asarray(model.gaussians.means, np.float64))


def positions_of_ply(path) -> np.ndarray:
    """The positions in a PLY, with the offset that it names."""
    comments, rows = ply_parts(path.read_bytes())
    (offset,) = (np.array(line.split()[1:], float) for line in comments if line.startswith("offset "))
    assert (offset == np.rint(offset)).all() and np.abs(xyz(rows)).max() < 10
    return xyz(rows) + offset


def farthest(found: np.ndarray, true: np.ndarray) -> float:
    """The largest distance of a true position from the nearest one found; files may change the order."""
    return float(np.linalg.norm(found[:, None] - true, axis=-1).min(axis=0).max())


def test_a_ply_of_map_coordinates_is_exact_with_the_offset_that_it_names(tmp_path):
    model, true = map_scene()
    with pytest.warns(UserWarning, match=r"a\.ply: positions are relative to \(43123\d, 541122\d, 31\d\)") as warned:
        a2tg.save_ply(tmp_path / "a.ply", model)
    assert len(warned) == 1
    assert np.abs(positions_of_ply(tmp_path / "a.ply") - true).max() < 1e-6
    _, rows = ply_parts((tmp_path / "a.ply").read_bytes())
    with pytest.warns(UserWarning, match="positions are relative to"):
        np.testing.assert_array_equal(a2tg.load_ply(tmp_path / "a.ply").means, xyz(rows).astype(np.float32))
    assert np.abs(read_ply_points(tmp_path / "a.ply").points - true).max() < 1e-6


def positions_in(data: bytes, suffix: str, num: int) -> np.ndarray:
    """The positions in a file: by their places in it, or as gaussforge reads it."""
    if suffix == ".splat":
        return np.frombuffer(data, "<f4").reshape(num, 8)[:, :3]
    if suffix == ".ksplat":  # Of compression 0: a header, one of a section, and rows that begin with the centres.
        rows = np.frombuffer(data[5120:], np.uint8).reshape(num, -1)
        return np.ascontiguousarray(rows[:, :12]).view("<f4")
    gaussforge = pytest.importorskip("gaussforge")
    read = gaussforge.GaussForge().read(data, suffix.removeprefix("."))["data"]
    return np.frombuffer(read["positions"], "<f4").reshape(-1, 3)


@pytest.mark.parametrize("suffix", [".splat", ".ksplat", ".sog", ".spz", ".compressed.ply", ".ply"])
def test_files_are_relative_to_an_offset_which_some_hold(tmp_path, suffix):
    model, true = map_scene()
    with pytest.warns(UserWarning, match="positions are relative to") as warned:
        a2tg.save_splats(tmp_path / f"a{suffix}", model)
    if suffix != ".ply":
        offset = str(warned[0].message).partition("(")[2].partition(")")[0]
        found = positions_in((tmp_path / f"a{suffix}").read_bytes(), suffix, model.num).astype(np.float64)
        assert np.abs(found).max() < 10
        most = 5e-3 if suffix == ".compressed.ply" else 1e-3  # 11 bits within chunks of 8 m.
        assert farthest(found + np.array([float(word) for word in offset.split(",")]), true) < most
    if suffix not in (".ply", ".compressed.ply", ".sog"):
        return
    again = a2tg.load_splats(tmp_path / f"a{suffix}")
    assert farthest(in_original_world(again), true) < 5e-3
    with pytest.warns(UserWarning, match="positions are relative to"):
        a2tg.save_ply(tmp_path / "b.ply", again)
    assert farthest(positions_of_ply(tmp_path / "b.ply"), true) < 5e-3


def test_sog_and_spz_hold_scenes_that_only_lie_far_away(tmp_path):
    """The header of the one has the offset; the other has no place for it."""
    with pytest.warns(UserWarning, match=r"'offset' in its meta\.json"):
        a2tg.save_splats(tmp_path / "a.sog", map_scene()[0])
    with zipfile.ZipFile(tmp_path / "a.sog") as archive:
        assert np.abs(np.array(json.loads(archive.read("meta.json"))["offset"]) - UTM).max() < 4
    with pytest.warns(UserWarning, match=r"relative to \(\d+, (0|-?[1-9]), (0|-?[1-9])\).*no place"):
        a2tg.save_splats(tmp_path / "a.spz", map_scene(np.array([3000.0, 0.0, 0.0]))[0])
    assert np.abs(a2tg.load_splats(tmp_path / "a.spz").gaussians.means).max() < 10


def test_world_coordinates_stay_whole_in_float64(tmp_path, capsys):
    model, true = map_scene()
    a2tg.save_model(tmp_path / "a.npz", model)
    assert main(["convert", str(tmp_path / "a.npz"), str(tmp_path / "a.ply"), "--float64"]) == 0
    comments, rows = ply_parts((tmp_path / "a.ply").read_bytes())
    assert rows.dtype["x"] == np.float64
    assert not any(line.startswith("offset") for line in comments)
    assert np.abs(xyz(rows) - true).max() < 1e-8
    assert np.abs(in_original_world(a2tg.load_splats(tmp_path / "a.ply")) - true).max() < 1e-6
    assert main(["convert", str(tmp_path / "a.npz"), str(tmp_path / "a.glb"), "--float64"]) != 0
    assert "--float64 needs an OUT that ends in .ply" in capsys.readouterr().err


def test_an_offset_that_is_no_number_is_refused_and_other_comments_are_ignored(tmp_path):
    a2tg.save_ply(tmp_path / "a.ply", some_gaussians(3))
    data = (tmp_path / "a.ply").read_bytes()
    for words, is_refused in (("offset nan 0 0", True), ("offset 1e300 0 0", True), ("offset by some metres", False)):
        (tmp_path / "b.ply").write_bytes(data.replace(b"comment Splat", f"comment {words}\ncomment Splat".encode()))
        if is_refused:
            with pytest.raises(ValueError, match=r"b\.ply: origin\.transform"):
                a2tg.load_ply(tmp_path / "b.ply")
        else:
            assert a2tg.load_splats(tmp_path / "b.ply").origin is None


@pytest.mark.parametrize("suffix", [".ply", ".compressed.ply", ".sog", ".spz", ".splat", ".ksplat"])
def test_scenes_near_the_origin_have_no_offset(tmp_path, suffix):
    """Also in a local grid a few hundred metres away, which float32 holds."""
    for middle in (np.zeros(3), np.array([3.0, -2.0, 1.0]), np.array([300.0, 200.0, 50.0])):
        model, true = map_scene(middle)
        with warnings.catch_warnings():
            if suffix == ".sog":  # Its steps grow with the distance.
                warnings.simplefilter("ignore")
            a2tg.save_splats(tmp_path / f"a{suffix}", model)
        assert b"offset" not in (tmp_path / f"a{suffix}").read_bytes()[:2000]
        assert a2tg.load_splats(tmp_path / f"a{suffix}").origin is None
        if suffix == ".ply":
            _, rows = ply_parts((tmp_path / "a.ply").read_bytes())
            np.testing.assert_array_equal(xyz(rows), true.astype(np.float32))


def test_float32_positions_far_away_are_not_moved(tmp_path):
    """A PLY of another program, in map coordinates that were rounded before, is written as it was read."""
    model, _ = map_scene()
    far = dataclasses.replace(model.gaussians, means=np.asarray(model.gaussians.means) + UTM.astype(np.float32))
    a2tg.save_ply(tmp_path / "a.ply", far)
    np.testing.assert_array_equal(a2tg.load_ply(tmp_path / "a.ply").means, far.means)


def json_of(glb: bytes) -> dict:
    return json.loads(glb[20 : 20 + struct.unpack("<I", glb[12:16])[0]])


def glb_positions(glb: bytes) -> np.ndarray:
    """The first accessor of a GLB file, which has the positions."""
    described = json_of(glb)
    count = described["accessors"][0]["count"]
    start = 28 + struct.unpack("<I", glb[12:16])[0] + described["bufferViews"][0]["byteOffset"]
    return np.frombuffer(glb, "<f4", 3 * count, start).reshape(count, 3).astype(np.float64)


def in_map(positions: np.ndarray, kept: dict) -> np.ndarray:
    """Positions of the model's world in the original one, as docs/formats.md says."""
    return (positions - kept["translation"]) @ np.array(kept["rotation"]) / kept["scale"]


def test_gltf_and_usd_lead_back_to_the_map(tmp_path):
    """Their positions are the model's; the origin beside them has the transform in float64."""
    model, true = map_scene()
    a2tg.save_gltf(tmp_path / "a.glb", model)
    glb = (tmp_path / "a.glb").read_bytes()
    kept = json_of(glb)["meshes"][0]["primitives"][0]["extras"]["a2tg"]["origin"]
    assert np.abs(in_map(glb_positions(glb), kept) - true).max() < 1e-6
    usd = pytest.importorskip("pxr.Usd", reason="usd-core is missing")
    a2tg.save_usd(tmp_path / "a.usdc", model)
    stage = usd.Stage.Open(str(tmp_path / "a.usdc"))
    prim = stage.GetPrimAtPath("/World/Splats")
    kept = json.loads(prim.GetCustomDataByKey("a2tg:origin"))
    assert np.abs(in_map(np.array(prim.GetAttribute("positions").Get(), float), kept) - true).max() < 1e-6


@pytest.mark.parametrize("suffix", [".glb", ".usda"])
def test_files_whose_nodes_lie_in_a_map_are_read_without_rounding(tmp_path, suffix):
    """Two sets of splats, the second 5 m above the first."""
    gaussians = some_gaussians(9)
    path = tmp_path / f"a{suffix}"
    if suffix == ".glb":
        a2tg.save_gltf(tmp_path / "near.gltf", a2tg.Model(gaussians))
        file = json.loads((tmp_path / "near.gltf").read_text())
        del file["nodes"][0]["matrix"]
        east = UTM[0]
        up = UTM[2]
        south = -UTM[1]
        file["nodes"] = [{"mesh": 0, "translation": [east, up + 5 * k, south]} for k in range(2)]
        file["scenes"][0]["nodes"] = [0, 1]
        path = tmp_path / "near.gltf"
        path.write_text(json.dumps(file))
    else:
        pytest.importorskip("pxr.Usd", reason="usd-core is missing")
        from pxr import Usd, UsdGeom

        a2tg.save_usd(tmp_path / "near.usda", a2tg.Model(gaussians))
        stage = Usd.Stage.CreateNew(str(path))
        UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
        UsdGeom.SetStageMetersPerUnit(stage, 1.0)
        for k in range(2):
            node = UsdGeom.Xform.Define(stage, f"/Part{k}")
            node.GetPrim().GetReferences().AddReference(str(tmp_path / "near.usda"))
            node.AddTranslateOp().Set(tuple(UTM + np.array([0, 0, 5.0 * k])))
        stage.Save()
    found = a2tg.load_splats(path)
    means = np.asarray(gaussians.means, np.float64)
    if suffix == ".glb":  # Numbers stand in the file as in the model, and +y is up there.
        means = means @ np.array([[1.0, 0, 0], [0, 0, 1.0], [0, -1.0, 0]])
    else:  # The referred file has −y of the model up.
        means = means @ upright(None, "z").rotation.T
    true = np.concatenate([means + UTM, means + UTM + [0, 0, 5]])
    assert np.abs(in_original_world(found) - true).max() < 1e-5


def test_meshes_hold_map_coordinates(tmp_path):
    """Near the origin they have nine digits and no extras."""
    model, true = map_scene()
    faces = np.arange(39, dtype=np.int32).reshape(13, 3)
    mesh = a2tg.Mesh(np.asarray(model.gaussians.means), faces, np.full((40, 3), 100, np.uint8))
    for suffix in (".ply", ".obj", ".glb"):
        a2tg.save_mesh(tmp_path / f"a{suffix}", mesh, model.origin.transform)
    _, rows = ply_parts((tmp_path / "a.ply").read_bytes())
    assert np.abs(xyz(rows) - true).max() < 1e-8
    lines = [line.split() for line in (tmp_path / "a.obj").read_text().splitlines() if line.startswith("v ")]
    assert np.abs(np.array([line[1:4] for line in lines], float) - true).max() < 1e-6
    glb = (tmp_path / "a.glb").read_bytes()
    assert np.abs(in_map(glb_positions(glb), json_of(glb)["nodes"][0]["extras"]["a2tg"]) - true).max() < 1e-6
    near = Similarity(0.25, TURN, np.zeros(3))
    for suffix in (".obj", ".glb"):
        a2tg.save_mesh(tmp_path / f"a{suffix}", mesh, near)
    words = (tmp_path / "a.obj").read_text().split()
    assert max(len(word.lstrip("-").replace(".", "").lstrip("0").partition("e")[0]) for word in words) <= 9
    assert "extras" not in json_of((tmp_path / "a.glb").read_bytes())["nodes"][0]


@pytest.mark.parametrize("name", ["a.npz", "a.ply", "b.ply"])
def test_training_in_a_map_starts_from_a_file_where_it_is(tmp_path, name):
    """The splats are at the places in the scene's normalised world that their map coordinates have there."""
    model, true = map_scene()
    a2tg.save_model(tmp_path / "a.npz", model)
    with pytest.warns(UserWarning, match="positions are relative to"):
        a2tg.save_ply(tmp_path / "a.ply", model)
    a2tg.save_ply(tmp_path / "b.ply", model, float64=True)
    world = Similarity(0.5, TURN.T, -0.5 * TURN.T @ (UTM + 1))
    scene = dataclasses.replace(a2tg.synthetic_scene(width=8, height=8, num_views=2, num_points=5), transform=world)
    record = RunRecord(SceneSource("synthetic"), "gaussians-2d", a2tg.Gaussians2d(), init=str(tmp_path / name))
    run = create_run(tmp_path / "run")
    write_first_stage(run, record, a2tg.load_splats(tmp_path / name), scene)
    found = a2tg.load_model(run.model(record.plan.names[0])).gaussians.means
    np.testing.assert_allclose(found, 0.5 * (true - UTM - 1) @ TURN, rtol=0, atol=1e-5)


def test_a_file_with_an_offset_is_shown_and_written_on(tmp_path, capsys):
    """It has an origin, and no cameras."""
    with pytest.warns(UserWarning, match="positions are relative to"):
        a2tg.save_ply(tmp_path / "a.ply", map_scene()[0])
    assert main(["export", str(tmp_path / "a.ply"), "--web", str(tmp_path / "a.html")]) == 0
    assert main(["convert", str(tmp_path / "a.ply"), str(tmp_path / "a.npz")]) == 0
    assert main(["compress", str(tmp_path / "a.npz"), "--out", str(tmp_path / "b.a2tgz")]) != 0
    assert "the model has no cameras" in capsys.readouterr().err
    assert main(["mesh", str(tmp_path / "a.npz")]) != 0
    assert "has no cameras to fuse depths from" in capsys.readouterr().err
    again = a2tg.load_model(tmp_path / "a.npz")
    assert again.origin == a2tg.load_splats(tmp_path / "a.ply").origin


def test_models_with_different_offsets_are_joined_with_a_warning_whose_advice_works(tmp_path):
    offsets = UTM, UTM + np.array([20.0, 0, 0])
    scenes = [map_scene(middle) for middle in offsets]
    for name, (model, _) in zip("ab", scenes, strict=True):
        a2tg.save_ply(tmp_path / f"{name}.ply", model, float64=True)
    models = [a2tg.load_splats(tmp_path / f"{name}.ply") for name in "ab"]
    with pytest.warns(UserWarning, match=r"models\[1\] is relative to another offset") as warned:
        a2tg.concatenate(models)
    move = eval(str(warned[0].message).partition("transform it by ")[2], {"models": models})
    joined = a2tg.concatenate([models[0], models[1].transform(move)])
    assert np.abs(in_original_world(joined) - np.concatenate([true for _, true in scenes])).max() < 1e-5
