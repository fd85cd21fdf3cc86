"""SPZ: axes that files declare, versions, glTF that holds SPZ, and damaged files."""

import base64
import dataclasses
import gzip
import json
import struct

import numpy as np
import oracle
import pytest
import zstandard
from small_values import some_gaussians
from test_others import OTHERS, numbers

from a2tg_jax import Gaussians, Model, load_splats, save_splats

SCENE = (OTHERS / "scene.spz").read_bytes()
AXES = ["LDB", "RDB", "LUB", "RUB", "LDF", "RDF", "LUF", "RUF", "LFD", "RFD", "LFU", "RFU", "LBD", "RBD", "LBU", "RBU"]
"""In the order of Niantic's enumeration, which begins at 1."""
PLACES = {"R": (0, 1), "L": (0, -1), "D": (1, 1), "U": (1, -1), "F": (2, 1), "B": (2, -1)}
"""Axis and sign of a direction in a PLY, whose x, y and z are right, down and front."""
SAFE_ORBIT = struct.pack("<IIfff", 0xADBE0002, 12, -0.5, 0.5, 1.0)


def with_records(*records: bytes) -> bytes:
    """The file of splat-transform, of version 4, with records of extensions."""
    head = bytearray(SCENE[:32])
    rest = SCENE[32:]
    head[14] |= 2
    struct.pack_into("<I", head, 16, 32 + len(b"".join(records)))
    return bytes(head) + b"".join(records) + rest


def declaring(number: int) -> bytes:
    return struct.pack("<III", 0xADBE0003, 4, number)


def loaded(tmp_path, data: bytes, name: str = "a.spz") -> Gaussians:
    (tmp_path / name).write_bytes(data)
    return load_splats(tmp_path / name).gaussians


@pytest.mark.parametrize("axes", AXES)
def test_declared_axes_become_those_of_a_ply(tmp_path, axes):
    """Positions, covariances and colours in all directions, of left-handed axes too."""
    plain, found = (
        numbers(loaded(tmp_path, data)) for data in (SCENE, with_records(SAFE_ORBIT, declaring(AXES.index(axes) + 1)))
    )
    turn = np.zeros((3, 3))
    for own, letter in enumerate(axes):
        place, sign = PLACES[letter]
        turn[place, own] = sign
    np.testing.assert_allclose(found["means"], plain["means"] @ turn.T, atol=1e-6)
    for one in (plain, found):
        axes_of_splats = np.array([oracle.rotation_matrix(quat) for quat in one["quats"]])[:, :, :2]
        scaled = axes_of_splats * np.exp(one["log_scales"])[:, None]
        one["covariances"] = scaled @ scaled.transpose(0, 2, 1)
    np.testing.assert_allclose(found["covariances"], turn @ plain["covariances"] @ turn.T, rtol=1e-4, atol=1e-6)
    np.testing.assert_array_equal(found["colors"], plain["colors"])
    for direction in np.random.default_rng(0).normal(size=(4, 3)):
        direction /= np.linalg.norm(direction)
        before = np.einsum("k,nkc->nc", oracle.sh_basis(direction)[1:], plain["rest"])
        after = np.einsum("k,nkc->nc", oracle.sh_basis(turn @ direction)[1:], found["rest"])
        np.testing.assert_allclose(after, before, atol=1e-5)


def test_undeclared_and_unspecified_axes_and_unknown_records_change_nothing(tmp_path):
    plain = loaded(tmp_path, SCENE)
    unknown = struct.pack("<II", 0x12340001, 5) + b"hello"
    for records in ((unknown,), (declaring(0),), (declaring(AXES.index("RDF") + 1), unknown), (b"\0" * 4,)):
        np.testing.assert_array_equal(loaded(tmp_path, with_records(*records)).means, plain.means)


def test_a_gzip_stream_may_declare_axes(tmp_path):
    """Version 3 has the records after its columns."""
    save_splats(tmp_path / "a.spz", load_splats(OTHERS / "scene.spz"))
    plain = load_splats(tmp_path / "a.spz").gaussians
    data = bytearray(gzip.decompress((tmp_path / "a.spz").read_bytes()))
    data[14] |= 2
    found = loaded(tmp_path, gzip.compress(bytes(data) + declaring(AXES.index("RUB") + 1)))
    np.testing.assert_array_equal(found.means, np.asarray(plain.means) * [1, -1, -1])


def test_version_1_has_positions_in_halves(tmp_path):
    means = np.array([[0.5, -1.25, 3.0], [100.0, 0.0, -7.0]])
    columns = (
        means.astype("<f2").tobytes(),
        b"\x80\xff",
        b"\x80" * 6,
        b"\x60\x60\x00" * 2,
        b"\xff\x80\x80" + b"\x80" * 3,
    )
    data = struct.pack("<4sIIBBBB", b"NGSP", 1, 2, 0, 0, 0, 0) + b"".join(columns)
    found = loaded(tmp_path, gzip.compress(data))
    np.testing.assert_array_equal(found.means, means)
    np.testing.assert_allclose(found.opacities, [128 / 255, 1], atol=2e-6)
    np.testing.assert_allclose(np.abs(found.quats[0]), [0, 1, 0, 0], atol=0.01)


def test_degree_4_is_read_without_its_highest_coefficients(tmp_path):
    """Niantic's library writes up to degree 4."""
    save_splats(tmp_path / "a.spz", Model(some_gaussians(7)))
    plain = load_splats(tmp_path / "a.spz").gaussians
    data = gzip.decompress((tmp_path / "a.spz").read_bytes())
    sh = np.frombuffer(data[16 + 20 * 7 :], np.uint8).reshape(7, 45)
    data = data[:12] + b"\4" + data[13 : 16 + 20 * 7] + np.pad(sh, ((0, 0), (0, 27)), constant_values=200).tobytes()
    with pytest.warns(UserWarning, match=r"a\.spz: has SH of degree 4; degree 3 is read"):
        np.testing.assert_array_equal(loaded(tmp_path, gzip.compress(data)).sh, plain.sh)


# glTF


def gltf_of(spz: bytes, name: str) -> dict:
    """A glTF whose splats are in an SPZ file; attributes have no bytes of their own."""
    inside = {name: {"bufferView": 0}}
    is_alone = name == "KHR_spz_gaussian_splats_compression"
    extensions = inside if is_alone else {"KHR_gaussian_splatting": {"extensions": inside}}
    uri = f"data:application/octet-stream;base64,{base64.b64encode(b'pad!' + spz).decode()}"
    return {
        "asset": {"version": "2.0"}, "extensionsUsed": [name, "KHR_gaussian_splatting"], "extensionsRequired": [name],
        "buffers": [{"byteLength": 4 + len(spz), "uri": uri}],
        "bufferViews": [{"buffer": 0, "byteOffset": 4, "byteLength": len(spz)}],
        "accessors": [{"componentType": 5126, "type": "VEC3", "count": 90}],
        "nodes": [{"mesh": 0}], "scenes": [{"nodes": [0]}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "mode": 0, "extensions": extensions}]}],
    }  # fmt: skip


def glb_of(described: dict) -> bytes:
    """The same as a *.glb."""
    binary = base64.b64decode(described["buffers"][0]["uri"].partition(",")[2])
    described = described | {"buffers": [{"byteLength": len(binary)}]}
    parts = (json.dumps(described).encode(), b" ", 0x4E4F534A), (binary, b"\0", 0x004E4942)
    chunks = [(data + padding * (-len(data) % 4), kind) for data, padding, kind in parts]
    body = b"".join(struct.pack("<II", len(data), kind) + data for data, kind in chunks)
    return struct.pack("<4sII", b"glTF", 2, 12 + len(body)) + body


@pytest.mark.parametrize(
    "name",
    [
        "KHR_gaussian_splatting_compression_spz_2", "KHR_gaussian_splatting_compression_spz",
        "KHR_spz_gaussian_splats_compression",
    ],
)  # fmt: skip
def test_gltf_with_spz_inside_is_read(tmp_path, name):
    """x, y and z of the file are those of glTF, whose +y is up; here +z is up. A file that declares axes is turned."""
    plain = np.asarray(loaded(tmp_path, SCENE).means)
    for records, turned in (((), plain), ((declaring(AXES.index("RDF") + 1),), plain * [1, -1, -1])):
        described = gltf_of(with_records(*records), name)
        found = loaded(tmp_path, glb_of(described), "a.glb")
        assert found == loaded(tmp_path, json.dumps(described).encode(), "a.gltf")
        np.testing.assert_allclose(found.means, turned @ np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]]).T, atol=1e-6)
        assert found.sh.shape == (90, 16, 3)


def test_gltf_with_damaged_spz_names_the_gltf(tmp_path):
    name = "KHR_gaussian_splatting_compression_spz_2"
    for spz in (SCENE[:100], b"nothing"):
        with pytest.raises(ValueError, match=r"a\.gltf: is (damaged|not SPZ)"):
            loaded(tmp_path, json.dumps(gltf_of(spz, name)).encode(), "a.gltf")
    described = gltf_of(SCENE, name)
    described["bufferViews"][0]["byteLength"] += 1
    with pytest.raises(ValueError, match=r"a\.gltf: .*reaches beyond its buffer"):
        loaded(tmp_path, json.dumps(described).encode(), "a.gltf")


# Damaged files


def stream(place: int, kind: str, value: float) -> bytes:
    """The file of version 4 with another number in it."""
    data = bytearray(SCENE)
    struct.pack_into(f"<{kind}", data, place, value)
    return bytes(data)


def old(place: int = 0, kind: str = "4s", value: object = b"NGSP", length: int | None = None) -> bytes:
    """A sound file of version 2 with another number in it, cut to a length before it is compressed."""
    data = bytearray(struct.pack("<4sIIBBBB", b"NGSP", 2, 3, 0, 12, 0, 0) + bytes(3 * 19))
    struct.pack_into(f"<{kind}", data, place, value)
    return gzip.compress(bytes(data)[:length])


HUGE = zstandard.ZstdCompressor().compress(bytes(1 << 26))
DAMAGED = {
    "nothing": (b"", "is not SPZ"),
    "text": (b"nothing of the kind", "is not SPZ"),
    "magic": (SCENE[:3], "is not SPZ"),
    "head": (SCENE[:15], "is cut off: its header"),
    "half of the head": (SCENE[:20], "has no plain header"),
    "version": (stream(4, "I", 5), "version 1 to 4; got b'NGSP', version 5"),
    "old version in a plain file": (stream(4, "I", 3), "has no plain header"),
    "new version in a gzip stream": (old(4, "I", 4), "is no gzip stream"),
    "no splats": (stream(8, "I", 0), "holds no splats"),
    "a splat more": (stream(8, "I", 91), r"is damaged or cut off: \d+ bytes of positions"),
    "billions of splats": (stream(8, "I", 2**32 - 1), "claims 4,294,967,295 splats"),
    "degree": (stream(12, "B", 5), "has degree 5"),
    "another degree": (stream(12, "B", 2), "bytes of sh"),
    "no degree": (stream(12, "B", 0), "it has 6 streams, where degree 0 has 5"),
    "fractional bits": (stream(13, "B", 200), "200 fractional bits"),
    "streams": (stream(15, "B", 255), "it has 255 streams"),
    "table beyond the end": (stream(16, "I", 2**32 - 1), "a table at|their table at byte 4,294,967,295"),
    "table in the head": (stream(16, "I", 8), "table at byte 8"),
    "compressed length": (stream(32, "Q", 2**64 - 1), "bytes of positions at byte"),
    "unpacked length": (stream(40, "Q", 2**40), "unpack to 1,099,511,627,776"),
    "cut": (SCENE[:-1], "is damaged or cut off: .* bytes of sh"),
    "frame": (SCENE[:140] + b"\0" * 8 + SCENE[148:], "cannot be unpacked|is damaged"),
    "extension beyond the end": (with_records(struct.pack("<II", 1, 100)), "an extension has 100 bytes, and 0 are"),
    "axes": (with_records(declaring(17)), "declares axes by number 17; 1 to 16 are known"),
    "long axes": (with_records(struct.pack("<IIQ", 0xADBE0003, 8, 4)), "declares axes"),
    "gzip cut": (old()[:-10], "is cut off: its gzip stream has no end"),
    "gzip damaged": (old()[:10] + b"\xff" * 5 + old()[15:], "gzip stream cannot be unpacked"),
    "gzip bomb": (gzip.compress(bytes(1 << 24)), "unpacks to more than 64 times"),
    "gzip of nothing": (gzip.compress(b""), "is cut off: its header"),
    "column cut": (old(length=60), "3 splats need 73 bytes, and 60 are there"),
    "billions in a gzip stream": (old(8, "I", 2**32 - 1), "is cut off: 4,294,967,295 splats"),
}


@pytest.mark.parametrize("kind", DAMAGED)
def test_damaged_files_are_refused_with_what_is_wrong(tmp_path, kind):
    data, reason = DAMAGED[kind]
    with pytest.raises(ValueError, match=rf"a\.spz: .*({reason})") as caught:
        loaded(tmp_path, data)
    assert "\n" not in str(caught.value) and len(str(caught.value)) < 300


def test_a_frame_that_announces_more_is_not_unpacked(tmp_path):
    """The table says 810 bytes, zstd's own header 64 MiB."""
    place = 32 + 16 * 6
    (packed,) = struct.unpack_from("<Q", SCENE, 32)
    data = bytearray(SCENE[:place] + HUGE + SCENE[place + packed :])
    struct.pack_into("<Q", data, 32, len(HUGE))
    with pytest.raises(ValueError, match=r"positions cannot be unpacked \(its frame announces 67,108,864 bytes\)"):
        loaded(tmp_path, bytes(data))


def test_a_file_of_any_length_is_refused_or_whole(tmp_path):
    for length in range(0, len(SCENE), 97):
        with pytest.raises(ValueError, match=r"a\.spz: "):
            loaded(tmp_path, SCENE[:length])
    sound = load_splats(OTHERS / "scene.spz")
    np.testing.assert_array_equal(loaded(tmp_path, SCENE).means, sound.gaussians.means)
    assert dataclasses.asdict(sound.gaussians).keys()
