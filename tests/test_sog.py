"""SOG: version 1, folders and zipped folders, palettes of spherical harmonics, and damaged files."""

import io
import json
import shutil
import struct
import tracemalloc
import zipfile
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from fuzz_mutate import zipped
from hostile_files import put
from PIL import Image
from small_values import some_gaussians
from test_others import NUM, OTHERS, check, match, numbers, scene

from a2tg_jax import Gaussians, Model, load_splats, save_splats
from a2tg_jax.cli.main import main
from a2tg_jax.io import sog
from a2tg_jax.io.formats import files_of
from a2tg_jax.results.model_source import open_source

SCENE = OTHERS / "scene.sog"
PICTURES = (
    "means_l.webp", "means_u.webp", "quats.webp", "scales.webp", "sh0.webp", "shN_centroids.webp", "shN_labels.webp",
)  # fmt: skip


def entries() -> dict[str, bytes]:
    """The files in that of splat-transform."""
    with zipfile.ZipFile(SCENE) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def picture(pixels: np.ndarray, kind: str = "WEBP", **options: object) -> bytes:
    file = io.BytesIO()
    settings = {"lossless": True, "exact": True} if kind == "WEBP" else {}
    Image.fromarray(np.asarray(pixels, np.uint8)).save(file, kind, **settings | options)
    return file.getvalue()


def pixels_of(data: bytes) -> np.ndarray:
    return np.asarray(Image.open(io.BytesIO(data)).convert("RGBA"))


# Sound files


def unpacked(folder: Path) -> Path:
    folder.mkdir()
    for name, data in entries().items():
        (folder / name).write_bytes(data)
    return folder


def test_a_folder_its_header_and_a_zipped_folder_are_read(tmp_path, capsys):
    wanted = load_splats(SCENE)
    folder = unpacked(tmp_path / "scene")
    inside = {f"scene/{name}": data for name, data in entries().items()}
    of_macos = {f"__MACOSX/scene/._{name}": b"" for name in entries()}
    (tmp_path / "a.sog").write_bytes(zipped({"scene/": b"", **inside, **of_macos}))
    for path in (folder, folder / "meta.json", tmp_path / "a.sog"):
        found = load_splats(path)
        assert found == wanted
        assert open_source(path).title == ("a" if path.suffix == ".sog" else "scene")
        assert main(["convert", str(path), str(tmp_path / "b.npz"), "--overwrite"]) == 0
        assert ("zipped without it, are a *.sog" in capsys.readouterr().out) == (path.suffix != ".sog")
        assert load_splats(tmp_path / "b.npz").num == NUM
        assert main(["info", str(path)]) == 0 and "90 Gaussians" in capsys.readouterr().out
    assert main(["convert", str(tmp_path / "b.npz"), str(folder / "meta.json"), "--overwrite"]) == 2
    assert "unbundled SOG can be read, but not written; write *.sog" in capsys.readouterr().err
    (folder / "quats.webp").unlink()
    assert len(files_of(folder / "meta.json")) == len(entries())
    with pytest.raises(ValueError, match=r"meta\.json: the picture quats\.webp, which it names, is missing in"):
        load_splats(folder)
    (tmp_path / "a.sog").write_bytes(zipped({**inside, **{f"other/{name}": data for name, data in entries().items()}}))
    with pytest.raises(ValueError, match=r"a\.sog: holds several scenes \(scene/meta\.json, other/meta\.json\)"):
        load_splats(tmp_path / "a.sog")
    (folder / "meta.json").write_text("[]")
    assert files_of(folder / "meta.json") == [folder / "meta.json"]


def test_a_folder_zipped_with_backslashes_is_read(tmp_path):
    """As old programs on Windows zip it."""
    (tmp_path / "a.sog").write_bytes(zipped({f"scene\\{name}": data for name, data in entries().items()}))
    assert load_splats(tmp_path / "a.sog") == load_splats(SCENE)


def test_what_to_read_of_streamed_sog_and_of_a_zip(tmp_path):
    folder = tmp_path / "streamed"
    folder.mkdir()
    (folder / "lod-meta.json").write_text('{"lodLevels": 2}')
    with pytest.raises(ValueError, match=r"lod-meta\.json: is streamed SOG.*read one of them, such as 0_0"):
        load_splats(folder)
    (tmp_path / "a.zip").write_bytes(SCENE.read_bytes())
    with pytest.raises(ValueError, match=r"unknown suffix; if it is SOG, rename it to \*\.sog"):
        load_splats(tmp_path / "a.zip")


def test_pictures_of_a_folder_that_git_lfs_did_not_fetch(tmp_path):
    folder = unpacked(tmp_path / "scene")
    pointer = b"version https://git-lfs.github.com/spec/v1\noid sha256:" + b"0" * 64 + b"\nsize 123456\n"
    (folder / "quats.webp").write_bytes(pointer)
    with pytest.raises(ValueError, match=r"quats\.webp.*git lfs pull"):
        load_splats(folder)


@pytest.mark.parametrize("kind", ["device", "pipe", "sparse"])
def test_pictures_of_a_folder_that_are_no_files(tmp_path, kind):
    folder = unpacked(tmp_path / "scene")
    put(folder / "quats.webp", kind)
    with pytest.raises(ValueError, match=r"quats\.webp: (is not a regular file|has 100,000,000,000 bytes)"):
        load_splats(folder)


def test_version_1_has_ends_in_place_of_codebooks(tmp_path):
    """As PlayCanvas's first programs wrote it: no version, logits, and one pair of ends for spherical harmonics."""
    wanted = scene()
    data = entries()
    described = {}

    def coded(values: np.ndarray) -> tuple[np.ndarray, dict]:
        low, high = values.min(axis=0), values.max(axis=0)
        return np.rint(255 * (values - low) / (high - low)), {"mins": low.tolist(), "maxs": high.tolist()}

    def rows(values: np.ndarray) -> bytes:
        pixels = np.zeros((8 * 12, values.shape[1]))
        pixels[:NUM] = values
        return picture(pixels.reshape(8, 12, -1))

    quats = wanted["quats"] / np.linalg.norm(wanted["quats"], axis=1, keepdims=True)
    largest = np.abs(quats).argmax(axis=1)
    turns = np.zeros((NUM, 4))
    for row, quat in enumerate(quats):
        others = np.delete(quat * np.sign(quat[largest[row]]), largest[row])
        turns[row] = [*np.rint(255 * (others / np.sqrt(2) + 0.5)), 252 + largest[row]]
    logarithms = np.sign(wanted["means"]) * np.log1p(np.abs(wanted["means"]))
    ends = logarithms.min(axis=0), logarithms.max(axis=0)
    steps = np.rint(65535 * (logarithms - ends[0]) / (ends[1] - ends[0])).astype(int)
    scales, described["scales"] = coded(
        np.concatenate([wanted["log_scales"], np.full((NUM, 1), -9.0)], axis=1) + 1e-9 * np.arange(NUM)[:, None]
    )
    logits = np.log(wanted["opacities"] / (1 - wanted["opacities"]))
    colors = (wanted["colors"] - 0.5) * np.sqrt(4 * np.pi)
    sh0, described["sh0"] = coded(np.concatenate([colors, logits[:, None]], axis=1))
    low, high = wanted["rest"].min(), wanted["rest"].max()
    centroids = np.zeros((2 * 64, 15, 3))
    centroids[:NUM] = np.rint(255 * (wanted["rest"] - low) / (high - low))
    labels = np.stack([np.arange(NUM), 0 * largest, 0 * largest], axis=1)
    pictures = (rows(steps & 255), rows(steps >> 8), rows(turns), rows(scales), rows(sh0))
    data = dict(zip(PICTURES, (*pictures, picture(centroids.reshape(2, 960, 3)), rows(labels)), strict=True))
    header = {
        "means": {"shape": [NUM, 3], "mins": ends[0].tolist(), "maxs": ends[1].tolist(), "files": [*PICTURES[:2]]},
        "quats": {"shape": [NUM, 4], "encoding": "quaternion_packed", "files": ["quats.webp"]},
        "scales": described["scales"] | {"files": ["scales.webp"]}, "sh0": described["sh0"] | {"files": ["sh0.webp"]},
        "shN": {"mins": low, "maxs": high, "quantization": 8, "files": [*PICTURES[5:]]},
    }  # fmt: skip
    (tmp_path / "a.sog").write_bytes(zipped({**data, "meta.json": json.dumps(header).encode()}))
    found = numbers(load_splats(tmp_path / "a.sog").gaussians)
    check(found, wanted, 1e-3, 0.02, 3.0, (high - low) / 500)


def test_a_first_number_that_early_programs_left_out_is_one_step_before(tmp_path):
    data = entries()
    header = json.loads(data["meta.json"])
    book = header["sh0"]["codebook"] = np.linspace(-2, 2, 256).tolist()
    found = []
    for first in (None, book[1] + (book[1] - book[-1]) / 255):
        book[0] = first
        (tmp_path / "a.sog").write_bytes(zipped(data | {"meta.json": json.dumps(header).encode()}))
        found.append(load_splats(tmp_path / "a.sog"))
    assert found[0] == found[1]


def test_many_splats_share_sets_of_spherical_harmonics(tmp_path, monkeypatch):
    """600 splats of 40 kinds: 64 sets are enough for all kinds."""
    monkeypatch.setattr(sog, "MOST_ENTRIES", 64)
    monkeypatch.setattr(sog, "LARGEST_GROUP", 200)
    rng = np.random.default_rng(0)
    kinds = rng.normal(0, 0.3, (40, 15, 3))
    noise = 0.01
    rest = kinds[np.arange(600) % 40] + rng.normal(0, noise, (600, 15, 3))
    own = some_gaussians(600)
    sh = jnp.asarray(np.concatenate([np.asarray(own.sh)[:, :1], rest], axis=1), jnp.float32)
    gaussians = Gaussians(own.means, own.quats, own.log_scales, own.logit_opacities, sh)
    save_splats(tmp_path / "a.sog", Model(gaussians))
    with zipfile.ZipFile(tmp_path / "a.sog") as archive:
        described = json.loads(archive.read("meta.json"))["shN"]
        assert described["count"] == 64 and archive.testzip() is None
    found = load_splats(tmp_path / "a.sog").gaussians
    order = match(np.asarray(found.means), np.asarray(own.means))
    error = np.sqrt(np.mean((np.asarray(found.sh)[:, 1:] - rest[order]) ** 2))
    assert error < 0.08
    save_splats(tmp_path / "b.sog", Model(gaussians))
    assert (tmp_path / "a.sog").read_bytes() == (tmp_path / "b.sog").read_bytes()


def test_outliers_of_scales_and_colours_are_kept(tmp_path):
    """One splat far from all others takes one place of a codebook, and leaves the others fine steps."""
    own = some_gaussians(400)
    log_scales = own.log_scales.at[7].set(3.0)
    sh = own.sh[:, :1].at[9, 0, 1].set(40.0)
    gaussians = Gaussians(own.means, own.quats, log_scales, own.logit_opacities, sh)
    save_splats(tmp_path / "a.sog", Model(gaussians))
    found = load_splats(tmp_path / "a.sog").gaussians
    order = match(np.asarray(found.means), np.asarray(own.means))
    np.testing.assert_allclose(found.log_scales, np.asarray(log_scales)[order], atol=0.05)
    errors = np.abs(np.asarray(found.sh) - np.asarray(sh)[order])
    assert errors.max() < 0.1 and np.quantile(errors, 0.99) < 0.08


# Damaged files


def header_with(change) -> bytes:
    """A header after a change of it in place."""
    header = json.loads(entries()["meta.json"])
    change(header)
    return zipped(entries() | {"meta.json": json.dumps(header).encode()})


def with_picture(name: str, data: bytes) -> bytes:
    return zipped(entries() | {name: data})


def without(name: str) -> bytes:
    return zipped({key: data for key, data in entries().items() if key != name})


def bomb(kind: str) -> bytes:
    """16,383 × 16,383 pixels of one colour, in a few bytes: the size in a sound header of 1 × 1 pixel."""
    data = bytearray(picture(np.zeros((1, 1, 4)), kind))
    if kind == "PNG":
        struct.pack_into(">II", data, 16, 16383, 16383)
    else:
        # 14 bits each of width − 1 and height − 1, after the chunk's head and a byte.
        struct.pack_into("<I", data, 21, 16382 | 16382 << 14 | 1 << 28)
    return bytes(data)


def lying_labels() -> bytes:
    pixels = pixels_of(entries()["shN_labels.webp"]).copy()
    pixels[0, 0, :2] = 255
    return picture(pixels)


def turned_labels() -> bytes:
    pixels = pixels_of(entries()["quats.webp"]).copy()
    pixels[0, 0, 3] = 10
    return picture(pixels)


def claiming(**sizes: int) -> bytes:
    """A ZIP whose table claims other sizes or methods of the first file."""
    data = bytearray(zipped(entries()))
    place = data.index(b"PK\1\2")
    for name, value in sizes.items():
        offset, kind = {"size": (24, "I"), "flags": (8, "H"), "method": (10, "H")}[name]
        struct.pack_into(f"<{kind}", data, place + offset, value)
    return bytes(data)


def of_pictures() -> dict[str, tuple[bytes, str]]:
    found = {}
    for name in PICTURES:
        data = entries()[name]
        pixels = pixels_of(entries()[name])
        kind = name.removesuffix(".webp")
        found |= {
            f"no {kind}": (without(name), f"lacks the picture {name}"),
            f"{kind} empty": (with_picture(name, b""), f"the picture {name} is damaged"),
            f"{kind} of 39 bytes": (with_picture(name, data[:39]), f"the picture {name} is damaged"),
            f"{kind} cut": (with_picture(name, data[: len(data) // 2]), f"the picture {name} is damaged"),
            f"{kind} garbage": (with_picture(name, b"RIFF" + bytes(500)), f"the picture {name} is damaged"),
            f"{kind} small": (with_picture(name, picture(pixels[:1, :1])), name),
            f"{kind} wide": (with_picture(name, picture(np.tile(pixels, (1, 2, 1)))), name),
            f"{kind} grey": (with_picture(name, picture(pixels[..., 0], "PNG")), rf"{name} .*its pixels are L"),
            f"{kind} JPEG": (with_picture(name, picture(pixels[..., :3], "JPEG")), f"{name} .*neither WebP nor PNG"),
            f"{kind} lossy": (with_picture(name, picture(pixels, lossless=False)), f"{name} .*compressed with loss"),
            f"{kind} bomb": (with_picture(name, bomb("WEBP")), f"{name} (is damaged|has 16383x16383 pixels, more)"),
            f"{kind} PNG bomb": (with_picture(name, bomb("PNG")), f"{name} (is damaged|has 16383x16383 pixels, more)"),
        }
    return found


def of_headers() -> dict[str, tuple[bytes, str]]:
    counts = (0, -1, 1.5, "90", 97, 5000, 10**30, True, None, [90])
    count_of = lambda value: header_with(lambda h: h.update(count=value))  # noqa: E731
    found = {
        f"count {value!r}": (count_of(value), "number of splats in meta.json must be an int|too few for|is too large")
        for value in counts
    }
    changes = {
        "no count": (lambda h: h.pop("count"), "lacks 'count'"),
        "version 3": (lambda h: h.update(version=3), "is SOG of version 3"),
        "version text": (lambda h: h.update(version="2"), "is SOG of version '2'; versions 1 and 2"),
        "version 1 with codebooks": (lambda h: h.update(version=1), "lacks 'shape'"),
        "no means": (lambda h: h.pop("means"), "describes no means"),
        "no scales": (lambda h: h.pop("scales"), "describes no scales"),
        "list of quats": (lambda h: h.update(quats=[]), "describes no quats"),
        "text of shN": (lambda h: h.update(shN="x"), "describes no shN"),
        "two mins": (lambda h: h["means"]["mins"].pop(), "means.mins of meta.json must be 3 finite numbers"),
        "no maxs": (lambda h: h["means"].pop("maxs"), "means.maxs of meta.json must be 3 finite numbers"),
        "text in mins": (lambda h: h["means"].update(mins=["0", 0, 0]), "means.mins of meta.json must be 3 finite"),
        "NaN in mins": (lambda h: h["means"].update(mins=[float("nan"), 0, 0]), "meta.json cannot be read as JSON"),
        "large maxs": (lambda h: h["means"].update(maxs=[1e300, 0, 0]), "means.maxs of meta.json must be 3 finite"),
        "infinite positions": (
            lambda h: h["means"].update(mins=[1e5] * 3, maxs=[2e5] * 3),
            "gaussians.means must be finite",
        ),
        "short codebook": (lambda h: h["scales"].update(codebook=[0.0] * 9), "scales.codebook of meta.json has 9"),
        "codebook of nulls": (
            lambda h: h["sh0"].update(codebook=[None] * 256),
            "sh0.codebook of meta.json must be a list of fin",
        ),
        "no codebook": (lambda h: h["sh0"].pop("codebook"), "sh0.codebook of meta.json must be a list"),
        "empty codebook": (lambda h: h["sh0"].update(codebook=[]), "sh0.codebook of meta.json must be a list"),
        "text codebook": (lambda h: h["sh0"].update(codebook="x" * 256), "sh0.codebook of meta.json must be a list"),
        "infinite codebook": (
            lambda h: h["shN"].update(codebook=[1e39] * 256),
            "shN.codebook of meta.json must be a list of fin",
        ),
        "no files": (lambda h: h["quats"].pop("files"), "must name 1 pictures of quats; got None"),
        "one file of means": (lambda h: h["means"]["files"].pop(), "must name 2 pictures of means"),
        "file above": (lambda h: h["sh0"].update(files=["../x.webp"]), "names the picture ../x.webp"),
        "file elsewhere": (lambda h: h["sh0"].update(files=["/etc/passwd"]), "names the picture /etc/passwd"),
        "file of Windows": (lambda h: h["sh0"].update(files=["..\\x.webp"]), "names the picture"),
        "long file": (lambda h: h["sh0"].update(files=["x" * 999]), "names the picture x+…; a short name"),
        "number as a file": (lambda h: h["sh0"].update(files=[7]), "must name 1 pictures of sh0"),
        "4 bands": (lambda h: h["shN"].update(bands=4), "shN_centroids.webp is 960 pixels wide"),
        "2 bands": (lambda h: h["shN"].update(bands=2), "shN_centroids.webp is 960 pixels wide"),
        "no bands": (lambda h: h["shN"].pop("bands"), "lacks 'bands'"),
        "many sets": (lambda h: h["shN"].update(count=10**9), "shN_centroids.webp holds 64 sets"),
        "few sets": (lambda h: h["shN"].update(count=3), r"shN_labels.webp refers to set \d+"),
        "offset": (lambda h: h.update(offset=[1, 2]), "offset of meta.json must be 3 finite numbers"),
        "large offset": (lambda h: h.update(offset=[1e30, 0, 0]), "origin.transform"),
        "rotation": (lambda h: h.update(rotation="none"), "rotation of meta.json must be 4 finite numbers"),
    }
    return found | {name: (header_with(change), reason) for name, (change, reason) in changes.items()}


def of_archives() -> dict[str, tuple[bytes, str]]:
    data = zipped(entries())
    half = len(data) // 2
    return {
        "nothing": (b"", "is damaged or no SOG file"),
        "text": (b"nothing of the kind", "is damaged or no SOG file"),
        "cut ZIP": (data[:half], "is damaged or no SOG file"),
        "flipped byte": (data[:half] + bytes([data[half] ^ 255]) + data[half + 1 :], "is damaged"),
        "other ZIP": (zipped({"other.txt": b""}), r"is not SOG: it has no meta\.json"),
        "empty header": (zipped(entries() | {"meta.json": b""}), "meta.json cannot be read as JSON"),
        "streamed": (zipped({"lod-meta.json": b"", "meta.json": b'{"lodLevels": 2}'}), "is streamed SOG"),
        "streamed only": (zipped({"scene/lod-meta.json": b'{"lodLevels": 2}'}), "is streamed SOG"),
        "list as header": (zipped(entries() | {"meta.json": b"[]"}), "is not SOG: meta.json describes no means"),
        "deep header": (zipped(entries() | {"meta.json": b"[" * 10**5}), "meta.json cannot be read as JSON"),
        "labels beyond the sets": (with_picture("shN_labels.webp", lying_labels()), "refers to set 65,535 .* of 64"),
        "rotation without index": (with_picture("quats.webp", turned_labels()), "quats.webp is damaged: alpha"),
        "gigabytes": (claiming(size=2**32 - 2), "unpacks to more than 64 times its size"),
        "encrypted": (claiming(flags=1), "is damaged or no SOG file"),
        "unknown method": (claiming(method=99), "is damaged or no SOG file"),
        "ZIP bomb": (
            zipped(entries() | {"bomb": bytes(1 << 24)}, zipfile.ZIP_DEFLATED), "unpacks to more than 64 times"
        ),
    }  # fmt: skip


DAMAGED = of_pictures() | of_headers() | of_archives()


@pytest.mark.parametrize("kind", DAMAGED)
def test_damaged_files_are_refused_with_what_is_wrong(tmp_path, kind):
    data, reason = DAMAGED[kind]
    (tmp_path / "a.sog").write_bytes(data)
    tracemalloc.start()
    try:
        with pytest.raises(ValueError, match=rf"a\.sog: .*({reason})") as caught:
            load_splats(tmp_path / "a.sog")
        assert tracemalloc.get_traced_memory()[1] < 3e7
    finally:
        tracemalloc.stop()
    assert "\n" not in str(caught.value) and len(str(caught.value)) < 400


def test_pictures_of_another_program_may_be_png(tmp_path):
    data = {name: picture(pixels_of(data), "PNG") if name.endswith("p") else data for name, data in entries().items()}
    (tmp_path / "a.sog").write_bytes(zipped(data))
    assert load_splats(tmp_path / "a.sog") == load_splats(SCENE)


def test_bands_of_degree_0_need_no_sets(tmp_path):
    (tmp_path / "a.sog").write_bytes(header_with(lambda header: header["shN"].update(bands=0)))
    assert load_splats(tmp_path / "a.sog").gaussians.sh_degree == 0
    shutil.rmtree(tmp_path)
