"""Reads the files of a2tg-jax without it: models (*.npz), compact scenes (*.a2tgz), and glTF with textures (*.glb).

    python docs/reference/read_model.py scene.a2tgz

It follows docs/formats.md, with numpy; *.a2tgz also takes zstandard and Pillow, in whose codes it is. It trusts its
files: a program that opens those of strangers also bounds what they unpack to.
"""

import json
import sys
from pathlib import Path

import numpy as np
from read_compact import read_compact
from read_gltf import read_gltf
from splats import dense, sigmoid


def read_model(path):
    """Return a dictionary of N splats.

    means [N, 3]; quats [N, 4], wxyz; log_scales [N, 2]; opacities [N]; degrees [N]; sh [N, 16, 3], zero above the
    degree of a splat; with textures also sizes [N, 2], rows and columns, and texels [T, 4], one texture after the
    other, each row by row; where kernels differ in shape also exponents [N]. `header` is the file's own.
    """
    return READERS[Path(path).suffix](Path(path))


def read_npz(path):
    with np.load(path, allow_pickle=False) as archive:
        arrays = dict(archive)
    header = json.loads(arrays["header"].tobytes())
    if header["format"] != "a2tg-jax model" or header["version"] != 1:
        raise ValueError(f"{path} is no model of version 1")
    model = {name: arrays[name] for name in ("means", "quats", "log_scales")} | {"header": header}
    shown = {name.removeprefix("appearance/"): array for name, array in arrays.items()}
    base = int(np.sqrt(arrays["sh"].shape[1])) - 1
    degrees = shown.get("degrees", np.full(len(arrays["means"]), base)).astype(int)
    bands = [arrays["sh"][:, degree**2 : (degree + 1) ** 2] for degree in range(base + 1)]
    bands += [shown[f"band_{degree}"] for degree in range(base + 1, 4) if f"band_{degree}" in shown]
    for name, array in shown.items():
        if (name := name.rpartition("inner.")[2]) in ("sizes", "texels"):  # "inner." where one class holds another.
            model[name] = array
        if name == "shapes":
            model["exponents"] = np.exp(np.tanh(array))
    return model | {"opacities": sigmoid(arrays["logit_opacities"]), "degrees": degrees, "sh": dense(bands, degrees)}


READERS = {".npz": read_npz, ".a2tgz": read_compact, ".glb": read_gltf}

if __name__ == "__main__":
    for name, values in read_model(sys.argv[1]).items():
        print(f"{name}: {values.dtype} {list(values.shape)}" if isinstance(values, np.ndarray) else f"{name}: {values}")
