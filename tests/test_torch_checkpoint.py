"""Checkpoints of PyTorch are read and written without PyTorch, and nothing that they pickle is run."""

import dataclasses
import io
import os
import pickle
import sys
import tracemalloc
import types
import zipfile
from collections import OrderedDict

import numpy as np
import pytest
from small_values import assert_same, some_gaussians, some_world

from a2tg_jax import Model, load_splats, save_splats, to_gsplat
from a2tg_jax.core.origin import Origin
from a2tg_jax.io.torch_checkpoint import STORAGES

UTILS, TORCH = types.ModuleType("torch._utils"), types.ModuleType("torch")


def _named(module, name):
    """A function or class that is pickled by the name that PyTorch gives it."""
    function = type(name, (), {"__module__": module.__name__, "__qualname__": name})
    setattr(module, name, function)
    return function


REBUILD, PARAMETER, FLOATS = (
    _named(UTILS, "_rebuild_tensor_v2"),
    _named(UTILS, "_rebuild_parameter"),
    _named(TORCH, "FloatStorage"),
)


class Tensor:
    """A tensor as PyTorch pickles it; `lie` changes what it says of itself."""

    dtype = "<f4"

    def __init__(self, array, lie=lambda *printed: printed):
        self.array, self.lie = np.ascontiguousarray(array, self.dtype), lie

    def __reduce__(self):
        strides = tuple(stride // self.array.itemsize for stride in self.array.strides)
        data = _Call(REBUILD, self.lie(_Storage(self.array), 0, self.array.shape, strides), (False, OrderedDict()))
        return PARAMETER, (data, True, OrderedDict())


class _Call:
    def __init__(self, function, printed, rest):
        self.function, self.arguments = function, (*printed, *rest)

    def __reduce__(self):
        return self.function, self.arguments


class _Storage:
    def __init__(self, array):
        self.array = array


def write_checkpoint(path, value):
    """A file as torch.save writes it."""
    storages, buffer = [], io.BytesIO()

    class Pickler(pickle._Pickler):
        def persistent_id(self, found):
            if not isinstance(found, _Storage):
                return None
            storages.append(found.array)
            return "storage", FLOATS, str(len(storages) - 1), "cpu", found.array.size

    modules = {"torch": TORCH, "torch._utils": UTILS}
    before = {name: sys.modules.get(name) for name in modules}
    sys.modules.update(modules)
    try:
        Pickler(buffer, 2).dump(value)
    finally:
        for name, module in before.items():
            sys.modules.pop(name) if module is None else sys.modules.update({name: module})
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("archive/data.pkl", buffer.getvalue())
        archive.writestr("archive/byteorder", b"little")
        for index, array in enumerate(storages):
            archive.writestr(f"archive/data/{index}", array.tobytes())


def tensors(third: bool = True) -> dict:
    g = some_gaussians()
    scales = np.asarray(g.log_scales)
    scales = np.concatenate([scales, scales.min(1, keepdims=True) - 7], 1) if third else scales
    return {
        "means": Tensor(g.means), "quats": Tensor(g.quats), "scales": Tensor(scales),
        "opacities": Tensor(g.logit_opacities), "sh0": Tensor(g.sh[:, :1]), "shN": Tensor(g.sh[:, 1:]),
    }  # fmt: skip


def as_nerfstudio() -> dict:
    names = {"sh0": "features_dc", "shN": "features_rest"}
    own = {f"_model.gauss_params.{names.get(name, name)}": tensor for name, tensor in tensors().items()}
    return {"step": 3, "pipeline": own}


def as_2dgs() -> tuple:
    t = tensors(third=False)
    own = (3, t["means"], t["sh0"], t["shN"], t["scales"], t["quats"], t["opacities"])
    return (*own, Tensor(np.zeros(7)), Tensor(np.zeros(7)), Tensor(np.zeros(7)), {"state": {}}, np.float64(2.0)), 30_000


@pytest.mark.parametrize("kind", ["gsplat", "nerfstudio", "2dgs"])
def test_gaussians_of_checkpoints(tmp_path, kind):
    value = {"gsplat": {"step": 7, "splats": OrderedDict(tensors())}, "nerfstudio": as_nerfstudio(), "2dgs": as_2dgs()}
    write_checkpoint(tmp_path / "a.pt", value[kind])
    assert_same(load_splats(tmp_path / "a.pt").gaussians, some_gaussians())


def test_coefficients_above_degree_3_are_left_out_with_a_warning(tmp_path):
    more = Tensor(np.concatenate([some_gaussians().sh[:, 1:], np.ones((7, 9, 3))], axis=1))
    write_checkpoint(tmp_path / "a.pt", {"splats": {**tensors(), "shN": more}})
    with pytest.warns(UserWarning, match="has SH of degree 4; degree 3 is read"):
        assert_same(load_splats(tmp_path / "a.pt").gaussians, some_gaussians())


@pytest.mark.parametrize("value", [np.nan, 1e13])
def test_gaussians_that_cannot_be_drawn_are_left_out_and_counted(tmp_path, value):
    means = np.array(some_gaussians().means)
    means[3, 1] = value
    write_checkpoint(tmp_path / "a.pt", {"splats": {**tensors(), "means": Tensor(means)}})
    with pytest.warns(UserWarning, match=r"a\.pt: 1 Gaussian of 7 left out.*first is row 3"):
        assert_same(load_splats(tmp_path / "a.pt").gaussians, some_gaussians()[np.array([0, 1, 2, 4, 5, 6])])


@pytest.mark.parametrize("kind", ["gsplat", "nerfstudio"])
def test_the_filter_of_mip_splatting_is_applied_and_other_tensors_are_named(tmp_path, kind):
    width, folder = np.linspace(0, 0.3, 7)[:, None], "" if kind == "gsplat" else "_model.gauss_params."
    value = {"splats": tensors()} if kind == "gsplat" else as_nerfstudio()
    own = value["splats" if kind == "gsplat" else "pipeline"]
    own |= {f"{folder}filter_3D": Tensor(width), f"{folder}beta": Tensor(width)}
    write_checkpoint(tmp_path / "a.pt", {**value, "camera_opt": {"embeds.weight": Tensor(width)}})
    with pytest.warns(UserWarning) as told:
        found = load_splats(tmp_path / "a.pt").gaussians
    assert [str(one.message).rpartition("a.pt: ")[2][:20] for one in told] == [
        "does not read beta; ",
        "holds 3D Gaussians (",
    ]
    g = some_gaussians()
    scales = np.concatenate([g.scales, np.exp(g.log_scales.min(1, keepdims=True) - 7)], axis=1).astype(float)
    drawn = np.sqrt(scales**2 + width**2)
    np.testing.assert_allclose(found.scales, drawn[:, :2], rtol=1e-5)
    np.testing.assert_allclose(found.opacities, g.opacities * np.prod(scales / drawn, axis=1), rtol=1e-4)


def test_entries_beyond_those_of_3dgs_are_named(tmp_path):
    """RaDe-GS appends a network and embeddings for the appearance of photographs."""
    parts, iteration = as_2dgs()
    write_checkpoint(
        tmp_path / "a.pt", ((*parts, {"weight": Tensor(np.zeros(3))}, Tensor(np.zeros((5, 64)))), iteration)
    )
    with pytest.warns(UserWarning, match="does not read entry 12 of its tuple, entry 13 of its tuple; if"):
        assert_same(load_splats(tmp_path / "a.pt").gaussians, some_gaussians())


def test_counts_that_differ_are_named_and_none_are_an_empty_model(tmp_path):
    write_checkpoint(tmp_path / "a.pt", {"splats": {**tensors(), "quats": Tensor(np.zeros((6, 4)))}})
    with pytest.raises(ValueError, match=r"a\.pt: has 7 means, but 6 quats"):
        load_splats(tmp_path / "a.pt")
    none = {name: Tensor(np.asarray(tensor.array)[:0]) for name, tensor in tensors().items()}
    write_checkpoint(tmp_path / "a.pt", {"splats": none})
    assert load_splats(tmp_path / "a.pt").num == 0


class Harm:
    def __reduce__(self):
        return os.system, ("touch harmed",)


def reaching(storage, offset, size, stride):
    return storage, offset + 1, size, stride


HOSTILE = {
    "pickles": {"splats": {**tensors(), "more": Harm()}},
    "reaches beyond": {"splats": {**tensors(), "means": Tensor(np.zeros((7, 3)), reaching)}},
    "negative": {"splats": {**tensors(), "means": Tensor(np.zeros((7, 3)), lambda s, o, n, t: (s, o, n, (-1, 1)))}},
    "no means": {"splats": {name: tensor for name, tensor in tensors().items() if name != "means"}},
    "PyTorch checkpoint": {"splats": {**tensors(), "means": Tensor(np.zeros((7, 3)), lambda s, o, n, t: (s, o, 3, t))}},
    "coefficients": {"splats": {**tensors(), "shN": Tensor(np.zeros((7, 5, 3)))}},
    "finite": {"splats": {**tensors(), "means": Tensor(np.full((7, 3), np.nan))}},
}


@pytest.mark.parametrize("message", HOSTILE)
def test_anything_else_is_refused_in_one_line(tmp_path, monkeypatch, message):
    monkeypatch.chdir(tmp_path)
    write_checkpoint(tmp_path / "a.pt", HOSTILE[message])
    with pytest.raises(ValueError, match=message) as raised:
        load_splats(tmp_path / "a.pt")
    assert "a.pt" in str(raised.value) and "\n" not in str(raised.value) and not (tmp_path / "harmed").exists()


def write_pickle(path, data, byteorder=b"little"):
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("archive/data.pkl", data)
        archive.writestr("archive/byteorder", byteorder)


def nested_dictionaries(num: int = 12, depth: int = 5) -> dict:
    """Dictionaries that refer to one another many times."""
    value: dict = {}
    for _ in range(depth):
        value = dict.fromkeys(map(str, range(num)), value)
    return value


RAW = {
    "memo": b"\x80\x02}r\xff\xff\xff\x7f.",
    "big-endian": b"\x80\x02}.",
    "more than 10,000 values": pickle.dumps(nested_dictionaries(), 2),
    "type ComplexFloatStorage": b"\x80\x02ctorch\nComplexFloatStorage\n.",
    "type UntypedStorage": b"\x80\x02ctorch.storage\nUntypedStorage\n.",
    "no means": b"\x80\x02}q\x00X\x01\x00\x00\x00ah\x00s.",  # A dictionary in itself.
}


@pytest.mark.parametrize("message", RAW)
def test_pickles_that_ask_for_too_much_are_refused(tmp_path, message):
    write_pickle(tmp_path / "a.pt", RAW[message], bytes(1 << 26) if message == "big-endian" else b"little")
    tracemalloc.start()
    try:
        with pytest.raises(ValueError, match=message):
            load_splats(tmp_path / "a.pt")
        assert tracemalloc.get_traced_memory()[1] < 1 << 24
    finally:
        tracemalloc.stop()


def test_numbers_of_16_bits(tmp_path, monkeypatch):
    """Upper halves of floats, as PyTorch calls bfloat16."""
    monkeypatch.setitem(STORAGES, "FloatStorage", STORAGES["BFloat16Storage"])
    monkeypatch.setattr(Tensor, "dtype", STORAGES["BFloat16Storage"])
    write_checkpoint(tmp_path / "a.pt", {"splats": tensors()})
    found = load_splats(tmp_path / "a.pt").gaussians
    np.testing.assert_allclose(found.means, some_gaussians().means, rtol=2**-8)


def test_files_that_are_no_zip_are_refused(tmp_path):
    (tmp_path / "a.pt").write_bytes(b"\x80\x02}q\x00.")
    with pytest.raises(ValueError, match=r"PyTorch checkpoint \(1\.6"):
        load_splats(tmp_path / "a.pt")


# Written


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
    assert_same(load_splats(tmp_path / "a.pt").gaussians, gaussians)


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
    back = load_splats(tmp_path / "a.ckpt").gaussians
    assert_same(dataclasses.replace(back, sh=back.sh[:, : gaussians.sh.shape[1]]), gaussians)
    assert not back.sh[:, gaussians.sh.shape[1] :].any()


def test_written_checkpoints_are_in_the_worlds_of_ply_files(tmp_path):
    model = Model(some_gaussians(), origin=Origin.of_cameras([], transform=some_world()))
    for world in ("original", "upright"):
        save_splats(tmp_path / "a.pt", model, world=world)
        save_splats(tmp_path / "a.ply", model, world=world)
        assert_same(load_splats(tmp_path / "a.pt").gaussians, load_splats(tmp_path / "a.ply").gaussians)
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
        found, wanted = torch.load(tmp_path / name, weights_only=True), unpickled(tmp_path / name)
        key = "pipeline" if name == "a.ckpt" else "splats"
        for own, array in wanted[key].items():
            np.testing.assert_array_equal(found[key][own].numpy(), array)
