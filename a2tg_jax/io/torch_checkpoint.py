"""PyTorch checkpoints of Gaussians (*.pt, *.pth, *.ckpt), written without PyTorch.

Since PyTorch 1.6 a checkpoint is a zip: a pickle that refers to storages, and an entry of plain numbers for each
storage. Files *.pt and *.pth have the layout of gsplat ({"splats": …}), files *.ckpt the one of Nerfstudio's splatfacto
("…gauss_params.means", …). Checkpoints are not read: a pickle may run any code, and the programs that write them also
write PLY files.
"""

import math
import pickle
import zipfile
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from a2tg_jax import Gaussians, Model
from a2tg_jax.base.atomic import replacing
from a2tg_jax.core.sh import NUM_BASES
from a2tg_jax.io.other_programs import World, third_log_scales, warn_of_offset, world_gaussians
from a2tg_jax.model import check_model

PROTOCOL = 2
"""Version of pickles, as `torch.save` writes them."""
SPLATFACTO = {
    "means": "means", "quats": "quats", "scales": "scales", "opacities": "opacities", "sh0": "features_dc",
    "shN": "features_rest",
}  # fmt: skip
"""Names of parameters in gsplat, in the order of its files, and in Nerfstudio's splatfacto."""


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
    placed = world_gaussians(model, world=world)
    warn_of_offset("pt", placed.offset, "to_gsplat")
    return _splats_of(placed.gaussians)


def save_checkpoint_gaussians(path: Path, model: Gaussians | Model, *, world: World = "original") -> None:
    """Write the Gaussians of a model as a checkpoint, of Nerfstudio's splatfacto if the suffix is *.ckpt, else of
    gsplat. Arguments and errors as in `to_gsplat`."""
    placed = world_gaussians(model, world=world)
    splats = _splats_of(placed.gaussians)
    checkpoint: dict[str, object] = {"step": 0, "splats": splats}
    if path.suffix.lower() == ".ckpt":
        # splatfacto has one size of each parameter, the one of degree 3.
        rest = np.zeros((placed.gaussians.num, NUM_BASES[-1] - 1, 3), np.float32)
        rest[:, : splats["shN"].shape[1]] = splats["shN"]
        splats |= {"sh0": splats["sh0"][:, 0], "shN": rest, "opacities": splats["opacities"][:, None]}
        named = {f"_model.gauss_params.{SPLATFACTO[name]}": array for name, array in splats.items()}
        checkpoint = {"step": 0, "pipeline": named, "optimizers": {}, "scalers": {}}
    storages: list[np.ndarray] = []
    pickled = pickle.PROTO + bytes([PROTOCOL]) + _opcodes(checkpoint, storages) + pickle.STOP
    entries = {"data.pkl": pickled, "byteorder": b"little", "version": b"3\n"}
    entries |= {f"data/{key}": array.astype("<f4").tobytes() for key, array in enumerate(storages)}
    with replacing(path) as temporary, zipfile.ZipFile(temporary, "w") as archive:
        for name, content in entries.items():
            # A fresh ZipInfo has a fixed date.
            archive.writestr(zipfile.ZipInfo(f"archive/{name}"), content)
    warn_of_offset("pt", placed.offset, path)


def _splats_of(gaussians: Gaussians) -> dict[str, np.ndarray]:
    """Return the parameters of Gaussians with gsplat's names and shapes. Raises as `check_model`."""
    check_model(Model(gaussians))
    sh = np.asarray(gaussians.sh)
    log_scales = np.asarray(gaussians.log_scales)
    scales = np.concatenate([log_scales, third_log_scales(log_scales)], axis=1)
    arrays = (gaussians.means, gaussians.quats, scales, gaussians.logit_opacities, sh[:, :1], sh[:, 1:])
    # Copies, because PyTorch warns of arrays that cannot be written to.
    return {name: np.array(array, np.float32, order="C") for name, array in zip(SPLATFACTO, arrays, strict=True)}


def _opcodes(value: object, storages: list[np.ndarray]) -> bytes:
    """Return the opcodes of a value in a pickle. Arrays become tensors, and their numbers are added to the storages."""
    if isinstance(value, Mapping):
        items = [_opcodes(part, storages) for pair in value.items() for part in pair]
        return pickle.EMPTY_DICT + pickle.MARK + b"".join(items) + pickle.SETITEMS
    if not isinstance(value, np.ndarray):
        # Without the opcodes around the whole pickle.
        return pickle.dumps(value, PROTOCOL)[2:-1]
    strides = tuple(math.prod(value.shape[axis + 1 :]) for axis in range(value.ndim))
    # As `torch.save` writes ("storage", FloatStorage, key, "cpu", number of elements).
    storage = [_opcodes("storage", []), pickle.GLOBAL + b"torch\nFloatStorage\n"]
    storage += [_opcodes(part, []) for part in (str(len(storages)), "cpu", value.size)]
    storages.append(value)
    hooks = pickle.GLOBAL + b"collections\nOrderedDict\n" + pickle.EMPTY_TUPLE + pickle.REDUCE
    # The arguments of _rebuild_tensor_v2: storage, offset, size, strides, requires_grad, hooks.
    arguments = [pickle.MARK, *storage, pickle.TUPLE, pickle.BINPERSID]
    arguments += [_opcodes(part, []) for part in (0, value.shape, strides, False)]
    rebuild = pickle.GLOBAL + b"torch._utils\n_rebuild_tensor_v2\n"
    return rebuild + pickle.MARK + b"".join(arguments) + hooks + pickle.TUPLE + pickle.REDUCE
