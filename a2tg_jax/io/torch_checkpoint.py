"""PyTorch checkpoints of Gaussians (*.pt, *.ckpt, *.pth), without PyTorch and without running pickled code.

Since PyTorch 1.6 a checkpoint is a zip: a pickle that refers to storages, and an entry of plain numbers for each. The
pickle may name the functions that make tensors, ordered dictionaries and NumPy scalars, and nothing else.

It reads checkpoints of gsplat ({"splats": …}), of Nerfstudio's splatfacto ("…gauss_params.means", …), and of the
3DGS and 2DGS programs ((parameters, iteration)). It writes the first as *.pt and *.pth, the second as *.ckpt.
"""

import collections
import functools
import io
import math
import os
import pickle
import pickletools
import zipfile
from collections.abc import Callable, Iterator, Mapping
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from a2tg_jax.core.gaussians import Gaussians
from a2tg_jax.core.sh import NUM_BASES
from a2tg_jax.host.atomic import replacing
from a2tg_jax.host.regular_files import expanded, is_regular, open_regular
from a2tg_jax.host.text import shortened
from a2tg_jax.io.other_programs import (
    FILTER,
    World,
    degree_to_read,
    filtered,
    flat_rows,
    third_log_scales,
    warn_of_offset,
    warn_of_unread,
    world_gaussians,
)
from a2tg_jax.io.validate import check_model, reading
from a2tg_jax.model import Model

STORAGES = {
    "DoubleStorage": "<f8", "FloatStorage": "<f4", "HalfStorage": "<f2", "LongStorage": "<i8", "IntStorage": "<i4",
    "BFloat16Storage": "bfloat16", "ShortStorage": "<i2", "CharStorage": "i1", "ByteStorage": "u1", "BoolStorage": "?",
}  # fmt: skip
MOST_PICKLE_BYTES = 1 << 20
MOST_ENTRIES = 10_000
MOST_NODES = 10_000
"""Largest number of values in a checkpoint's dictionaries; one with two references counts twice."""
DEEPEST = 5
"""Largest depth of dictionaries that are searched for tensors."""
MOST_SIDES = 4
BYTE_ORDER = b"little"
PROTOCOL = 2
"""Version of pickles, as `torch.save` writes them."""
GSPLAT = ("means", "quats", "scales", "opacities", "sh0", "shN")
NERFSTUDIO = ("means", "quats", "scales", "opacities", "features_dc", "features_rest")
TUPLE_2DGS = {"means": 1, "sh0": 2, "shN": 3, "scales": 4, "quats": 5, "opacities": 6}
"""Places of the parameters in the tuple that 3DGS and 2DGS save."""
# 3DGS has active_sh_degree at place 0, then the parameters, then statistics and the optimiser.
TUPLE_LENGTH = 12
COEFFICIENTS = (1, 4, 9, 16, 25)
"""Numbers of coefficients by degree of the spherical harmonics; gsplat also trains degree 4."""


# Writing


def to_gsplat(model: Gaussians | Model, *, world: World = "original") -> dict[str, np.ndarray]:
    """Return the Gaussians of a model with the names and shapes of gsplat's trainers, as NumPy arrays.

    The values are the trained parameters, as in the "splats" of a checkpoint: scales are logarithms, opacities logits.
    Textures and other shapes of kernels are lost, as in `save_ply`; `save_splats("scene.pt", model)` writes the
    same as a file.

    Args:
      model: N Gaussians; or a model, whose live Gaussians are returned in its original world, without its appearance.
      world: as in `save_ply`.

    Returns:
      float32 means [N, 3], quats [N, 4] (wxyz), scales [N, 3] with a third scale of a thousandth of the shorter,
      opacities [N], sh0 [N, 1, 3] and shN [N, K − 1, 3].

    Raises:
      ValueError: if a field of the Gaussians has the wrong shape, or a number that is not finite or too large.

    Examples:
      >>> splats = a2tg.to_gsplat(model)
      >>> {name: array.shape for name, array in splats.items()}  # doctest: +NORMALIZE_WHITESPACE
      {'means': (200, 3), 'quats': (200, 4), 'scales': (200, 3), 'opacities': (200,), 'sh0': (200, 1, 3),
       'shN': (200, 3, 3)}
    """
    gaussians, offset, *_ = world_gaussians(model, world=world)
    warn_of_offset("pt", offset, "to_gsplat")
    return _by_gsplat(gaussians)


def save_checkpoint_gaussians(
    path: str | os.PathLike[str], model: Gaussians | Model, *, world: World = "original"
) -> None:
    """Write the Gaussians of a model as a checkpoint, of Nerfstudio's splatfacto if the suffix is *.ckpt, else of
    gsplat. Arguments and errors as in `to_gsplat`."""
    gaussians, offset, *_ = world_gaussians(model, world=world)
    splats = _by_gsplat(gaussians)
    checkpoint: dict[str, object] = {"step": 0, "splats": splats}
    if os.fspath(path).lower().endswith(".ckpt"):
        # splatfacto has one size of each parameter, the one of degree 3.
        rest = np.zeros((gaussians.num, NUM_BASES[-1] - 1, 3), np.float32)
        rest[:, : splats["shN"].shape[1]] = splats["shN"]
        splats |= {"sh0": splats["sh0"][:, 0], "shN": rest, "opacities": splats["opacities"][:, None]}
        named = {f"_model.gauss_params.{name}": splats[own] for name, own in zip(NERFSTUDIO, GSPLAT, strict=True)}
        checkpoint = {"step": 0, "pipeline": named, "optimizers": {}, "scalers": {}}
    storages: list[np.ndarray] = []
    pickled = pickle.PROTO + bytes([PROTOCOL]) + _opcodes(checkpoint, storages) + pickle.STOP
    entries = {"data.pkl": pickled, "byteorder": BYTE_ORDER, "version": b"3\n"}
    entries |= {f"data/{key}": array.astype("<f4").tobytes() for key, array in enumerate(storages)}
    with replacing(path) as temporary, zipfile.ZipFile(temporary, "w") as archive:
        for name, content in entries.items():
            # A fresh ZipInfo has a fixed date.
            archive.writestr(zipfile.ZipInfo(f"archive/{name}"), content)
    warn_of_offset("pt", offset, path)


def _by_gsplat(gaussians: Gaussians) -> dict[str, np.ndarray]:
    # Never write a file that cannot be read.
    check_model(Model(gaussians))
    sh = np.asarray(gaussians.sh)
    log_scales = np.asarray(gaussians.log_scales)
    scales = np.concatenate([log_scales, third_log_scales(log_scales)], axis=1)
    arrays = (gaussians.means, gaussians.quats, scales, gaussians.logit_opacities, sh[:, :1], sh[:, 1:])
    # Copies, because PyTorch warns of arrays that cannot be written to.
    return {name: np.array(array, np.float32, order="C") for name, array in zip(GSPLAT, arrays, strict=True)}


def _opcodes(value: object, storages: list[np.ndarray]) -> bytes:
    """Return the opcodes of a value in a pickle. Arrays become tensors, and their numbers are added to the storages."""
    if isinstance(value, Mapping):
        items = [_opcodes(part, storages) for pair in value.items() for part in pair]
        return pickle.EMPTY_DICT + pickle.MARK + b"".join(items) + pickle.SETITEMS
    if not isinstance(value, np.ndarray):
        # Without the opcodes around the whole pickle.
        return pickle.dumps(value, PROTOCOL)[2:-1]
    key = str(len(storages))
    strides = tuple(math.prod(value.shape[axis + 1 :]) for axis in range(value.ndim))
    storages.append(value)
    # As `torch.save` writes ("storage", FloatStorage, key, "cpu", number of elements).
    storage = [_opcodes("storage", []), pickle.GLOBAL + b"torch\nFloatStorage\n"]
    storage += [_opcodes(part, []) for part in (key, "cpu", value.size)]
    hooks = pickle.GLOBAL + b"collections\nOrderedDict\n" + pickle.EMPTY_TUPLE + pickle.REDUCE
    # The arguments of _rebuild_tensor_v2: storage, offset, size, strides, requires_grad, hooks.
    arguments = [pickle.MARK, *storage, pickle.TUPLE, pickle.BINPERSID]
    arguments += [_opcodes(part, []) for part in (0, value.shape, strides, False)]
    rebuild = pickle.GLOBAL + b"torch._utils\n_rebuild_tensor_v2\n"
    return rebuild + pickle.MARK + b"".join(arguments) + hooks + pickle.TUPLE + pickle.REDUCE


# Reading


def load_checkpoint_gaussians(path: str | os.PathLike[str]) -> Gaussians:
    """Read Gaussians from a checkpoint of gsplat, Nerfstudio, 3DGS or 2DGS. Ellipsoids become flat, with a warning.
    FileNotFoundError: there is no such file. ValueError: it is not such a checkpoint, is damaged, pickles anything but
    tensors, or a number is not finite."""
    path = expanded(path)
    if not is_regular(path):
        raise FileNotFoundError(f"{path}: no such checkpoint")
    with open_regular(path) as file:
        try:
            with zipfile.ZipFile(file) as archive:
                arrays, unread = _unpickled(archive)
        except _Refused as error:
            raise ValueError(f"{path}: {error}") from None
        except Exception as error:  # A damaged pickle may raise anything.
            reason = shortened(str(error) or type(error).__name__, 200)
            raise ValueError(f"{path}: is not a PyTorch checkpoint (1.6 or newer), or is damaged ({reason})") from error
    warn_of_unread(unread, path)
    with reading(path):
        num = len(arrays["means"])
        for name, array in arrays.items():
            if len(array) != num:
                raise ValueError(f"has {num} means, but {len(array)} {name}")
        bands = [arrays[name] for name in ("sh0", "shN") if name in arrays]
        # No -1, which NumPy cannot find for no rows.
        bands = [band.reshape(num, math.prod(band.shape[1:]) // 3, 3) for band in bands]
        sh, log_scales = np.concatenate(bands, axis=1), arrays["scales"]
        if sh.shape[1] not in COEFFICIENTS or bands[0].shape[1] != 1 or log_scales.shape[1:] not in ((2,), (3,)):
            found = f"{sh.shape[1]} coefficients and {log_scales.shape[-1]} scales of each Gaussian"
            raise ValueError(f"has {found}; SH of degree 0 to 4 have 1, 4, 9, 16 or 25, and Gaussians 2 or 3 scales")
        sh = sh[:, : COEFFICIENTS[degree_to_read(COEFFICIENTS.index(sh.shape[1]), str(path))]]
        quats, logits = arrays["quats"].reshape(num, 4), arrays["opacities"].reshape(num)
        if FILTER in arrays:
            log_scales, logits = filtered(log_scales, logits, arrays[FILTER].reshape(num))
        columns = flat_rows(str(path), arrays["means"].reshape(num, 3), quats, log_scales, logits, sh)
        gaussians = Gaussians(*map(jnp.asarray, columns))
        check_model(Model(gaussians))
        return gaussians


class _Refused(Exception):
    """A pickle refers to something other than tensors."""


class _Storage(NamedTuple):
    """A storage of a checkpoint, not yet read."""

    dtype: str
    key: str
    num: int


class _Tensor:
    """A view into a storage."""

    # Further arguments: requires_grad, hooks, metadata.
    def __init__(self, storage: _Storage, offset: int, size: Any, stride: Any, *rest: object):
        self.storage, self.offset, self.size, self.stride = storage, offset, tuple(size), tuple(stride)


class _Ignored:
    """An unused value, such as a NumPy scalar."""

    def __init__(self, *arguments: Any):
        pass

    # Pickles may set a state; it is dropped as well.
    __setstate__ = __init__


def _parameter(data: object, *rest: Any) -> Any:
    return data


KNOWN: dict[str, Callable[..., Any]] = {
    "torch._utils._rebuild_tensor_v2": _Tensor,
    "torch._utils._rebuild_parameter": _parameter,
    "torch.nn.parameter.Parameter": _parameter,
    "collections.OrderedDict": collections.OrderedDict,
    "numpy.core.multiarray.scalar": _Ignored,
    "numpy._core.multiarray.scalar": _Ignored,
    "numpy.dtype": _Ignored,
    "_codecs.encode": _Ignored,
    "torch.device": _Ignored,
}
"""Names that a pickle may refer to, and the functions called instead."""


class _Unpickler(pickle.Unpickler):
    """Unpickler that only calls `KNOWN`."""

    def find_class(self, module: str, name: str) -> Any:
        if module == "torch" and name in STORAGES:
            return STORAGES[name]
        if module in ("torch", "torch.storage") and name.endswith("Storage"):
            raise _Refused(f"has numbers of the type {shortened(name)}, which this program does not read; save floats")
        if (full := f"{module}.{name}") not in KNOWN:
            raise _Refused(
                f"pickles {shortened(full)}, which could run any code; save a dictionary of tensors alone, or export a "
                "PLY"
            )
        return functools.partial(KNOWN[full])  # Attributes that a pickle sets affect no other.

    def persistent_load(self, pid: Any) -> _Storage:
        # ("storage", type, key, device, number of elements).
        kind, dtype, key, _, num = pid
        if kind != "storage" or not isinstance(dtype, str) or not isinstance(num, int):
            raise _Refused("refers to something other than a storage")
        return _Storage(dtype, str(key), num)


def _unpickled(archive: zipfile.ZipFile) -> tuple[dict[str, np.ndarray], set[str]]:
    """Return the arrays of a checkpoint's Gaussians by gsplat's names, and the names of those that are not read."""
    names = archive.namelist()
    # The folder in the zip has the name of the file when it was saved.
    pickled = next((name for name in names if name.count("/") == 1 and name.endswith("/data.pkl")), None)
    if pickled is None or len(names) > MOST_ENTRIES:
        raise _Refused("is not a checkpoint of PyTorch: it has no data.pkl")
    folder = pickled.removesuffix("data.pkl")

    def start(name: str, num_bytes: int) -> bytes:
        """Return the first bytes of an entry, without unpacking more."""
        with archive.open(name) as entry:
            return entry.read(num_bytes)

    if folder + "byteorder" in names and start(folder + "byteorder", len(BYTE_ORDER) + 1) != BYTE_ORDER:
        raise _Refused("is from a big-endian machine")
    data = start(pickled, MOST_PICKLE_BYTES + 1)
    if len(data) > MOST_PICKLE_BYTES:
        raise _Refused(f"has a pickle of more than {MOST_PICKLE_BYTES:,} bytes")
    # The unpickler allocates a memo for any index in a pickle.
    for opcode, argument, _ in pickletools.genops(data):
        if opcode.name.endswith("PUT") and isinstance(argument, int) and argument > len(data):
            raise _Refused("has a damaged pickle: its memo is longer than the pickle")
    value = _Unpickler(io.BytesIO(data)).load()
    tensors, unread = _tensors_of(value)
    return {name: _array(tensor, archive, folder) for name, tensor in tensors.items()}, unread


def _tensors_of(value: object) -> tuple[dict[str, _Tensor], set[str]]:
    """Return the tensors of Gaussians in a checkpoint by gsplat's names, and the names of their other tensors."""
    unread = set[str]()
    if isinstance(value, tuple | list) and len(value) == 2 and isinstance(value[0], tuple | list):
        parts = value[0]
        found = {name: parts[place] for name, place in TUPLE_2DGS.items()} if len(parts) >= TUPLE_LENGTH - 1 else {}
        # RaDe-GS, for one, adds a network and embeddings for the appearance of photographs.
        unread |= {f"entry {place} of its tuple" for place in range(TUPLE_LENGTH, len(parts)) if _shows(parts[place])}
    else:
        own = dict[str, _Tensor]()
        # A dictionary with many references would make the walk take forever.
        for index, (name, node) in enumerate(_nodes(value)):
            if index >= MOST_NODES:
                raise _Refused(f"has dictionaries of more than {MOST_NODES:,} values")
            if isinstance(node, _Tensor):
                own[name] = node
            elif isinstance(node, Mapping):
                unread |= _next_to_means(node)
        # Nerfstudio's names differ in the SH only.
        wanted = GSPLAT if any(name.endswith("sh0") for name in own) else NERFSTUDIO
        found = {name: own[key] for name, key in zip((*GSPLAT, FILTER), (*wanted, FILTER), strict=True) if key in own}
        unread -= {*wanted, FILTER}
    tensors = {name: tensor for name, tensor in found.items() if isinstance(tensor, _Tensor)}
    # Degree 0 needs no shN.
    missing = [name for name in GSPLAT[:-1] if name not in tensors]
    if missing:
        raise _Refused(f"holds no Gaussians as gsplat, Nerfstudio, 3DGS or 2DGS save them: no {', '.join(missing)}")
    return tensors, unread


def _shows(part: object) -> bool:
    """Return whether an entry of a tuple may change what its program shows: tensors and networks, no optimiser."""
    return isinstance(part, _Tensor) or (isinstance(part, Mapping) and "param_groups" not in part)


def _next_to_means(node: Mapping[Any, object]) -> set[str]:
    """Return the names of the tensors that a dictionary has next to "means", such as "gauss_params.means"."""
    names = {key for key, own in node.items() if isinstance(key, str) and isinstance(own, _Tensor)}
    folders = [name.removesuffix("means") for name in names if name.rpartition(".")[2] == "means"]
    return {name.removeprefix(folder) for folder in folders for name in names if name.startswith(folder)}


def _nodes(value: Any, name: str = "", depth: int = 0) -> Iterator[tuple[str, Any]]:
    """Yield a value and all values in its nested dictionaries, with the last parts of their dotted names."""
    yield name, value
    if isinstance(value, Mapping) and depth < DEEPEST:
        for key, own in value.items():
            yield from _nodes(own, key.rpartition(".")[2] if isinstance(key, str) else "", depth + 1)


def _array(tensor: _Tensor, archive: zipfile.ZipFile, folder: str) -> np.ndarray:
    """Return the numbers of a tensor. Raises `_Refused` if it exceeds its storage."""
    storage, size = tensor.storage, tensor.size
    numbers = (tensor.offset, *size, *tensor.stride)
    if len(size) > MOST_SIDES or any(type(number) is not int or number < 0 for number in numbers):
        raise _Refused("has a tensor of negative sizes, or of too many")
    num = math.prod(size)
    dtype, entry = np.dtype(storage.dtype), archive.getinfo(f"{folder}data/{storage.key}")
    steps = [stride * (side - 1) for side, stride in zip(size, tensor.stride, strict=True)]
    # PyTorch stores plainly; a compressed entry could unpack to far more than the file.
    if entry.compress_type != zipfile.ZIP_STORED:
        raise _Refused("has compressed storages")
    if entry.file_size != storage.num * dtype.itemsize:
        raise _Refused("has a storage of another size than its tensor says")
    if num > storage.num or (num and tensor.offset + sum(steps) >= storage.num):
        raise _Refused("has a tensor that reaches beyond its storage")
    # The checks above keep every element that the strides reach within the storage.
    flat = np.frombuffer(archive.read(entry), dtype)
    strides = [stride * dtype.itemsize for stride in tensor.stride]
    # A copy, for strides may overlap.
    return np.array(np.lib.stride_tricks.as_strided(flat[tensor.offset :], size, strides), np.float32)
