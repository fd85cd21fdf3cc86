"""Changes of files, at random: of bytes under any format, and of what a format holds, sealed again where it is sealed.

Each takes the bytes of a sound file and a generator, and gives other bytes. Imports nothing that it tests.
"""

import copy
import gzip
import io
import json
import re
import struct
import tomllib
import zipfile
import zlib

import numpy as np
import tomli_w

INTEGERS = (0, 1, -1, 127, 255, 256, 65535, 2**31 - 1, 2**31, 2**32 - 1, 2**53, 2**62, 2**63 - 1, 2**64 - 1)
FLOATS = (np.nan, np.inf, -np.inf, 0.0, -0.0, -1.0, 1e-300, 1e30, 1e300, -1e300, 1e9)
WORDS = (
    "nan", "inf", "-inf", "1e400", "-1", "0", "1e-400", "4294967296", "18446744073709551615", "1" * 401, "many", "",
    "0x10", "1_0", "\0", "٣", "9" * 40, "-0", "1.5", "[", "{", '"', "..", "../../x", "/etc/passwd", "a" * 5000,
)  # fmt: skip
NESTED = 100_000
START_OF_TEXT = 128
"""Where the bytes begin in an .npy that NumPy writes."""


def of_bytes(data, rng):
    """One to three changes of bytes, wherever they are."""
    for _ in range(rng.integers(1, 4)):
        data = _changed_bytes(bytearray(data), rng)
    return bytes(data)


def of_text(data, rng):
    """One to three changes of words or lines."""
    text = data.decode("utf-8", "replace")
    for _ in range(rng.integers(1, 4)):
        text = _changed_text(text, rng)
    return text.encode("utf-8", "surrogatepass")


def of_json(data, rng):
    """One to three changes of what a JSON text says."""
    try:
        value = json.loads(data)
    except (ValueError, RecursionError):  # After an earlier change.
        return of_text(data, rng)
    for _ in range(rng.integers(1, 4)):
        value = changed_value(value, rng)
    return _with_deep(json.dumps(value)).encode()


def _with_deep(text):
    """A text whose placeholders are what no library writes: deep lists and long numbers."""
    return text.replace('"NESTED"', "[" * NESTED + "]" * NESTED).replace('"DIGITS"', "7" * 5000)


def of_toml(data, rng):
    """One to three changes of what a TOML text says."""
    table = tomllib.loads(data.decode())
    for _ in range(rng.integers(1, 4)):
        if isinstance(table.get("options"), dict) and rng.random() < 0.7:
            table["options"] = _changed_option(table["options"], rng)
        else:
            name = list(table)[int(rng.integers(len(table)))] if table else "scene"
            table[name] = changed_value(table.get(name), rng, strange_option)
    return _with_deep(tomli_w.dumps(_without_none(table))).encode("utf-8", "surrogatepass")


def _changed_option(options, rng):
    """The options of a system with another one, mostly of a type that is wanted, or one fewer or more."""
    name = list(options)[int(rng.integers(len(options)))] if options else "seed"
    value = options.get(name)
    if isinstance(value, dict) and value and rng.random() < 0.9:
        return options | {name: _changed_option(value, rng)}
    if rng.random() < 0.1:
        return {key: inner for key, inner in options.items() if key != name} | ({"x": 1} if rng.random() < 0.3 else {})
    alike = [other for other in OPTIONS if type(other) is type(value)] or OPTIONS
    others = alike if rng.random() < 0.8 else OPTIONS
    return options | {name: copy.deepcopy(others[rng.integers(len(others))])}


def _without_none(value):
    """A value that TOML has words for."""
    if isinstance(value, dict):
        return {key: _without_none(inner) for key, inner in value.items() if inner is not None}
    return [_without_none(inner) for inner in value if inner is not None] if isinstance(value, list) else value


def strange_option(rng):
    """A value of an option that it should not have, or that lies at the edge of what it may have."""
    if rng.random() < 0.25:
        return strange(rng)
    return copy.deepcopy(OPTIONS[rng.integers(len(OPTIONS))])


OPTIONS = (
    float("nan"), float("inf"), float("-inf"), 0, 1, 2, -1, 3, 16, 10**6, 2**31 - 1, 2**31, 2**63, 2**64, 0.0, -0.0,
    0.5, 1.0, 0.999, 1e-300, 1e-6, 1e15, 1e30, 1e300, [], [float("nan")], [0.0], [1.0], [0.5, 0.1], [0.1, 0.1],
    [-1.0], [1e300],
    [0.1, 0.2], [0.8], [0.9], [[0.1]], [0.1] * 5000, [1e-300, 0.5], ["0.1"], "None", "none", "5MB", "0.0003",
    "1e400MB", "1e-300",
    "a2tg", ["a2tg"], ["a2tg", "a2tg"], ["bytewise", "bbsplat"], ["gaussians-2d-mcmc", "gaussians-2d"], ["os:sep"],
    [""], ["."], [":"], ["a2tg:"], ["a" * 5000], "..:x", "a b:c", "paper", "official", "quick", "mask", "restore",
    {"cap": 1}, {"x": {"y": 1}},
)  # fmt: skip


def of_npz(data, rng):
    """One or two changes of the arrays of an archive, or of its header, or of what an array says of itself."""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        entries = {name: archive.read(name) for name in archive.namelist()}
    for _ in range(rng.integers(1, 3)):
        ENTRY_CHANGES[rng.integers(len(ENTRY_CHANGES))](entries, rng)
    return zipped(entries, zipfile.ZIP_DEFLATED if rng.random() < 0.1 else zipfile.ZIP_STORED)


def of_zip(data, rng):
    """One or two changes of the files of a ZIP: of JSON what it says, of others their bytes, or of their names."""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        entries = {name: archive.read(name) for name in archive.namelist()}
    for _ in range(rng.integers(1, 3)):
        name = list(entries)[int(rng.integers(len(entries)))]
        if rng.random() < 0.2:
            _move_entries(entries, rng)
        else:
            entries[name] = (of_json if name.endswith(".json") else of_bytes)(entries[name], rng)
    return zipped(entries)


def of_gzip(data, rng):
    """A change of what a gzip stream holds, under a right checksum."""
    return gzip.compress(of_bytes(gzip.decompress(data), rng), mtime=0)


def of_compact(data, rng):
    """A change of the header of a compact scene, or of its body, under a right checksum."""
    head = struct.Struct("<8sHIII")
    magic, version, num_coded, _, _ = head.unpack_from(data)
    rest = data[head.size :]
    text = zlib.decompress(rest[:num_coded])
    body = rest[num_coded:]
    if rng.random() < 0.6:
        text = of_json(text, rng)
    else:
        body = of_bytes(body, rng)
    coded = zlib.compress(text)
    rest = coded + body
    return head.pack(magic, version, len(coded), len(text), zlib.crc32(rest)) + rest


def of_glb(data, rng):
    """A change of the JSON of a *.glb, or of its binary chunk, under right lengths."""
    head = struct.Struct("<4sII")
    chunk = struct.Struct("<II")
    magic, version, _ = head.unpack_from(data)
    length, kind = chunk.unpack_from(data, head.size)
    start = head.size + chunk.size
    text = data[start : start + length]
    binary = data[start + length + chunk.size :]
    if rng.random() < 0.8:
        text = of_json(text, rng)
    else:
        binary = of_bytes(binary, rng)
    body = chunk.pack(len(text), kind) + text + chunk.pack(len(binary), 0x004E4942) + binary
    return head.pack(magic, version, head.size + len(body)) + body


def of_png(data, rng):
    """A change of a chunk of a PNG, under a right checksum."""
    chunks = []
    at = 8
    while at < len(data):
        (length,) = struct.unpack_from(">I", data, at)
        chunks.append((data[at + 4 : at + 8], data[at + 8 : at + 8 + length]))
        at += 12 + length
    index = int(rng.integers(len(chunks))) if rng.random() < 0.5 else 0
    kind, content = chunks[index]
    chunks[index] = kind, of_bytes(content, rng) if content else content
    sealed = (
        struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))
        for kind, content in chunks
    )
    return data[:8] + b"".join(sealed)


# Bytes


def _place(data, rng, width=1):
    """Headers stand in front."""
    most = max(1, len(data) - width)
    return int(rng.integers(min(most, 200) if rng.random() < 0.5 else most))


def _changed_bytes(data, rng):
    """A change of some bytes: flipped, set, replaced by numbers at the edge, cut, deleted, repeated, added, swapped."""
    kind = rng.integers(10)
    if kind == 4:
        return data[: _place(data, rng) if rng.random() < 0.5 else int(rng.integers(len(data) + 1))]
    if kind in (2, 3):
        if kind == 2:
            width = int(rng.choice([1, 2, 4, 8]))
            order = ("little", "big")[rng.integers(2)]
            value = int(INTEGERS[rng.integers(len(INTEGERS))]) & (2 ** (8 * width) - 1)
            number = value.to_bytes(width, order)
        else:
            dtype = np.float32 if rng.random() < 0.5 else np.float64
            with np.errstate(over="ignore"):
                number = dtype(FLOATS[rng.integers(len(FLOATS))]).tobytes()
        at = _place(data, rng, len(number))
        data[at : at + len(number)] = number
        return data
    if kind in (0, 1, 7):
        at = _place(data, rng)
        if kind == 7:
            data[at:at] = rng.bytes(int(rng.integers(1, 64)))
        elif data:
            data[at] = data[at] ^ 1 << int(rng.integers(8)) if kind == 0 else rng.integers(256)
        return data
    start = _place(data, rng)
    end = start + int(rng.integers(1, max(2, min(len(data) - start, 64))))
    match kind:
        case 5:
            del data[start:end]
        case 6:
            data[start:start] = data[start:end]
        case 8:
            data[start:end] = (b"\0" if rng.random() < 0.5 else b"\xff") * len(data[start:end])
        case 9:
            other = _place(data, rng, end - start)
            data[start:end], data[other : other + end - start] = data[other : other + end - start], data[start:end]
    return data


# Texts


def _changed_text(text, rng):
    """Another word, or lines that go, move, come twice, or are the last, or other bytes."""
    kind = rng.integers(4)
    if kind == 3:
        return of_bytes(text.encode("utf-8", "surrogatepass"), rng).decode("utf-8", "replace")
    if kind < 2:
        words = [*re.finditer(r"[^\s,\[\]{}=\"]+", text)]
        if not words:
            return text
        word = words[rng.integers(len(words))]
        return text[: word.start()] + str(WORDS[rng.integers(len(WORDS))]) + text[word.end() :]
    lines = text.split("\n")
    first, second = (int(rng.integers(len(lines))) for _ in range(2))
    match rng.integers(4):
        case 0:
            del lines[first]
        case 1:
            lines.insert(second, lines[first])
        case 2:
            lines[first], lines[second] = lines[second], lines[first]
        case 3:
            lines = lines[: first + 1]
    return "\n".join(lines)


# JSON


def strange(rng):
    """A value of a type that was not asked for."""
    values = (
        None, True, False, "", "x", [], {}, [[]], [1, 2], {"a": 1}, 0, -1, 1.5, 1e308, 10**400, 2**64, "NESTED",
        "DIGITS", float("nan"), float("inf"), "../../x.png", "/etc/passwd", "a" * 10_000, "\0", "\ud800", [0] * 1000,
        -1e9,
    )  # fmt: skip
    return copy.deepcopy(values[rng.integers(len(values))])


def changed_value(value, rng, other=strange):
    """A value of which one part, anywhere in it, is another; `other` makes such a part."""
    if isinstance(value, dict | list) and value and rng.random() < 0.85:
        keys = list(value) if isinstance(value, dict) else range(len(value))
        key = keys[int(rng.integers(len(keys)))]
        chance = rng.random()
        if chance < 0.1:
            value.pop(key)
        elif chance < 0.2 and isinstance(value, list):
            value.insert(int(rng.integers(len(value))), copy.deepcopy(value[key]))
        elif chance < 0.2:
            value[f"{key}x"] = value.pop(key)
        else:
            value[key] = changed_value(value[key], rng, other)
        return value
    is_number = isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < 1e300
    if is_number and rng.random() < 0.4:
        return value * float(rng.choice([-1, 0, 1e3, 1e-3, 1e30, 1 + 1e-3]))
    return other(rng)


# Archives


def zipped(entries, compression=zipfile.ZIP_STORED):
    """The bytes of an archive."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", compression) as archive:
        for name, data in entries.items():
            archive.writestr(zipfile.ZipInfo(name), data, compression)  # Without the time of day.
    return buffer.getvalue()


def packed(array):
    """The bytes of an .npy."""
    buffer = io.BytesIO()
    np.save(buffer, array, allow_pickle=True)
    return buffer.getvalue()


def _any_array(entries, rng):
    names = [name for name in entries if name != "header.npy"]
    name = names[int(rng.integers(len(names)))]
    try:
        return name, np.load(io.BytesIO(entries[name]), allow_pickle=False)
    except ValueError:  # After an earlier change.
        return name, np.zeros(3)


def _change_array(entries, rng):
    """Other numbers, another shape, or another dtype of an array."""
    name, array = _any_array(entries, rng)
    match rng.integers(5):
        case 0 | 1:
            array = array.copy()
            if array.size and array.dtype.kind in "iuf":
                values = FLOATS if array.dtype.kind == "f" else [v for v in INTEGERS if v <= np.iinfo(array.dtype).max]
                places = slice(None) if rng.random() < 0.2 else rng.integers(array.size, size=int(rng.integers(1, 4)))
                with np.errstate(all="ignore"):
                    array.reshape(-1)[places] = np.asarray(values[rng.integers(len(values))]).astype(array.dtype)
        case 2 | 3:
            changes = (
                lambda x: x[1:] if x.ndim else x[None], lambda x: x[..., None], np.ravel, np.transpose,
                lambda x: x[None], lambda x: x[:0] if x.ndim else x, lambda x: x.reshape(-1)[:1],
                lambda x: np.concatenate([x, x]) if x.ndim else np.stack([x, x]),
                lambda x: np.repeat(x, 2, axis=-1) if x.ndim else x,
            )  # fmt: skip
            array = np.asarray(changes[rng.integers(len(changes))](array))
        case 4:
            kind = str(rng.choice(["f8", "f2", ">f4", "i4", "u1", "i8", "?", "U5", "c8", "O", "S3"]))
            with np.errstate(all="ignore"):
                array = (np.nan_to_num(array) if kind in ("i4", "u1", "i8") else array).astype(kind)
    entries[name] = packed(array)


def _move_entries(entries, rng):
    names = list(entries)
    first, second = (names[int(rng.integers(len(names)))] for _ in range(2))
    match rng.integers(4):
        case 0:
            del entries[first]
        case 1:
            entries[first], entries[second] = entries[second], entries[first]
        case 2:
            entries[f"{first}x"] = entries.pop(first)
        case 3:
            entries[f"../../{first}"] = entries[first]


def _change_header(entries, rng):
    if "header.npy" in entries:
        text = entries["header.npy"][START_OF_TEXT:]  # A short .npy of bytes; what is wrong with it now goes.
        change = of_json if rng.random() < 0.8 else of_bytes
        entries["header.npy"] = packed(np.frombuffer(change(text, rng), np.uint8))


def _lie(entries, rng):
    """Another shape or dtype in what an array says of itself, of the same length."""
    name, _ = _any_array(entries, rng)
    data = entries[name]
    length = int.from_bytes(data[8:10], "little")
    text = of_text(data[10 : 10 + length], rng)[:length].ljust(length)
    entries[name] = data[:10] + text + data[10 + length :]


def _change_entry_bytes(entries, rng):
    names = list(entries)
    name = names[int(rng.integers(len(names)))]
    entries[name] = of_bytes(entries[name], rng)


ENTRY_CHANGES = (
    *(_change_array,) * 5, _move_entries, _change_header, _change_header, _lie, _change_entry_bytes,
)  # fmt: skip
