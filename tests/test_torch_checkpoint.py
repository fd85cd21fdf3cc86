"""Checkpoints of PyTorch are written without PyTorch, and not read."""

import dataclasses
import io
import pickle
import zipfile
from collections import OrderedDict

import numpy as np
import pytest
from small_values import assert_same, some_gaussians, some_world

from a2tg_jax import Gaussians, Model, Origin, load_splats, save_splats, to_gsplat


class PlainUnpickler(pickle.Unpickler):
    """What `torch.load(weights_only=True)` does, by NumPy: it calls these functions only."""

    def __init__(self, archive):
        super().__init__(io.BytesIO(archive.read("archive/data.pkl")))
        self.archive = archive

    def find_class(self, module, name):
        return {
            "torch.FloatStorage": "<f4",
            "torch._utils._rebuild_tensor_v2": self.tensor,
            "collections.OrderedDict": OrderedDict,
        }[f"{module}.{name}"]

    def persistent_load(self, pid):
        kind, dtype, key, device, num = pid
        numbers = np.frombuffer(self.archive.read(f"archive/data/{key}"), dtype)
        assert (kind, device, num) == ("storage", "cpu", len(numbers))
        return numbers

    def tensor(self, storage, offset, size, stride, requires_grad, hooks):
        assert (offset, requires_grad, hooks) == (0, False, OrderedDict())
        array = storage.reshape(size)
        assert not array.size or stride == tuple(own // 4 for own in array.strides)
        return array


def unpickled(path):
    with zipfile.ZipFile(path) as archive:
        names = {name for name in archive.namelist() if "/data/" not in name}
        assert names == {"archive/data.pkl", "archive/byteorder", "archive/version"}
        assert archive.read("archive/byteorder") == b"little" and archive.testzip() is None
        return PlainUnpickler(archive).load()


def of_degree(degree):
    return dataclasses.replace(some_gaussians(), sh=some_gaussians().sh[:, : (degree + 1) ** 2])


@pytest.mark.parametrize("degree", [0, 3])
def test_written_checkpoints_have_the_names_and_shapes_of_gsplat(tmp_path, degree):
    gaussians = of_degree(degree)
    save_splats(tmp_path / "a.pt", Model(gaussians))
    found = unpickled(tmp_path / "a.pt")
    assert [*found] == ["step", "splats"] and found["step"] == 0
    third = np.asarray(gaussians.log_scales).min(axis=1, keepdims=True) + np.log(1e-3)
    wanted = {
        "means": gaussians.means, "quats": gaussians.quats, "scales": np.concatenate([gaussians.log_scales, third], 1),
        "opacities": gaussians.logit_opacities, "sh0": gaussians.sh[:, :1], "shN": gaussians.sh[:, 1:],
    }  # fmt: skip
    given = to_gsplat(Model(gaussians))
    assert [*found["splats"]] == [*wanted] == [*given]
    for name, array in wanted.items():
        np.testing.assert_allclose(found["splats"][name], array, rtol=1e-6, err_msg=name)
        np.testing.assert_array_equal(found["splats"][name], given[name], err_msg=name)
        assert given[name].dtype == np.float32 and given[name].flags.writeable


@pytest.mark.parametrize("degree", [0, 3])
def test_written_checkpoints_of_nerfstudio_have_the_shapes_of_splatfacto(tmp_path, degree):
    """It makes features_rest of degree 3, and changes the number of rows alone when it loads."""
    gaussians = of_degree(degree)
    save_splats(tmp_path / "a.ckpt", Model(gaussians))
    found = unpickled(tmp_path / "a.ckpt")
    assert {name: found[name] for name in ("step", "optimizers", "scalers")} == {
        "step": 0,
        "optimizers": {},
        "scalers": {},
    }
    shapes = {name.removeprefix("_model.gauss_params."): array.shape for name, array in found["pipeline"].items()}
    assert shapes == {
        "means": (7, 3), "quats": (7, 4), "scales": (7, 3), "opacities": (7, 1), "features_dc": (7, 3),
        "features_rest": (7, 15, 3),
    }  # fmt: skip
    given = to_gsplat(Model(gaussians))
    for name, array in found["pipeline"].items():
        name = name.removeprefix("_model.gauss_params.")
        wanted = given[{"features_dc": "sh0", "features_rest": "shN"}.get(name, name)]
        if name == "features_rest":
            assert not array[:, wanted.shape[1] :].any()
            array = array[:, : wanted.shape[1]]
        np.testing.assert_array_equal(array.ravel(), wanted.ravel(), err_msg=name)


def test_written_checkpoints_are_in_the_worlds_of_ply_files(tmp_path):
    model = Model(some_gaussians(), origin=Origin.of_cameras([], transform=some_world()))
    for world in ("original", "upright"):
        save_splats(tmp_path / "a.pt", model, world=world)
        save_splats(tmp_path / "a.ply", model, world=world)
        splats = unpickled(tmp_path / "a.pt")["splats"]
        sh = np.concatenate([splats["sh0"], splats["shN"]], axis=1)
        columns = (splats["means"], splats["quats"], splats["scales"][:, :2], splats["opacities"], sh)
        assert_same(Gaussians(*columns), load_splats(tmp_path / "a.ply").gaussians)
    far = dataclasses.replace(some_world(), translation=np.array([0.0, 5e6, 0.0]))
    with pytest.warns(UserWarning, match="to_gsplat: positions are relative to"):
        assert (
            np.abs(to_gsplat(dataclasses.replace(model, origin=Origin.of_cameras([], transform=far)))["means"]).max()
            < 10
        )


def test_pytorch_opens_what_is_written(tmp_path):
    torch = pytest.importorskip("torch", reason="PyTorch is not installed")
    for name, model in (
        ("a.pt", Model(some_gaussians())),
        ("a.ckpt", Model(of_degree(1))),
        ("b.pt", Model(of_degree(0))),
    ):
        save_splats(tmp_path / name, model)
        found = torch.load(tmp_path / name, weights_only=True)
        wanted = unpickled(tmp_path / name)
        key = "pipeline" if name == "a.ckpt" else "splats"
        for own, array in wanted[key].items():
            np.testing.assert_array_equal(found[key][own].numpy(), array)


@pytest.mark.parametrize("suffix", [".pt", ".pth", ".ckpt"])
def test_checkpoints_are_refused_with_what_to_write_instead(tmp_path, suffix):
    path = tmp_path / f"a{suffix}"
    save_splats(path, Model(some_gaussians()))
    wanted = rf"a\{suffix}: a checkpoint can be written, but not read; write a PLY: gsplat does with --save_ply"
    with pytest.raises(ValueError, match=wanted):
        load_splats(path)
