"""Reads scenes for browsers, *.a2tgw."""

import json
import struct
import zlib

import numpy as np
from splats import dense, expanded, exponents, with_w

BITS = {"sh_1": 7, "sh_2": 6, "sh_3": 6}
"""Bits of the numbers that have no 8."""


def read_web(path):
    header, body = unframed(path.read_bytes())
    columns = columns_of(header, body)

    def values(name, codes, is_color=False):
        low, high = header["ends"][name]
        if is_color:
            codes = np.stack([codes[0] + codes[1], codes[1], codes[2] + codes[1]]) % 256
        return low + codes * ((high - low) / (2 ** BITS.get(name, 8) - 1))

    numbers, degrees = columns["numbers"], columns["degrees"][0]
    bands = [values("sh_0", numbers[6:9], is_color=True).T[:, None]]
    for degree in range(1, header["num_bands"]):
        bands.append(values(f"sh_{degree}", columns[f"band_{degree}"], is_color=True).transpose(2, 1, 0))
    model = {
        "header": header,
        "means": expanded(columns["means"], header["means"], 16),
        "log_scales": values("log_scales", numbers[:2]).T,
        "quats": with_w(values("quats", numbers[2:5])),
        "opacities": values("opacities", numbers[5]),
        "degrees": degrees,
        "sh": dense(bands, degrees),
    }
    if header["num_texels"] is not None:
        roots = values("colors", columns["texels"][:3], is_color=True)
        texels = np.concatenate([roots * np.abs(roots), values("alphas", columns["texels"][3:])])
        model |= {"sizes": columns["sizes"].T, "texels": texels.T}
    if "shapes" in header["ends"]:
        model["exponents"] = exponents(values("shapes", columns["shapes"][0]))
    return model


def unframed(data):
    """Return header and body."""
    magic, version, num_text, num_coded, checksum = struct.unpack_from("<8sHIII", data)
    text, coded = data[22 : 22 + num_text], data[22 + num_text : 22 + num_text + num_coded]
    if magic != b"a2tgw\r\n\x1a" or version not in (1, 2) or zlib.crc32(text) != checksum:
        raise ValueError("is no whole scene for browsers of version 1 or 2")
    return json.loads(text), zlib.decompress(coded)


def columns_of(header, body):
    """Return the codes of all rows by name, columns first."""
    place, chunks = 0, []

    def take(num_columns, length):
        nonlocal place
        found = np.frombuffer(body, np.uint8, num_columns * length, place).astype(np.int64)
        place += len(found)
        return found.reshape(num_columns, length)

    for start in range(0, header["num"], header["chunk"]):
        num = min(header["chunk"], header["num"] - start)
        means = take(6, num)
        chunk = {"means": means[:3] + 256 * means[3:], "numbers": take(9, num), "degrees": take(1, num)}
        chunk["sizes"] = take(2, num) if header["num_texels"] is not None else np.zeros((2, num), np.int64)
        chunk["shapes"] = take(1, num) if "shapes" in header["ends"] else np.zeros((1, num), np.int64)
        for degree in range(1, header["num_bands"]):
            codes = take(3 * (2 * degree + 1), int(np.sum(chunk["degrees"] >= degree)))
            chunk[f"band_{degree}"] = codes.reshape(3, 2 * degree + 1, -1)
        chunks.append(chunk | {"texels": take(4, int(chunk["sizes"].prod(axis=0).sum()))})
    return {name: np.concatenate([chunk[name] for chunk in chunks], axis=-1) for name in chunks[0]}
