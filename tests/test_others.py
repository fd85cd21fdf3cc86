"""Files that other programs wrote, and what our files hold for a reader that shares no code with ours or gaussforge.

tests/data/others/scene.ply is 90 flat splats of random numbers. GaussianSplats3D 0.4.7 wrote it as *.ksplat
(`write.mjs` beside it, with bucket sizes of 16 and sections of 40 splats for degree 2), and splat-transform 3.7.0 as
the others: `splat-transform -g cpu scene.ply scene.sog`.
"""

import dataclasses
import gzip
import io
import json
import struct
import zipfile
from pathlib import Path

import numpy as np
import oracle
import pytest
from PIL import Image
from small_values import some_gaussians

from a2tg_jax import Gaussians, Model, load_ply, load_splats, save_splats

OTHERS = Path(__file__).parent / "data" / "others"
NUM = 90
C0 = 1 / (2 * np.sqrt(np.pi))
HEADER, SECTION = 4096, 1024
LEVEL1 = OTHERS / "level1-degree2.ksplat"
LEVEL2 = OTHERS / "level2-degree2.ksplat"


def scene() -> dict[str, np.ndarray]:
    """The numbers of scene.ply, float64: means, quats, log_scales [N, 2], opacities, colors and rest [N, 15, 3]."""
    header, data = (OTHERS / "scene.ply").read_bytes().split(b"end_header\n", 1)
    names = [line.split()[-1].decode() for line in header.splitlines() if line.startswith(b"property float ")]
    columns = dict(zip(names, np.frombuffer(data, "<f4").reshape(NUM, -1).T.astype(np.float64), strict=True))
    several = lambda pattern, num: np.stack([columns[pattern.format(i)] for i in range(num)], axis=1)  # noqa: E731
    return {
        "means": np.stack([columns[axis] for axis in "xyz"], axis=1),
        "quats": several("rot_{}", 4),
        "log_scales": several("scale_{}", 2),
        "opacities": 1 / (1 + np.exp(-columns["opacity"])),
        "colors": 0.5 + C0 * several("f_dc_{}", 3),
        "rest": several("f_rest_{}", 45).reshape(NUM, 3, 15).transpose(0, 2, 1),
    }


def numbers(gaussians: Gaussians) -> dict[str, np.ndarray]:
    """The same numbers of Gaussians."""
    sh = np.asarray(gaussians.sh, np.float64)
    own = {name: np.asarray(getattr(gaussians, name), np.float64) for name in ("means", "quats", "log_scales")}
    return own | {"opacities": np.asarray(gaussians.opacities), "colors": 0.5 + C0 * sh[:, 0], "rest": sh[:, 1:]}


def check(
    found: dict, wanted: dict, means: float, log_scales: float, byte: float, rest: float, turn: float = 1e-4
) -> None:
    """Compares numbers after matching rows by their means, the colours and opacities within steps of a byte."""
    order = np.linalg.norm(found["means"][:, None] - wanted["means"], axis=-1).argmin(axis=1)
    assert sorted(order) == list(range(len(wanted["means"])))
    wanted = {name: values[order] for name, values in wanted.items()}
    np.testing.assert_allclose(found["means"], wanted["means"], atol=means)
    np.testing.assert_allclose(found["log_scales"], wanted["log_scales"], atol=log_scales)
    np.testing.assert_allclose(found["opacities"], wanted["opacities"], atol=byte / 255 + 1e-6)
    np.testing.assert_allclose(found["colors"], wanted["colors"], atol=byte / 255 + 1e-6)
    lengths = np.linalg.norm(found["quats"], axis=1) * np.linalg.norm(wanted["quats"], axis=1)
    assert np.abs(np.sum(found["quats"] * wanted["quats"], axis=1) / lengths).min() > 1 - turn
    np.testing.assert_allclose(found["rest"], wanted["rest"][:, : found["rest"].shape[1]], atol=rest)


@pytest.mark.parametrize(
    ("name", "num_rest", "tolerances"),
    [
        ("level0-degree1.ksplat", 3, (1e-6, 1e-6, 1, 1e-6)),
        ("level1-degree0.ksplat", 0, (1e-4, 1e-3, 1, 0)),
        ("level1-degree2.ksplat", 8, (1e-4, 1e-3, 1, 1e-3)),
        ("level2-degree2.ksplat", 8, (1e-4, 1e-3, 1, 8e-3)),
        ("scene.compressed.ply", 15, (7e-3, 3e-3, 0.6, 0.017)),
        ("scene.spz", 15, (2e-4, 0.032, 1, 0.07)),
        ("scene.sog", 15, (1e-3, 0.03, 1, 1e-6)),
    ],
)
def test_files_of_other_programs_hold_their_numbers(name, num_rest, tolerances):
    found = numbers(load_splats(OTHERS / name).gaussians)
    wanted = scene()
    assert found["rest"].shape == (NUM, num_rest, 3)
    if name.endswith(".sog"):
        wanted["rest"] = sog_palette(OTHERS / name)[match(wanted["means"], found["means"])]
    check(found, wanted, *tolerances)


def match(means: np.ndarray, others: np.ndarray) -> np.ndarray:
    """For each of some means the row of the nearest other."""
    return np.linalg.norm(means[:, None] - others, axis=-1).argmin(axis=1)


def sog_palette(path: Path) -> np.ndarray:
    """Coefficients [N, 15, 3] of a SOG file, which has them in a palette of 64 entries a row, as they lie in it."""
    with zipfile.ZipFile(path) as archive:
        described = json.loads(archive.read("meta.json"))["shN"]
        centroids, labels = (
            np.asarray(Image.open(io.BytesIO(archive.read(name))).convert("RGB")).astype(int)
            for name in described["files"]
        )
    place = (labels[..., 0] + 256 * labels[..., 1]).ravel()[:NUM]
    codes = centroids[place[:, None] // 64, place[:, None] % 64 * 15 + np.arange(15)]
    return np.asarray(described["codebook"])[codes]


def test_glb_of_splat_transform():
    """It takes a PLY for a world whose +y is down, and turns it half about z; this library turns +y into +z after."""
    gaussians = load_splats(OTHERS / "scene.glb").gaussians
    wanted = scene()
    found = numbers(gaussians)
    turn = np.array([[-1.0, 0, 0], [0, 0, -1], [0, -1, 0]])
    np.testing.assert_allclose(found["means"], wanted["means"] @ turn.T, atol=1e-5)
    np.testing.assert_allclose(found["log_scales"], wanted["log_scales"], atol=1e-5)
    np.testing.assert_allclose(found["opacities"], wanted["opacities"], atol=1e-5)
    np.testing.assert_allclose(found["colors"], wanted["colors"], atol=1e-5)
    axes = [np.array([oracle.rotation_matrix(q) for q in one["quats"]]) for one in (found, wanted)]
    np.testing.assert_allclose(np.abs(axes[0]), np.abs(turn @ axes[1]), atol=1e-5)
    for direction in np.random.default_rng(0).normal(size=(5, 3)):
        direction /= np.linalg.norm(direction)
        before = np.einsum("k,nkc->nc", oracle.sh_basis(direction)[1:], wanted["rest"])
        after = np.einsum("k,nkc->nc", oracle.sh_basis(turn @ direction)[1:], found["rest"])
        np.testing.assert_allclose(after, before, atol=1e-5)


@pytest.mark.parametrize("version", [2, 3])
def test_spz_of_older_versions(tmp_path, version):
    """Version 2 has x, y, z of a rotation in bytes; version 3 the three smallest numbers in 10 bits each."""
    wanted = scene()
    to_bytes = lambda values: np.clip(np.rint(values), 0, 255).astype(np.uint8)  # noqa: E731
    fixed = np.rint(wanted["means"] * 4096).astype("<i4")
    quats = wanted["quats"] * np.sign(wanted["quats"][:, :1])
    if version == 2:
        rotations = to_bytes(quats[:, 1:] * 127.5 + 127.5)
    else:
        rotations = np.array([smallest_three(quat) for quat in quats], "<u4")
    log_scales = np.concatenate([wanted["log_scales"], np.full((NUM, 1), -10.0)], axis=1)
    columns = [
        fixed.view(np.uint8).reshape(NUM, 3, 4)[..., :3], to_bytes(255 * wanted["opacities"]),
        to_bytes(255 * (0.15 * (wanted["colors"] - 0.5) / C0 + 0.5)), to_bytes(16 * (log_scales + 10)), rotations,
        to_bytes(128 * wanted["rest"] + 128),
    ]  # fmt: skip
    data = struct.pack("<4sIIBBBB", b"NGSP", version, NUM, 3, 12, 0, 0) + b"".join(part.tobytes() for part in columns)
    (tmp_path / "a.spz").write_bytes(gzip.compress(data))
    found = numbers(load_splats(tmp_path / "a.spz").gaussians)
    check(found, wanted, 2e-4, 0.032, 1.0, 0.005, turn=2e-3 if version == 2 else 1e-5)


def smallest_three(quat: np.ndarray) -> int:
    """A rotation w, x, y, z in 32 bits: the index of its largest number of x, y, z, w, then the others, sign first."""
    xyzw = quat[[1, 2, 3, 0]]
    largest = int(np.argmax(np.abs(xyzw)))
    packed = largest
    for k in range(4):
        if k != largest:
            is_negative = bool(xyzw[k] < 0) != bool(xyzw[largest] < 0)
            packed = packed << 10 | is_negative << 9 | int(511 * np.sqrt(2) * abs(xyzw[k]) + 0.5)
    return packed


# What is written


@pytest.mark.parametrize("degree", range(4))
def test_ksplat_is_what_gaussian_splats_3d_counts_and_reads(tmp_path, degree):
    """One section of compression level 0: rows of floats, but for four bytes of colour."""
    gaussians = load_ply(OTHERS / "scene.ply")
    kept = min(degree, 2)
    save_splats(tmp_path / "a.ksplat", Model(dataclasses.replace(gaussians, sh=gaussians.sh[:, : (degree + 1) ** 2])))
    data = (tmp_path / "a.ksplat").read_bytes()
    num_rest = 3 * ((kept + 1) ** 2 - 1)
    assert data[:4] == bytes([0, 1, 0, 0])
    assert np.frombuffer(data, "<u4", 4, 4).tolist() == [1, 1, NUM, NUM]  # Sections and splats, most and present.
    assert np.frombuffer(data, "<u2", 1, 20) == 0
    section = np.frombuffer(data, "<u4", 10, HEADER)
    assert section.tolist() == [NUM, NUM, 0, 0, 0, 0, 0, NUM * (44 + 4 * num_rest), 0, 0]
    assert np.frombuffer(data, "<u2", 1, HEADER + 40) == kept
    rows = np.frombuffer(data[HEADER + SECTION :], np.uint8).reshape(NUM, 44 + 4 * num_rest)
    floats = lambda columns: np.ascontiguousarray(rows[:, columns]).view("<f4").astype(np.float64)  # noqa: E731
    body = floats(slice(0, 40))
    colors = rows[:, 40:44] / 255
    rest = floats(slice(44, None))
    bands = [(0, 3), (9, 5)][:kept]  # Start and width of each degree; red first, then green, then blue.
    parts = [
        rest[:, start : start + 3 * width].reshape(NUM, 3, width).transpose(0, 2, 1) for start, width in bands
    ] or [np.zeros((NUM, 0, 3))]
    found = {
        "means": body[:, :3], "log_scales": np.log(body[:, 3:5]), "quats": body[:, 6:10], "colors": colors[:, :3],
        "opacities": colors[:, 3], "rest": np.concatenate(parts, axis=1),
    }  # fmt: skip
    check(found, scene(), 1e-6, 1e-5, 0.51, 1e-6)
    assert (body[:, 5] < 0.0011 * body[:, 3:5].min(axis=1)).all()


def test_splat_has_rows_of_32_bytes(tmp_path):
    save_splats(tmp_path / "a.splat", load_splats(OTHERS / "scene.ply"))
    rows = np.frombuffer((tmp_path / "a.splat").read_bytes(), np.uint8).reshape(NUM, 32)
    body = np.ascontiguousarray(rows[:, :24]).view("<f4").astype(np.float64)
    quats = (rows[:, 28:].astype(np.float64) - 128) / 128
    found = {
        "means": body[:, :3], "log_scales": np.log(body[:, 3:5]), "quats": quats, "colors": rows[:, 24:27] / 255,
        "opacities": rows[:, 27] / 255, "rest": np.zeros((NUM, 0, 3)),
    }  # fmt: skip
    check(found, scene(), 1e-6, 1e-5, 1.01, 0)


def test_ksplat_sections_of_different_degrees(tmp_path):
    """Two files made one by hand: the first 90 splats lack the coefficients that the others have."""
    gaussians = load_ply(OTHERS / "scene.ply")
    parts = []
    for degree in (0, 1):
        save_splats(tmp_path / "a.ksplat", Model(dataclasses.replace(gaussians, sh=gaussians.sh[:, : 1 + 3 * degree])))
        data = (tmp_path / "a.ksplat").read_bytes()
        parts.append((data[HEADER : HEADER + SECTION], data[HEADER + SECTION :]))
    header = data[:4] + struct.pack("<4I", 2, 2, 2 * NUM, 2 * NUM) + data[20:HEADER]
    (tmp_path / "b.ksplat").write_bytes(header + b"".join(parts[0][i] + parts[1][i] for i in (0, 1)))
    found = load_splats(tmp_path / "b.ksplat").gaussians
    sh = np.asarray(found.sh)
    assert sh.shape == (2 * NUM, 4, 3) and not sh[:NUM, 1:].any()
    order = match(np.asarray(found.means)[NUM:], np.asarray(gaussians.means))
    np.testing.assert_allclose(sh[NUM:, 1:], np.asarray(gaussians.sh)[order, 1:4], atol=1e-6)


def test_ksplat_without_counts_in_its_first_header_is_read(tmp_path):
    """As gaussforge wrote them, which earlier versions of this library used."""
    data = bytearray((OTHERS / "level0-degree1.ksplat").read_bytes())
    data[8:16] = bytes(8)
    (tmp_path / "a.ksplat").write_bytes(data)
    check(numbers(load_splats(tmp_path / "a.ksplat").gaussians), scene(), 1e-6, 1e-6, 1, 1e-6)


# Damaged .ksplat files


def changed(tmp_path: Path, source: Path, place: int, kind: str, value: float) -> Path:
    data = bytearray(source.read_bytes())
    struct.pack_into(f"<{kind}", data, place, value)
    (tmp_path / "bad.ksplat").write_bytes(bytes(data))
    return tmp_path / "bad.ksplat"


@pytest.mark.parametrize(
    ("place", "kind", "value", "match"),
    [
        (0, "B", 1, r"version 0\.1 .* got 1\.1"),
        (20, "H", 3, "level 3"),
        (4, "I", 2**32 - 1, "is cut off: 4294967295 sections"),
        (4, "I", 0, "holds no splats"),
        (HEADER, "I", 41, "41 of 40 splats"),
        (HEADER + 4, "I", 2**32 - 1, "is cut off: a section ends at"),
        (HEADER + 12, "I", 2**31, "buckets of 2147483648"),
        (HEADER + 20, "H", 16, "bucket centres of 16 bytes"),
        (HEADER + 32, "I", 0, "0 full and 5 other buckets"),
        (HEADER + 40, "H", 4, "of degree 4"),
        (HEADER + 3 * SECTION, "I", 0, "have fewer than its 40 splats"),
    ],
)
def test_ksplat_files_that_contradict_themselves_are_refused(tmp_path, place, kind, value, match):
    with pytest.raises(ValueError, match=rf"bad\.ksplat: .*{match}"):
        load_splats(changed(tmp_path, LEVEL1, place, kind, value))


@pytest.mark.parametrize("source", [LEVEL1, LEVEL2, OTHERS / "level0-degree1.ksplat"])
def test_ksplat_files_that_are_cut_off_are_refused(tmp_path, source):
    data = source.read_bytes()
    for length in (0, 3, HEADER, HEADER + SECTION, len(data) // 2, len(data) - 1):
        (tmp_path / "bad.ksplat").write_bytes(data[:length])
        with pytest.raises(ValueError, match=r"bad\.ksplat: .*is cut off|holds no splats"):
            load_splats(tmp_path / "bad.ksplat")


def test_a_ksplat_section_in_a_bucket_at_infinity_is_left_out_and_counted(tmp_path):
    with pytest.warns(UserWarning, match=r"bad\.ksplat: 40 Gaussians of 90 left out"):
        assert load_splats(changed(tmp_path, LEVEL1, HEADER + 16, "f", np.inf)).num == 50


def test_missing_and_empty(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"nowhere\.ksplat"):
        load_splats(tmp_path / "nowhere.ksplat")
    with pytest.raises(ValueError, match="has no Gaussians"):
        save_splats(tmp_path / "a.ksplat", Model(some_gaussians(3)[:0]))
