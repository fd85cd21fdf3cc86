"""Reads compact scenes, *.a2tgz."""

import io
import json
import lzma
import struct
import zlib

import numpy as np
import zstandard
from PIL import Image
from splats import dense, expanded, exponents, sigmoid, with_w


def read_compact(path):
    header, body = unframed(path.read_bytes())
    parts, num, chunks = Parts(header, body), header["num"], []
    chunk = header.get("chunk", max(num, 1))
    for start in range(0, max(num, 1), chunk):
        chunks.append(read_chunk(parts, header, min(chunk, num - start)))
    return {"header": header} | {name: np.concatenate([rows[name] for rows in chunks]) for name in chunks[0]}


def read_chunk(parts, header, num):
    """Return the splats of a chunk."""
    choices, names = header["choices"], {name for name, _, _ in header["parts"]}
    model = {"means": parts.means(num, choices["means"])}
    model["log_scales"] = parts.numbers("log_scales", 2, num, choices["log_scales"]).T
    model["quats"] = with_w(parts.numbers("quats", 3, num, choices["quats"]))
    opacities = parts.numbers("opacities", 1, num, choices["opacities"])[0]
    model["opacities"] = sigmoid(opacities) if isinstance(choices["opacities"], str) else opacities
    model["degrees"] = parts.entries("degrees", header["degrees"], num)
    bands = []
    for degree in range(4):
        if f"sh_{degree}" in names:
            count = int(np.sum(model["degrees"] >= degree))
            precision = choices["sh_rest" if degree else "sh_0"]
            columns = parts.numbers(f"sh_{degree}", 3, (2 * degree + 1) * count, precision, is_color=True)
            bands.append(columns.reshape(3, 2 * degree + 1, count).transpose(2, 1, 0))
    model["sh"] = dense(bands, model["degrees"])
    if "sizes" in header:
        model["sizes"] = parts.entries("sizes", header["sizes"], num).reshape(num, 2)
        count = int(model["sizes"].prod(axis=1).sum())
        colors = parts.numbers("texel_colors", 3, count, choices["texels"], is_color=True)
        alphas = parts.numbers("texel_alphas", 1, count, choices["texels"])
        model["texels"] = np.concatenate([colors, alphas]).T
    if "shapes" in names:
        values = parts.numbers("shapes", 1, num, choices["shapes"])[0]
        model["exponents"] = exponents(np.tanh(values) if isinstance(choices["shapes"], str) else values)
    return model


def unframed(data):
    """Return header and body."""
    magic, version, num_coded, _, checksum = struct.unpack_from("<8sHIII", data)
    rest = data[22:]
    if magic != b"a2tgz\r\n\x1a" or version not in (1, 2, 3) or zlib.crc32(rest) != checksum:
        raise ValueError("is no whole compact scene of version 1 to 3")
    header = json.loads(unpacked("deflate" if version == 3 else "zstd", rest[:num_coded], 1, None))
    if version < 3:
        header["parts"] = [(name, header["coders"][name], length) for name, length in header["lengths"].items()]
    return header, rest[num_coded:]


class Parts:
    """The parts of the body by name, of which each has one in each chunk."""

    def __init__(self, header, body):
        self.header, self.found, start = header, {}, 0
        for name, coder, length in header["parts"]:
            self.found.setdefault(name, []).append((coder, body[start : start + length]))
            start += length

    def planes(self, name, num_planes, length):
        """Return bytes [num_planes, length]."""
        coder, data = self.found[name].pop(0)
        data = unpacked(coder, data, num_planes, length) if data else data
        return np.frombuffer(data, np.uint8).reshape(num_planes, length)

    def codes(self, name, columns, length, bits):
        """Return integers [columns, length], whose lowest bytes come first, of all columns."""
        planes = self.planes(name, columns * -(-bits // 8), length).astype(np.int64)
        shifts = 8 * np.arange(-(-bits // 8))[:, None, None]
        return np.sum(planes.reshape(-1, columns, length) << shifts, axis=0)

    def entries(self, name, table, length):
        """Return entries of a table."""
        return np.asarray(table)[self.codes(name, 1, length, max(len(table) - 1, 0).bit_length())[0]]

    def numbers(self, name, columns, length, precision, is_color=False):
        """Return floats [columns, length]."""
        if isinstance(precision, str):
            size = np.dtype(precision).itemsize
            planes = self.planes(name, columns * size, length).reshape(size, columns, length)
            return np.ascontiguousarray(planes.transpose(1, 2, 0)).view(precision)[..., 0].astype(float)
        low, high = self.header["ends"][name]
        if low == high:
            return np.full((columns, length), low)
        codes = self.codes(name, columns, length, precision)
        if is_color:
            codes[[0, 2]] = (codes[[0, 2]] + codes[1]) % (256 if precision <= 8 else 65536)
        return low + codes * ((high - low) / (2**precision - 1))

    def means(self, length, precision):
        """Return positions [length, 3]."""
        if isinstance(precision, str):
            return self.numbers("means", 3, length, precision).T
        places = np.cumsum(self.codes("means", 1, length, 3 * precision)[0])
        codes = [sum(((places >> (3 * bit + axis)) & 1) << bit for bit in range(precision)) for axis in range(3)]
        return expanded(codes, np.reshape(self.header["ends"]["means"], (3, 4)), precision)


def unpacked(coder, data, num_planes, length):
    """Return the bytes of planes."""
    if coder == "deflate":
        return zlib.decompress(data)
    if coder == "zstd":
        return zstandard.ZstdDecompressor().decompress(data)
    if coder == "lzma":
        filters = [{"id": lzma.FILTER_LZMA1, "lc": 0, "lp": 0, "pb": 0, "dict_size": 1 << 20}]
        return lzma.decompress(data, lzma.FORMAT_RAW, filters=filters)
    if coder == "webp":
        pixels = np.asarray(Image.open(io.BytesIO(data)).convert("RGB"))
        images = pixels.reshape(-(-num_planes // 3), -1, 3).transpose(0, 2, 1)
        return images.reshape(-1, images.shape[2])[:num_planes, :length].tobytes()
    return data
