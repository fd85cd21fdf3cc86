"""Files of other programs are upright, whatever the axes of the capture; what they show does not change."""

import dataclasses
import json

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from small_values import assert_same, some_gaussians, some_world

import a2tg_jax as a2tg
from a2tg_jax import Camera, Origin, Similarity
from a2tg_jax.cli.main import main
from a2tg_jax.core.origin import vertical_of
from a2tg_jax.data.capture_geometry import upright_rotation

UP_AXES = [sign * axis for axis in np.eye(3) for sign in (1, -1)]
FILE_UP = np.array([0.0, -1.0, 0.0])


def captured(to_original: Similarity, num: int = 12) -> a2tg.Model:
    """A model whose cameras look down at it, in a world with +z up; `to_original` leads from there."""
    cameras = []
    K = jnp.asarray([[60.0, 0, 32], [0, 60, 24], [0, 0, 1]])
    for angle in np.linspace(0, 2 * np.pi, num, endpoint=False):
        outward = np.array([np.cos(angle), np.sin(angle), 0.5 + 0.3 * np.sin(3 * angle)])
        viewmat = a2tg.look_at(4 * outward, np.zeros(3), width=64, height=48).viewmat
        cameras.append(Camera(viewmat, K, 64, 48))
    origin = Origin.of_cameras(cameras, transform=to_original.inverse())
    return a2tg.Model(some_gaussians(60), background=(0.2, 0.4, 0.6), origin=origin)


@pytest.mark.parametrize("up", UP_AXES)
def test_axes_of_a_known_vertical_only_change_their_names(up):
    turn = upright_rotation(up)
    np.testing.assert_array_equal(turn @ up, FILE_UP)
    np.testing.assert_array_equal(np.abs(turn).sum(axis=0), 1)
    assert np.linalg.det(turn) == 1
    near = up + np.array([0.03, -0.02, 0.01])
    rotated = upright_rotation(near)
    np.testing.assert_allclose(rotated @ near / np.linalg.norm(near), FILE_UP, atol=1e-12)
    # No jump of the heading, also about the axis opposite to the file's.
    assert Rotation.from_matrix(rotated @ turn.T).magnitude() < 0.05


def test_pictures_of_an_upright_file_are_the_same(tmp_path):
    """Of degree 3, in a capture that is tilted; cameras are carried along, and the file knows the way back."""
    model = captured(some_world())
    settings = a2tg.RenderSettings()
    a2tg.save_ply(tmp_path / "a.ply", model, world="upright")
    found = a2tg.load_splats(tmp_path / "a.ply")
    to_file = model.origin.transform.inverse().then(found.origin.transform)
    carried = [to_file.apply_to_viewmat(viewmat) for viewmat in model.origin.viewmats]
    np.testing.assert_allclose(vertical_of(np.stack(carried)), FILE_UP, atol=1e-6)
    for viewmat, camera in list(zip(carried, model.origin.cameras, strict=True))[::4]:
        moved = dataclasses.replace(camera, viewmat=jnp.asarray(viewmat, jnp.float32))
        picture = found.render(moved, settings=settings.transform(to_file), background=model.background).color
        wanted = model.render(camera, settings=settings).color
        assert np.ptp(np.asarray(wanted)) > 0.2
        np.testing.assert_allclose(picture, wanted, atol=1e-5)
    # A second export is upright, too, and one in the original world is what it would have been.
    a2tg.save_ply(tmp_path / "b.ply", found, world="upright")
    assert_same(a2tg.load_ply(tmp_path / "b.ply"), a2tg.load_ply(tmp_path / "a.ply"), atol=1e-5)
    for name, source in (("c.ply", found), ("d.ply", model)):
        a2tg.save_ply(tmp_path / name, source)
    back, direct = (a2tg.load_ply(tmp_path / name) for name in ("c.ply", "d.ply"))
    np.testing.assert_allclose(back.means, direct.means, atol=1e-5)
    np.testing.assert_allclose(back.sh, direct.sh, atol=1e-5)


def test_gltf_and_meshes_have_the_vertical_of_splats(tmp_path):
    """Not the cameras' mean up; without cameras −y is up, as in the viewer."""
    model = captured(some_world())
    half = Origin.of_cameras(model.origin.cameras[:7], transform=model.origin.transform)
    assert np.abs(half.viewmats[:, 1, :3].mean(axis=0))[:2].max() > 0.1
    for origin, up in ((half, [0, 0, 1]), (None, FILE_UP)):
        a2tg.save_gltf(tmp_path / "m.glb", dataclasses.replace(model, origin=origin))
        np.testing.assert_allclose(
            node_matrix(tmp_path / "m.glb")[:3, :3] @ up,
            [0, half.transform.scale**-1, 0] if origin else [0, 1, 0],
            atol=1e-6,
        )
        assert a2tg.load_gltf(tmp_path / "m.glb").origin == origin
    triangle = a2tg.Mesh(np.eye(3), np.array([[0, 1, 2]], np.int32))
    a2tg.save_mesh(tmp_path / "n.glb", triangle, half)
    a2tg.save_gltf(tmp_path / "m.glb", dataclasses.replace(model, origin=half))
    np.testing.assert_array_equal(node_matrix(tmp_path / "n.glb"), node_matrix(tmp_path / "m.glb"))


def node_matrix(path) -> np.ndarray:
    glb = path.read_bytes()
    described = json.loads(glb[20 : 20 + int.from_bytes(glb[12:16], "little")])
    return np.reshape(described["nodes"][0]["matrix"], (4, 4)).T


@pytest.mark.parametrize("suffix", [".splat", ".ksplat", ".spz", ".sog", ".compressed.ply"])
def test_all_formats_have_the_same_axes(tmp_path, suffix):
    model = captured(some_world())
    a2tg.save_ply(tmp_path / "a.ply", model, world="upright")
    a2tg.save_splats(tmp_path / f"a{suffix}", model, world="upright")
    wanted, found = (a2tg.load_splats(tmp_path / f"a{name}") for name in (".ply", suffix))
    means = np.asarray(found.gaussians.means)
    nearest = np.linalg.norm(means[:, None] - np.asarray(wanted.gaussians.means), axis=-1).min(axis=0)
    assert nearest.max() < 0.01
    if suffix in (".sog", ".compressed.ply"):
        np.testing.assert_allclose(found.origin.transform.rotation, wanted.origin.transform.rotation, atol=1e-12)


@pytest.mark.filterwarnings("ignore:.*positions are relative to")
def test_what_is_upright_is_not_touched(tmp_path, capsys):
    """A capture whose y points down, splats without cameras, and map coordinates."""
    down = Similarity(2.0, upright_rotation(np.array([0.0, 0.0, 1.0])), np.zeros(3))
    far = Similarity(1.0, some_world().rotation, np.array([431234.5, 5411222.25, 312.0]))
    lines = {
        "capture": (captured(down), "world: upright with +y down, which is the original one"),
        "splats": (a2tg.Model(some_gaussians()), "has no cameras to find the vertical by"),
        "map": (captured(far), "world: the original one, because of its map coordinates"),
    }
    for name, (model, line) in lines.items():
        a2tg.save_model(tmp_path / f"{name}.npz", model)
        files = [tmp_path / f"{name}-{world}.ply" for world in ("upright", "original")]
        assert main(["convert", str(tmp_path / f"{name}.npz"), str(files[0])]) == 0
        assert line in capsys.readouterr().out
        assert main(["convert", str(tmp_path / f"{name}.npz"), str(files[1]), "--world", "original"]) == 0
        assert files[0].read_bytes() == files[1].read_bytes()


def test_the_command_line_says_how_a_file_was_turned(tmp_path, capsys):
    tilted = Similarity(1.0, Rotation.from_euler("x", 90 + 36.4, degrees=True).as_matrix(), np.zeros(3))
    a2tg.save_model(tmp_path / "m.npz", captured(tilted))
    assert main(["convert", str(tmp_path / "m.npz"), str(tmp_path / "a.ply")]) == 0
    assert "world: upright with +y down, the original one turned by 36.4°" in capsys.readouterr().out
    assert b"comment rotation 0.9" in (tmp_path / "a.ply").read_bytes()[:400]
    arguments = ["convert", str(tmp_path / "m.npz"), str(tmp_path / "m.glb"), "--world", "original"]
    assert main(arguments) == 2
    assert "--world has no effect on" in capsys.readouterr().err


def test_a_world_of_another_name_is_refused(tmp_path):
    for write in (a2tg.save_ply, a2tg.save_splats):
        with pytest.raises(ValueError, match="world must be one of upright, original; got 'up'"):
            write(tmp_path / "a.ply", a2tg.Model(some_gaussians()), world="up")
