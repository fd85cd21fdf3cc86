"""Photographs that are broken, too large, too deep or somewhere else, and names of results."""

import io
import itertools
import struct
import sys
import tracemalloc
import zlib

import numpy as np
import pytest
from PIL import Image

from a2tg_jax.data import decoding
from a2tg_jax.data.decoding import MAX_PIXELS, picture_facts, read_pixels
from a2tg_jax.results.folder import RunFolder
from a2tg_jax.results.images import picture_names, save_picture

CHANNELS = {0: 1, 2: 3, 4: 2, 6: 4}
"""Of the colour types of PNG."""


def png(width, height, *, depth=8, color_type=2, rows=None):
    """A PNG of zeros, or of fewer rows than its header says."""

    def chunk(kind, data):
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = struct.pack(">IIBBBBB", width, height, depth, color_type, 0, 0, 0)
    line = bytes(1 + width * CHANNELS[color_type] * depth // 8)
    packer = zlib.compressobj(9)
    data = b"".join(packer.compress(line) for _ in range(height if rows is None else rows)) + packer.flush()
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", data) + chunk(b"IEND", b"")


def tiff(num_channels, is_planar=False):
    """An uncompressed TIFF of 4 × 3 pixels of 16 bits a channel; Pillow cannot write them."""
    size = 4 * 3 * 2
    parts = num_channels if is_planar else 1
    bits_at = 8 + 2 + 12 * 10 + 4
    offsets_at = bits_at + 2 * num_channels
    data_at = offsets_at + 8 * parts
    entries = [
        (256, 4, 1, 4), (257, 4, 1, 3), (258, 3, num_channels, bits_at), (259, 3, 1, 1),
        (262, 3, 1, 2), (273, 4, parts, offsets_at if is_planar else data_at), (277, 3, 1, num_channels),
        (278, 3, 1, 3), (279, 4, parts, offsets_at + 4 * parts if is_planar else size * num_channels),
        (284, 3, 1, 2 if is_planar else 1),
    ]  # fmt: skip
    table = b"".join(struct.pack("<HHII", *entry) for entry in entries)
    tables = struct.pack(f"<{parts}I", *(data_at + size * part for part in range(parts)))
    tables += struct.pack(f"<{parts}I", *[size] * parts)
    bits = struct.pack(f"<{num_channels}H", *[16] * num_channels)
    head = b"II*\0" + struct.pack("<I", 8) + struct.pack("<H", len(entries)) + table + bytes(4)
    return head + bits + tables + bytes(size * num_channels)


def encoded(kind):
    buffer = io.BytesIO()
    rng = np.random.default_rng(0)
    Image.fromarray(rng.integers(0, 256, (12, 16, 3), np.uint8)).save(buffer, kind)
    return buffer.getvalue()


def test_a_small_file_of_many_pixels_is_refused_before_it_is_decoded(tmp_path):
    file = tmp_path / "bomb.png"
    file.write_bytes(png(12_000, 12_000, rows=40))
    tracemalloc.start()
    try:
        for read in (read_pixels, picture_facts):
            with pytest.warns(Image.DecompressionBombWarning), pytest.raises(ValueError, match="12000x12000") as caught:
                read(file)
        assert tracemalloc.get_traced_memory()[1] < 5e6
    finally:
        tracemalloc.stop()
    assert "bomb.png" in str(caught.value) and "images_2" in str(caught.value) and MAX_PIXELS == 128e6


@pytest.mark.parametrize(
    "data",
    [
        *(png(4, 3, depth=16, color_type=kind) for kind in CHANNELS),
        tiff(3), tiff(4), tiff(3, is_planar=True),
        b"P6 2 2 65535\n" + bytes(24), b"P6 2 2 1023\n" + bytes(24), b"P5 2 2 65535\n" + bytes(8),
    ],
    ids=["grey", "rgb", "grey-alpha", "rgba", "tiff", "tiff-alpha", "tiff-planes", "ppm", "ppm-10", "pgm"],
)  # fmt: skip
def test_deep_pictures_are_refused_and_never_cut(tmp_path, data):
    file = tmp_path / "deep"
    file.write_bytes(data)
    for read in (read_pixels, picture_facts):
        with pytest.raises(ValueError, match="deep: has more than 8 bits per channel"):
            read(file)


@pytest.mark.parametrize("kind", ["PNG", "TIFF", "BMP", "PPM", "GIF", "WEBP", "JPEG", "AVIF"])
def test_pictures_of_8_bits_are_read(tmp_path, kind):
    (tmp_path / "picture").write_bytes(encoded(kind))
    assert read_pixels(tmp_path / "picture").shape == (12, 16, 3)
    assert picture_facts(tmp_path / "picture").size == (16, 12)


def test_heic_is_read_with_its_library(tmp_path):
    library = pytest.importorskip("pillow_heif")
    colors = np.full((12, 16, 3), (200, 100, 50), np.uint8)
    library.from_pillow(Image.fromarray(colors)).save(tmp_path / "photo.heic", quality=90)
    assert np.abs(read_pixels(tmp_path / "photo.heic").astype(int) - colors).max() < 10
    assert picture_facts(tmp_path / "photo.heic").size == (16, 12)
    whole = (tmp_path / "photo.heic").read_bytes()
    rng = np.random.default_rng(1)
    for data in (*(whole[:size] for size in range(0, len(whole), 40)), *(flipped(whole, rng) for _ in range(60))):
        (tmp_path / "broken").write_bytes(data)
        try:
            assert read_pixels(tmp_path / "broken").ndim == 3
        except ValueError as error:
            assert "broken: " in str(error) and "\n" not in str(error) and "BufferedReader" not in str(error)


def test_heic_without_its_library_is_one_line_with_the_command(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pillow_heif", None)
    decoding._reads_heic.cache_clear()
    (tmp_path / "photo.heic").write_bytes(b"\0\0\0\x1cftypheic\0\0\0\0mif1heic")
    with pytest.raises(ValueError, match=r"photo\.heic: is a HEIC .* pip install 'a2tg-jax\[heic\]'$"):
        read_pixels(tmp_path / "photo.heic")
    decoding._reads_heic.cache_clear()


@pytest.mark.parametrize("kind", ["PNG", "TIFF", "BMP", "PPM", "GIF", "WEBP", "JPEG", "AVIF"])
def test_broken_pictures_are_one_clear_line(tmp_path, kind):
    """Pixels, or an error that names the file."""
    whole = encoded(kind)
    rng = np.random.default_rng(1)
    file = tmp_path / "broken"
    cuts = [whole[:size] for size in rng.integers(0, len(whole), 10)]
    for data in itertools.chain(cuts, (flipped(whole, rng) for _ in range(60))):
        file.write_bytes(data)
        try:
            pixels = read_pixels(file)
        except ValueError as error:
            assert "broken: " in str(error) and "\n" not in str(error) and "BufferedReader" not in str(error)
        else:
            assert pixels.dtype == np.uint8 and pixels.ndim == 3


@pytest.mark.parametrize(
    ("data", "reason"), [(b"", "it is empty: 0 bytes"), (b"<!DOCTYPE html>", "it is none of JPEG, PNG, .*, PPM")]
)
def test_pictures_that_are_none_are_named(tmp_path, data, reason):
    (tmp_path / "photo.jpg").write_bytes(data)
    for read in (read_pixels, picture_facts):
        with pytest.raises(ValueError, match=rf"photo\.jpg: cannot be read as an image \({reason}\); replace"):
            read(tmp_path / "photo.jpg")


def flipped(data, rng):
    changed = bytearray(data)
    for place in rng.integers(0, len(data), 4):
        changed[place] = rng.integers(256)
    return bytes(changed)


def test_formats_of_no_photographs_are_not_opened(tmp_path):
    """Pillow would hand PostScript to another program."""
    file = tmp_path / "photo.jpg"
    file.write_bytes(b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 10 10\n%%EndComments\n(x) run\n%%EOF\n")
    with pytest.raises(ValueError, match=r"photo\.jpg: cannot be read as an image"):
        read_pixels(file)


def test_results_never_share_a_file():
    names = ["a/b.png", "a_b.jpg", "a_b-2.png", "A_B.png", "c.png", "c.jpg", "d/e/f.png", ""]
    found = picture_names(names)
    assert set(found) == set(names)
    assert len({name.casefold() for name in found.values()}) == len(names)
    assert found["d/e/f.png"] == "d_e_f.png" and found["c.jpg"] == "c.png" and found["c.png"] == "c-2.png"
    assert found == picture_names(reversed(names))
    assert not any("/" in name for name in found.values())


def test_results_have_names_of_one_line(tmp_path):
    """A run's marker lists its files by lines: the second line of a name would be a file of the user's."""
    run = RunFolder(tmp_path)
    mine = tmp_path / "notes.png"
    mine.touch()
    for name in picture_names(["day/a\nnotes.png", "b\u2028c.png"]).values():
        save_picture(run.own(run.test / name), np.zeros((2, 2, 3), np.uint8))
    assert len(run.files()) == 2
    run.clear()
    assert mine.is_file() and not run.test.exists()


def test_results_of_photographs_with_long_names_are_files(tmp_path):
    """The names have 79 letters of 3 bytes, are in nested folders, or differ only at their end."""
    folders = "/".join(["f" * 80] * 3)
    names = ["\u5834" * 79 + ".png", f"{folders}/a.png", f"{folders}/A.png", f"{folders}/b.png", "x" * 190 + ".jpg"]
    found = picture_names(names)
    assert len({name.casefold() for name in found.values()}) == len(names)
    assert found[names[0]].startswith("\u5834" * 63 + "-") and found[names[-1]] == "x" * 190 + ".png"
    for name in found.values():
        save_picture(tmp_path / name, np.zeros((2, 2, 3), np.uint8))
    assert {path.name for path in tmp_path.iterdir()} == set(found.values())
