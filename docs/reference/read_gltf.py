"""Reads splats of glTF with their textures: KHR_gaussian_splatting and A2TG_splat_textures in one *.glb of this
program."""

import json
import struct

import numpy as np
from splats import exponents

SPLATS, TEXTURES = "KHR_gaussian_splatting", "A2TG_splat_textures"
COMPONENTS, SIDES = {5121: np.uint8, 5126: np.float32}, {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}


def read_gltf(path):
    data = path.read_bytes()
    magic, version, _, length = struct.unpack_from("<4sIII", data)
    if magic != b"glTF" or version != 2:
        raise ValueError("is no GLB of version 2")
    header, binary = json.loads(data[20 : 20 + length]), data[28 + length :]

    def numbers(index):
        accessor = header["accessors"][index]
        start = header["bufferViews"][accessor["bufferView"]]["byteOffset"] + accessor.get("byteOffset", 0)
        count = accessor["count"] * SIDES[accessor["type"]]
        values = np.frombuffer(binary, COMPONENTS[accessor["componentType"]], count, start)
        values = values.reshape(accessor["count"], -1)
        return values / 255 if accessor.get("normalized") else values

    (primitive,) = header["meshes"][0]["primitives"]
    found = {name.removeprefix(f"{SPLATS}:"): numbers(i) for name, i in primitive["attributes"].items()}
    extended = primitive["extensions"][SPLATS].get("extensions", {}).get(TEXTURES, {})
    names = [f"SH_DEGREE_{degree}_COEF_{order}" for degree in range(4) for order in range(2 * degree + 1)]
    sh = np.stack([found.get(name, np.zeros_like(found["POSITION"])) for name in names], axis=1)
    highest = max(degree for degree in range(4) if f"SH_DEGREE_{degree}_COEF_0" in found)
    model = {
        "header": header,
        "means": found["POSITION"],
        "quats": found["ROTATION"][:, [3, 0, 1, 2]],
        "log_scales": np.log(found["SCALE"][:, :2]),
        "opacities": found["OPACITY"][:, 0],
        "degrees": numbers(extended["degrees"])[:, 0] if "degrees" in extended else np.full(len(sh), highest),
        "sh": sh,
    }
    if "shapes" in extended:
        model["exponents"] = exponents(numbers(extended["shapes"])[:, 0])
    if "sizes" in extended:
        model["sizes"] = numbers(extended["sizes"]).astype(int)
        texels = numbers(extended["texels"]) if "texels" in extended else np.zeros((0, 4))
        for name, columns in (("rgb", slice(0, 3)), ("alpha", slice(3, 4))) if "texelRanges" in extended else ():
            low, high = extended["texelRanges"][name]
            texels[:, columns] = low + texels[:, columns] * (high - low)
        model["texels"] = texels
    return model
