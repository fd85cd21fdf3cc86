"""Plain photographs to a scene: on renders of the built-in scene, whose cameras are known."""

import contextlib
import os
import re
import shutil
import sys
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import ExifTags, Image
from scipy.ndimage import gaussian_filter
from test_data_colmap import dot_place, write_scene as write_colmap

from a2tg_jax import load_scene, look_at, run_sfm
from a2tg_jax.cli import main as cli, make
from a2tg_jax.cli.inputs import Sfm
from a2tg_jax.core.origin import vertical_of
from a2tg_jax.data import sfm, synthetic
from a2tg_jax.data.colmap_library import pycolmap
from a2tg_jax.data.decoding import picture_facts, picture_size, read_pixels
from a2tg_jax.data.photo_folder import find_photos
from a2tg_jax.data.staging import stage
from a2tg_jax.host import progress_bars
from a2tg_jax.results.figures import save_camera_picture
from a2tg_jax.results.images import save_animation, write_png


def save_photos(folder, num_photos, width, height):
    """Neighbouring views of a long path, called view_000.png, …; returns the camera centres."""
    rng = np.random.default_rng(0)
    surfaces = synthetic.light(synthetic.still_life(rng), rng)
    centers = synthetic.camera_path(40)[:num_photos]
    folder.mkdir()
    for index, center in enumerate(centers):
        camera = look_at(center, (0, 0.1, 0.45), width=width, height=height, fov=58)
        viewmat, K = (np.asarray(matrix, np.float64) for matrix in (camera.viewmat, camera.K))
        pixels = synthetic.render(surfaces, viewmat, K, width, height)
        Image.fromarray(pixels).save(folder / f"view_{index:03d}.png")
    return centers


STORED = {
    2: Image.Transpose.FLIP_LEFT_RIGHT, 3: Image.Transpose.ROTATE_180, 4: Image.Transpose.FLIP_TOP_BOTTOM,
    5: Image.Transpose.TRANSPOSE, 6: Image.Transpose.ROTATE_90, 7: Image.Transpose.TRANSVERSE,
    8: Image.Transpose.ROTATE_270,
}  # fmt: skip
"""How a picture is stored that EXIF says to turn back, by EXIF's number of the orientation."""


def save_turned(image, path, orientation):
    """Stores a picture turned, as a phone does that is held so."""
    exif = Image.Exif()
    exif[ExifTags.Base.Orientation] = orientation
    exif[ExifTags.Base.Make] = "Phone"
    exif.get_ifd(ExifTags.IFD.Exif)[ExifTags.Base.FocalLengthIn35mmFilm] = 32
    image.transpose(STORED[orientation]).save(path, exif=exif, quality=95)
    return path


def test_photographs_of_two_folders_become_a_scene(tmp_path):
    """One folder of plain photographs, and one of a phone that was turned."""
    expected = save_photos(tmp_path / "a", 5, 256, 192)
    (tmp_path / "b").mkdir()
    for index, orientation in ((3, 6), (4, 8)):
        file = tmp_path / "a" / f"view_{index:03d}.png"
        save_turned(Image.open(file), tmp_path / "b" / f"{file.stem}.jpg", orientation)
        file.unlink()
    printed = []
    summary = run_sfm([tmp_path / "a", tmp_path / "b"], tmp_path / "scene", progress=False, on_note=printed.append)
    assert (summary.num_photos, summary.num_registered, printed) == (5, 5, ["2 photographs turned as EXIF says"])
    assert 0 < summary.mean_error < 1
    assert sorted(file.name for file in (tmp_path / "scene").iterdir()) == ["images", "sparse"]
    scene = load_scene(tmp_path / "scene", test_every=0)
    assert [view.name for view in scene.train][2:] == ["a/view_002.png", "b/view_003.jpg", "b/view_004.jpg"]
    assert all(view.camera.width > view.camera.height for view in scene.train)
    assert len(scene.points) == summary.num_points > 100
    centers = np.stack([np.asarray(view.camera.center) for view in scene.train])
    steps, expected_steps = (np.linalg.norm(np.diff(c, axis=0), axis=1) for c in (centers, expected))
    np.testing.assert_allclose(steps / steps.sum(), expected_steps / expected_steps.sum(), atol=0.05)
    up = np.stack([-np.asarray(view.camera.viewmat)[1, :3] for view in scene.train])
    assert (up @ up.T > 0.9).all(), "no photograph lies on its side"
    back = scene.transform.inverse()
    original = [back.apply_to_viewmat(np.asarray(view.camera.viewmat, np.float64)) for view in scene.train]
    np.testing.assert_allclose(vertical_of(np.stack(original)), [0, -1, 0], atol=1e-6)
    with pytest.raises(FileExistsError, match="exists already"):
        run_sfm(tmp_path / "a", tmp_path / "scene", progress=False)


def staged(sources, work, panorama="auto", tell=lambda line: None, masks=None):
    return stage(sources, work, masks=masks, frames=10, panorama=panorama, progress=False, tell=tell)


def cameras_of(found, work):
    """Lists the staged photographs in a database as `run_sfm` does; returns its cameras, and frames of rigs."""
    colmap = pycolmap()
    database = work / "database.db"
    sfm.list_photos(database, found, "SIMPLE_RADIAL")
    with contextlib.closing(colmap.Database.open(database)) as opened:
        return opened.read_all_cameras(), opened.read_all_frames()


def test_cameras_are_distinguished_and_exif_gives_their_focal_length(tmp_path):
    """Photographs of one folder, size and lens share a camera. One that is turned keeps its EXIF data."""
    random = np.random.default_rng(0)
    sizes = {"a/1.png": (64, 48), "a/2.png": (64, 48), "a/3.png": (32, 24), "b/1.png": (64, 48)}
    for name, size in sizes.items():
        save_blocks(tmp_path / name, *size, random)
    image = Image.fromarray(random.integers(0, 255, (48, 64, 3), np.uint8))
    save_turned(image, tmp_path / "b" / "2.jpg", 6)
    found = staged([tmp_path / "a", tmp_path / "b"], tmp_path / "work")
    assert {group.names: group.size for group in found.groups} == {
        ("a/1.png", "a/2.png"): (64, 48),
        ("a/3.png",): (32, 24),
        ("b/1.png",): (64, 48),
        ("b/2.jpg",): (64, 48),
    }
    cameras, _ = cameras_of(found, tmp_path)
    assert [camera.has_prior_focal_length for camera in cameras] == [False, False, False, True]
    assert (cameras[3].width, cameras[3].height) == (64, 48)
    assert cameras[3].focal_length == pytest.approx(32 / np.hypot(36, 24) * np.hypot(64, 48), rel=0.02)


GREY = np.kron([[0, 255, 60], [90, 160, 200]], np.ones((32, 32))).astype(np.uint8)


def seen_by_colmap(file):
    """Grey levels of a file as COLMAP reads it."""
    return pycolmap().Bitmap.read(file, False).to_array().squeeze()


@pytest.mark.parametrize("orientation", STORED)
def test_turned_photographs_are_turned_back(tmp_path, orientation):
    for suffix in ("jpg", "png", "tif", "webp", "avif"):
        save_turned(Image.fromarray(GREY), tmp_path / f"{suffix}.{suffix}", orientation)
    printed = []
    found = staged([tmp_path], tmp_path / "work", tell=printed.append)
    assert printed == ["5 photographs turned as EXIF says"]
    names = ["avif.avif.jpg", "jpg.jpg", "png.png", "tif.tif.png", "webp.webp.jpg"]
    assert found.names == names
    assert {group.size for group in found.groups} == {(96, 64)}
    assert {(camera.width, camera.height) for camera in cameras_of(found, tmp_path)[0]} == {(96, 64)}
    for name in names:
        upright = tmp_path / "work" / "photos" / name
        with Image.open(upright) as image:
            assert image.getexif()[ExifTags.Base.Orientation] == 1
        assert np.abs(seen_by_colmap(upright).astype(int) - GREY).mean() < 3, name


@pytest.mark.parametrize("orientation", STORED)
def test_turned_tiff_is_read_as_stored(tmp_path, orientation):
    """As COLMAP reads it, whose cameras it has; Pillow turns TIFF by itself."""
    file = save_turned(Image.fromarray(GREY), tmp_path / "0.tif", orientation)
    stored = seen_by_colmap(file)
    np.testing.assert_array_equal(read_pixels(file)[..., 0], stored)
    assert picture_size(file) == stored.shape[::-1]
    assert picture_facts(file)[:2] == ((96, 64), True)


COLOUR = np.kron(np.random.default_rng(0).integers(0, 255, (4, 6, 3)), np.ones((16, 16, 1))).astype(np.uint8)


@pytest.mark.parametrize(
    "name, mode, options",
    [
        ("0.jpg", "RGB", {"progressive": True}),
        ("0.jpg", "CMYK", {}),
        ("0.jpg", "L", {}),
        ("0.mpo.jpg", "RGB", {"format": "MPO", "save_all": True, "append_images": [Image.new("RGB", (96, 64))]}),
        ("0.png", "RGBA", {}),
        ("0.png", "LA", {}),
        ("0.png", "P", {}),
        ("0.png", "1", {}),
        ("0.bmp", "P", {}),
        ("0.tif", "RGB", {}),
        ("0.tif", "CMYK", {"compression": "tiff_lzw"}),
        ("0.tif", "RGB", {"compression": "zstd"}),
        ("0.webp", "RGB", {}),
        ("0.webp", "RGBA", {"lossless": True}),
        ("0.avif", "RGB", {}),
        ("gif.png", "P", {"format": "GIF"}),
        ("jpeg.webp", "RGB", {"format": "JPEG"}),
        ("png.heic", "RGB", {"format": "PNG"}),
    ],
)
def test_colmap_reads_and_writes_every_photograph(tmp_path, name, mode, options):
    """The formats and their variants, and files of another format than their suffix says."""
    (tmp_path / "photos").mkdir()
    for index, prefix in enumerate(("", "x-", "y-")):
        shifted = Image.fromarray(np.roll(COLOUR, 9 * index, axis=1))
        shifted.convert(mode).save(tmp_path / "photos" / f"{prefix}{name}", **options)
    expected = read_pixels(tmp_path / "photos" / name)
    (group,) = staged([tmp_path / "photos"], tmp_path / "work").groups
    assert len(group.names) == 3 and group.size == (96, 64)
    bitmap = pycolmap().Bitmap.read(tmp_path / "work" / "photos" / group.names[0], True)
    assert np.abs(bitmap.to_array().astype(int) - expected).mean() < 4
    assert bitmap.write(tmp_path / group.names[0])


def test_transparent_photographs_are_staged_as_png(tmp_path):
    """With straight colours and alpha, upright."""
    pixels = np.dstack([COLOUR, np.where(np.arange(96) < 40, 0, 255) * np.ones((64, 1))]).astype(np.uint8)
    photos = tmp_path / "photos"
    image = Image.fromarray(pixels)
    photos.mkdir()
    for name in ("0.png", "1.tif"):
        image.save(photos / name)
    # Other bytes than 0.png, but the same pixels.
    image.save(photos / "3.PNG", compress_level=0)
    image.save(photos / "2.webp", lossless=True, exact=True)
    save_turned(image, photos / "4.png", 6)
    image.convert("LA").save(photos / "5.png")
    image.convert("P").save(photos / "6.png")
    Image.fromarray(COLOUR).save(photos / "7.bmp")
    found = staged([photos], tmp_path / "work")
    assert found.names == ["0.png", "1.tif.png", "2.webp.png", "3.PNG", "4.png", "5.png", "6.png", "7.bmp"]
    for name in found.names[:-1]:
        kept = read_pixels(tmp_path / "work" / "photos" / name)
        np.testing.assert_array_equal(kept[..., 3], pixels[..., 3])
        if name[0] in "01234":
            np.testing.assert_array_equal(kept, pixels)


def test_alpha_and_masks_are_undistorted_with_the_photographs(tmp_path):
    """An alpha channel and a mask of the dot alone are where COLMAP's undistorted photograph shows the dot."""
    names = ["a/0.png", "a/1.PNG", "b/2.jpg", "b/3.png"]
    model = write_colmap(tmp_path / "scene", models=("SIMPLE_RADIAL", "OPENCV"), num_views=4, names=names)
    photos = tmp_path / "scene" / "images"
    out = tmp_path / "out"
    for name in names:
        photograph = read_pixels(photos / name)
        is_dot = photograph[..., 0] > 20
        if name.lower().endswith(".png"):
            Image.fromarray(np.dstack([photograph, 255 * is_dot.astype(np.uint8)])).save(photos / name)
        if name != "b/3.png":
            (tmp_path / "scene" / "masks" / name).parent.mkdir(parents=True, exist_ok=True)
            Image.fromarray(is_dot).convert("L").save(tmp_path / "scene" / "masks" / f"{name}.png")
    pycolmap().undistort_images(out, tmp_path / "scene" / "sparse" / "0", photos)
    expected = {name: dot_place(read_pixels(out / "images" / name)) for name in names}
    sfm._undistort_alpha_and_masks(model, photos, out)
    with pytest.warns(UserWarning, match="1 of 4 photographs have no mask, such as b/3.png"):
        scene = load_scene(out, test_every=0)
    for view in scene.train:
        assert view.has_alpha == (view.name != "b/2.jpg") and (view.mask is None) == (view.name == "b/3.png")
        for plane in ([view.alpha] if view.has_alpha else []) + ([view.mask.read()] if view.mask else []):
            assert plane.sum() > 0 and (plane > 0).mean() < 0.05
            np.testing.assert_allclose(dot_place(np.asarray(plane, float)[..., None]), expected[view.name], atol=0.7)


def test_masks_come_with_the_photographs(tmp_path):
    """From photographs with an alpha channel, one of them turned, and masks of all but one, to a scene."""
    save_photos(tmp_path / "photos", 4, 256, 192)
    (tmp_path / "cut").mkdir()
    corner = (np.indices((192, 256)) < 40).all(0)
    for index in range(4):
        file = tmp_path / "photos" / f"view_{index:03d}.png"
        if index < 3:
            Image.fromarray(~corner[:, ::-1]).convert("L").save(tmp_path / "cut" / f"{file.stem}.png")
        with Image.open(file) as image:
            image.putalpha(Image.fromarray(~corner).convert("L"))
            if index == 2:
                file.unlink()
                save_turned(image, file, 6)
            elif index == 0:
                file.unlink()
                image.convert("RGB").save(file.with_suffix(".jpg"), quality=95)
            else:
                image.save(file)
    with pytest.warns(UserWarning, match=r"cut: 1 of 4 photographs have no mask, such as view_003.png"):
        run_sfm(tmp_path / "photos", tmp_path / "scene", masks=tmp_path / "cut", progress=False)
    assert sorted(file.name for file in (tmp_path / "scene").iterdir()) == ["images", "masks", "sparse"]
    with pytest.warns(UserWarning, match="1 of 4 photographs have no mask, such as view_003.png"):
        scene = load_scene(tmp_path / "scene", test_every=0)
    for view in scene.train:
        alpha = view.alpha if view.has_alpha else np.zeros((1, 1))
        assert view.has_alpha == (view.name != "view_000.jpg") and not alpha[:36, :36].any()
        if view.has_alpha:
            assert (alpha == 0).mean() == pytest.approx(corner.mean(), rel=0.1)
        if view.name != "view_003.png":
            assert not view.mask.read()[:36, -36:].any()
            assert (~view.mask.read()).mean() == pytest.approx(corner.mean(), rel=0.1)


def test_masked_pixels_have_no_features(tmp_path):
    noise = np.random.default_rng(0).integers(0, 255, (24, 32, 3), np.uint8)
    for folder in ("photos", "cut"):
        (tmp_path / folder).mkdir()
    for name in ("0", "1", "2"):
        picture = Image.fromarray(noise).resize((256, 192), Image.Resampling.BICUBIC)
        picture.save(tmp_path / "photos" / f"{name}.png", compress_level=int(name))
    Image.fromarray(np.arange(256) >= 128 * np.ones((192, 1))).convert("L").save(tmp_path / "cut" / "0.png")
    with pytest.warns(UserWarning, match="2 of 3 photographs have no mask"):
        found = staged([tmp_path / "photos"], tmp_path / "work", masks=tmp_path / "cut")
    cameras_of(found, tmp_path)
    sfm._extract_features(tmp_path / "database.db", found.folder, found.names, False)
    with contextlib.closing(pycolmap().Database.open(tmp_path / "database.db")) as opened:
        masked, whole, _ = (opened.read_keypoints(image.image_id)[:, 0] for image in opened.read_all_images())
    assert masked.min() >= 128 > whole.min() and len(whole) > len(masked) > 20


def test_what_is_wrong_with_masks_of_photographs(tmp_path):
    random = np.random.default_rng(0)
    for index in range(3):
        save_blocks(tmp_path / "photos" / f"{index}.jpg", 64, 48, random)
    (tmp_path / "cut").mkdir()
    for masks, error, words in (
        ("none", FileNotFoundError, "none: no such folder of masks"),
        ("cut", ValueError, "holds no mask of a photograph, called 0.jpg.png for 0.jpg"),
    ):
        with pytest.raises(error, match=words):
            run_sfm(tmp_path / "photos", tmp_path / "scene", masks=tmp_path / masks, progress=False)
    for index in range(3):
        Image.new("L", (48, 64)).save(tmp_path / "cut" / f"{index}.png")
    with pytest.raises(
        ValueError, match=r"png: is 48x64, but its photograph is 64x48; a mask must be of the same size"
    ):
        run_sfm(tmp_path / "photos", tmp_path / "scene", masks=tmp_path / "cut", progress=False)


@pytest.mark.parametrize("panorama", ["yes", "no"])
def test_grey_masks_of_photographs_are_named(tmp_path, panorama):
    """And masks of 16 and 235, as frames of videos have, are staged black and white."""
    for index in range(3):
        save_blocks(tmp_path / "photos" / f"{index}.jpg", 64, 32, np.random.default_rng(index))
        (tmp_path / "cut").mkdir(exist_ok=True)
        levels = np.where(np.arange(64) < 32, 235, 100 if index == 1 else 16) * np.ones((32, 1))
        Image.fromarray(levels.astype(np.uint8)).save(tmp_path / "cut" / f"{index}.png")
    with pytest.warns(UserWarning, match=r"cut: 1 of 3 masks have areas .* neither black nor white, such as 1\.png"):
        found = staged([tmp_path / "photos"], tmp_path / "work", panorama, masks=tmp_path / "cut")
    staged_masks = [read_pixels(tmp_path / "work" / "masks" / f"{name}.png")[..., 0] for name in found.names]
    assert {level for mask in staged_masks for level in np.unique(mask)} == {0, 255}
    if panorama == "no":
        np.testing.assert_array_equal(staged_masks[0], np.where(np.arange(64) < 32, 255, 0) * np.ones((32, 1)))
        assert (staged_masks[1] == 255).all()


def test_masks_of_panoramas_are_cut(tmp_path):
    """So are alpha channels. Masks exclude what is above the horizon, and a quarter left of the middle is clear."""
    pixels = np.full((64, 128, 4), 200, np.uint8)
    pixels[..., 3] = 255
    pixels[:, 32:64, 3] = 0
    (tmp_path / "cut").mkdir()
    (tmp_path / "photos").mkdir()
    for index in range(3):
        Image.fromarray(pixels).save(tmp_path / "photos" / f"{index}.png", compress_level=index)
        Image.fromarray(np.arange(64)[:, None] * np.ones(128) >= 32).convert("L").save(
            tmp_path / "cut" / f"{index}.png"
        )
    found = staged([tmp_path / "photos"], tmp_path / "work", panorama="yes", masks=tmp_path / "cut")
    (rig,) = found.rigs
    for name, mask, alpha in (("up", 0, None), ("down", 255, None), ("heading300", None, 0)):
        file = f"{rig.folder}/{name}/0.png"
        side = rig.groups[0].size[0]
        pixels = read_pixels(found.folder / file)
        counts = read_pixels(tmp_path / "work" / "masks" / f"{file}.png")
        assert pixels.shape == (side, side, 4) and counts.shape == (side, side, 3)
        assert mask is None or (counts == mask).all()
        assert alpha is None or (pixels[side // 2, side // 2 + 2, 3] == alpha)


def test_photographs_stay_as_they_are_whatever_they_are_named(tmp_path):
    """A photograph that is written again, here one in another format, may get the name of another."""
    names = ["a.bmp", "a.bmp.jpg", "A.BMP.JPG", "a.bmp~2.jpg"]
    photos = tmp_path / "photos"
    photos.mkdir()
    for index, name in enumerate(names):
        image = Image.fromarray(np.full((12, 16, 3), 60 * index, np.uint8))
        image.save(photos / name, format="JPEG" if index else "PPM")
    before = {file.name: file.read_bytes() for file in photos.iterdir()}
    (group,) = staged([photos], tmp_path / "work").groups
    assert {file.name: file.read_bytes() for file in photos.iterdir()} == before
    folder = tmp_path / "work" / "photos"
    assert sorted(file.name for file in folder.iterdir()) == list(group.names)
    assert len({name.casefold() for name in group.names}) == 4
    assert sorted(round(np.asarray(Image.open(folder / name)).mean() / 60) for name in group.names) == [0, 1, 2, 3]


@pytest.mark.long
@pytest.mark.parametrize("is_terminal", [False, True])
def test_every_phase_moves_and_colmap_is_silent(tmp_path, capfd, monkeypatch, is_terminal):
    """Phases are bars on a terminal and plain lines in a pipe."""
    monkeypatch.setattr(progress_bars, "has_terminal", lambda: is_terminal)
    save_photos(tmp_path / "photos", 4, 128, 96)
    with contextlib.suppress(ValueError):  # The phases count, not what they find.
        run_sfm(tmp_path / "photos", tmp_path / "scene")
    printed = capfd.readouterr().err
    assert is_terminal == ("\r" in printed)
    lines = printed.replace("\r", "\n").splitlines()
    assert all(re.match(r"(features|matching|mapping|undistorting)\b|$", line) for line in lines)
    for phase, num in (("features", 4), ("matching", 6)):
        wanted = f"{num}/{num}" if is_terminal else f"{num} of {num}"
        assert any(wanted in line for line in lines if line.startswith(phase))


def test_too_little_in_common(tmp_path, capfd):
    """Noise has features, but none that match."""
    (tmp_path / "photos").mkdir()
    for index in range(3):
        noise = np.random.default_rng(index).integers(0, 255, (64, 64, 3), np.uint8)
        Image.fromarray(noise).save(tmp_path / "photos" / f"{index}.png")
    with pytest.raises(
        ValueError, match=r"none of the 3 photographs could be placed \(0 pairs match\); no two of them match: .*; take"
    ) as printed:
        run_sfm(tmp_path / "photos", tmp_path / "new" / "scene", progress=False)
    assert "features" not in str(printed.value)
    assert capfd.readouterr().err == "" and not (tmp_path / "new").exists()


NAMES = [f"{number}.jpg" for number in range(300)]


class Reconstruction:
    """A part of the photographs, as pycolmap has it."""

    def __init__(self, names):
        self.images = {name: SimpleNamespace(name=name) for name in names}
        self.image = self.images.__getitem__
        self.reg_image_ids = self.images.keys

    def num_reg_images(self):
        return len(self.images)


def test_photographs_that_are_left_out_are_named():
    """All are placed; all but one; the smaller part of two that do not connect, one of it blank; and none."""
    for matching, num, num_flat, words in (
        ("exhaustive", 1, 1, "take more.*overlap"), ("exhaustive", 300, 290, "show no depth.*: walk between them$"),
        ("sequential", 4, 0, "overlap.*matching='exhaustive'"),
    ):  # fmt: skip
        with pytest.raises(ValueError, match=rf"\({num} pairs? match(es)?\); [^;]*{words}"):
            sfm._check_models([], NAMES, "photos", matching, sfm.Matches(num, num_flat, (), ()))
    many = sfm.Matches(999, 700, (), ())
    sfm._check_models([Reconstruction(NAMES)], NAMES, "photos", "exhaustive", many)
    with pytest.warns(UserWarning, match=r"^photos: 1 of 300 photographs could not be .* left out \(299.jpg\)$"):
        sfm._check_models([Reconstruction(NAMES[:-1])], NAMES, "photos", "exhaustive", many)
    parts = [Reconstruction(NAMES[:270]), Reconstruction(NAMES[270:298])]
    with pytest.warns(
        UserWarning,
        match=r": 30 of 300 .*\(270.jpg, .*, 293.jpg, …\).* in 1 of them \(299.jpg\).*"
        r"1 of them \(298.jpg\) match no other.* 270, 28",
    ):
        sfm._check_models(parts, NAMES, "photos", "exhaustive", many._replace(alone=("298.jpg",), blank=("299.jpg",)))
    with pytest.warns(UserWarning, match="between 8.jpg and 11.jpg, 20.jpg and 22.jpg$"):
        placed = [name for name in NAMES if name not in ("0.jpg", "9.jpg", "10.jpg", "21.jpg")]
        sfm._check_models([Reconstruction(placed)], sorted(NAMES), "photos", "exhaustive", many)


def test_blurred_photographs_are_named(tmp_path):
    """Half of them, by a lens out of focus; another content alone is not blurred."""
    random = np.random.default_rng(0)
    names = [f"{number}.jpg" for number in range(12)]
    for number, name in enumerate(names):
        size = (240 + 60 * (number % 3), 320)
        noise = gaussian_filter(random.normal(size=size), 1.5 + 0.1 * (number % 4))
        if number >= 6:
            noise = gaussian_filter(noise, 4.0) * 3
        Image.fromarray(np.uint8(np.clip(128 + 300 * noise, 0, 255))).save(tmp_path / name, quality=95)
    assert sfm.blurred_photos(tmp_path, names) == tuple(sorted(names[6:]))
    assert sfm.blurred_photos(tmp_path, names[:6]) == ()
    assert sfm.blurred_photos(tmp_path, ()) == ()
    many = sfm.Matches(999, 700, (), ())
    placed = [Reconstruction(names[:8])]
    with pytest.warns(UserWarning) as caught:
        sfm._check_models(placed, names, "photos", "exhaustive", many, names[6:])
    blurred, left_out = (str(warning.message) for warning in caught)
    assert blurred.startswith("photos: 2 of the photographs are blurred") and blurred.endswith("(6.jpg, 7.jpg)")
    assert "4 of them are blurred (8.jpg, 9.jpg, 10.jpg, 11.jpg)" in left_out


def test_two_subjects_are_told_apart():
    parts = [Reconstruction(NAMES[:160]), Reconstruction(NAMES[160:300])]
    with pytest.warns(UserWarning, match=r"160, 140 .*several subjects, give each a folder: .* 160.jpg, 161.jpg"):
        sfm._check_models(parts, NAMES, "photos", "exhaustive", sfm.Matches(999, 700, (), ()))


def test_an_interrupted_search_says_that_it_begins_again(tmp_path, monkeypatch, capsys):
    def interrupt(*_, **__):
        raise KeyboardInterrupt

    (tmp_path / "photos").mkdir()
    monkeypatch.setattr(sfm, "run_sfm", interrupt)
    assert cli.main(["sfm", str(tmp_path / "photos"), str(tmp_path / "scene")]) == 130
    assert capsys.readouterr().err == "a2tg: interrupted; nothing was kept: the same command begins again\n"


def test_a_part_of_the_photographs_is_no_success(tmp_path, monkeypatch, capsys):
    (tmp_path / "photos").mkdir()
    monkeypatch.setattr(sfm, "run_sfm", lambda *_, **__: sfm.SfmSummary(24, 12, 300, 0.5, 640))
    monkeypatch.setattr("a2tg_jax.results.figures.save_camera_picture", lambda *_: None)
    assert cli.main(["sfm", str(tmp_path / "photos"), str(tmp_path / "scene")]) == 2
    error = capsys.readouterr().err
    assert "only 12 of 24 photographs have a camera" in error
    assert "To train it all the same: a2tg train" in error


@pytest.mark.parametrize(
    ("side", "given", "faster"),
    [(320, "quick", ""), (640, "quick", "2"), (700, "quick --downscale 2", ""), (4000, "quick --downscale 7", "14")],
)
def test_what_trains_quicker_follows_from_the_size_of_the_photographs(
    tmp_path, monkeypatch, capsys, side, given, faster
):
    (tmp_path / "photos").mkdir()
    scene = tmp_path / "scene"
    monkeypatch.setattr(sfm, "run_sfm", lambda *_, **__: sfm.SfmSummary(24, 24, 300, 0.5, side))
    monkeypatch.setattr("a2tg_jax.results.figures.save_camera_picture", lambda *_: None)
    assert cli.main(["sfm", str(tmp_path / "photos"), str(scene)]) == 0
    *_, command, quicker = capsys.readouterr().out.splitlines()
    assert command.endswith(f"--preset {given}")
    advice = f"--downscale {faster} trains 2 to 3 times as fast; " if faster else ""
    assert quicker == f"quicker: {advice}a2tg make {scene} --minutes 10 chooses size and iterations for that time"
    make.run_step("sfm", [str(tmp_path / "photos"), str(scene)], Sfm.find_cameras)
    assert "a2tg train" not in capsys.readouterr().out, "a2tg make continues itself"


def test_gaps_are_between_photographs_of_one_folder():
    names = [f"{top}/{index}.jpg" for top in ("panorama/heading000", "panorama/up", "phone") for index in range(3)]
    placed = {name for name in names if not name.endswith("1.jpg")} - {"phone/0.jpg"}
    with pytest.warns(UserWarning, match="between 0.jpg and 2.jpg$"):
        sfm._check_models([Reconstruction([*placed])], names, "photos", "exhaustive", sfm.Matches(99, 0, (), ()))


def test_a_camera_that_only_turns_shows_no_depth(tmp_path):
    """COLMAP places such photographs by guesses, so that a scene is made, with a warning."""
    save_photos(tmp_path / "one", 1, 512, 384)
    whole = Image.open(tmp_path / "one" / "view_000.png")
    (tmp_path / "turned").mkdir()
    for index in range(3):  # Parts of one photograph, as a camera with a long lens sees that turns.
        left = 60 * index
        whole.crop((left, 40, left + 320, 280)).save(tmp_path / "turned" / f"{index}.png")
    words = "show no depth, as if taken from one spot or of a flat surface: walk between them"
    with pytest.warns(UserWarning, match=words):
        assert run_sfm(tmp_path / "turned", tmp_path / "scene", progress=False).num_registered == 3


def test_the_picture_of_the_cameras(tmp_path):
    """Both panels show cameras."""
    write_colmap(tmp_path)
    save_camera_picture(tmp_path, tmp_path / "cameras.png")
    pixels = np.asarray(Image.open(tmp_path / "cameras.png").convert("RGB")).astype(int)
    assert pixels.shape[1] > 1.8 * pixels.shape[0] > 900
    with Image.open(tmp_path / "cameras.png") as image:
        assert image.info["Software"].startswith("a2tg-jax")
    blue = np.abs(pixels - [0x44, 0x77, 0xAA]).max(axis=-1) < 20
    assert blue[:, : pixels.shape[1] // 2].sum() > 50 and blue[:, pixels.shape[1] // 2 :].sum() > 50


@pytest.mark.parametrize(
    "names, words",
    [
        (["a.CR2", "b.cr2", "c.jpg"], ["holds 1 photograph;", "2 .cr2", "read: .jpg,", "mogrify -format jpg"]),
        (["a/clip.MOV"], ["holds no photographs;", "1 .mov", "A video is given by itself: a2tg sfm"]),
        (["notes", ".DS_Store"], ["1 without suffix;"]),
        (["a.dng", "b.png", "c.png", "d.png", "notes.txt"], ["Skipped: 1 .dng;"]),
    ],
)
def test_what_is_skipped_is_counted(tmp_path, names, words):
    for name in names:
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    with pytest.raises(ValueError) if len(names) < 4 else pytest.warns(UserWarning) as printed:
        find_photos(tmp_path)
    text = str(printed.value if len(names) < 4 else printed[0].message)
    assert all(word in text for word in words)


def save_blocks(path, width, height, random):
    """Saves a picture that no other resembles."""
    path.parent.mkdir(exist_ok=True)
    Image.fromarray(random.integers(0, 255, (6, 8, 3), np.uint8)).resize((width, height)).save(path, quality=95)


def test_pictures_that_are_no_photographs_are_left_out(tmp_path):
    """Of a capture that other programs and this one have worked on, `images` and the two clips are left."""
    random = np.random.default_rng(0)
    photos = [
        "clip/3.jpg",
        "clip/4.jpg",
        "clip_2/3.jpg",
        "clip_2/4.jpg",
        "images/0.jpg",
        "images/1.jpg",
        "images/2.jpg",
    ]
    for name in photos:
        save_blocks(tmp_path / name, *((120, 90) if name.startswith("clip_2") else (240, 180)), random)
    others = {"cameras.png": 0, ".thumbs/0.jpg": 0, "run/test/0.png": 0, "images/0.png": 0, "images/1_mask.png": 1}
    others |= {"images/mask_2.jpg": 2} | {f"masks/{index}.jpg.png": index for index in range(3)}
    others |= {f"{k}/{index}.jpg": index for k in ("images_2", "small/images", "Depth-Maps") for index in range(3)}
    for name, index in others.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        with Image.open(tmp_path / "images" / f"{index}.jpg") as image:
            image.reduce(2 if name.startswith("images_2") else 3 if name.startswith("small") else 1).save(
                tmp_path / name
            )
    (tmp_path / "sparse").mkdir()
    (tmp_path / "run" / ".a2tg-run").write_text("a2tg-jax run\n.a2tg-run\ntest/0.png\n")
    with pytest.warns(UserWarning) as printed:
        assert find_photos(tmp_path) == sorted(photos)
    assert str(printed[0].message) == (
        f"{tmp_path}: Not taken for photographs: written by a2tg: 2 (cameras.png, run/test/0.png); "
        "in hidden folders: 1 (.thumbs/0.jpg); masks or depth maps: 8 (Depth-Maps/*.jpg, images/1_mask.png, "
        "images/mask_2.jpg, masks/*.png); copies of others: 7 (images/0.png, images_2/*.jpg, small/images/*.jpg). "
        "To use some, give a folder of these only"
    )
    for folder in ("masks", "images_2", "Depth-Maps", "small"):
        assert len(find_photos(tmp_path / folder)) == 3, "as the message says"
    for folder in ("images", "images_2", "clip", "clip_2", "small"):
        shutil.rmtree(tmp_path / folder)
    with pytest.raises(
        ValueError, match=r"holds no photographs; at least 3 .*\. Not taken for photographs: .*\. To use"
    ):
        find_photos(tmp_path)


def test_photographs_where_links_lead_are_found(tmp_path):
    """Also where a link leads to a folder above it."""
    random = np.random.default_rng(0)
    for name in ("photos/0.png", "photos/a/1.png", "phone/2.png", "phone/b/3.png"):
        save_blocks(tmp_path / name, 64, 48, random)
    photos = tmp_path / "photos"
    (photos / "linked").symlink_to(tmp_path / "phone")
    (photos / "a" / "again").symlink_to(photos)
    (photos / "broken").symlink_to(tmp_path / "nothing.png")
    assert find_photos(photos) == ["0.png", "a/1.png", "linked/2.png", "linked/b/3.png"]


def test_pictures_of_this_program_are_left_out_under_any_name(tmp_path):
    random = np.random.default_rng(0)
    photos = [f"{index}.{suffix}" for index, suffix in enumerate(("png", "webp", "jpg", "png"))]
    for name in photos:
        save_blocks(tmp_path / name, 64, 48, random)
    with Image.open(tmp_path / "0.png") as image:
        write_png(tmp_path / "my view.PNG", image.rotate(180))
        save_animation(tmp_path / "flight.webp", iter([image.rotate(180), image]), 5)
    with pytest.warns(UserWarning, match=r"photographs: written by a2tg: 2 \(flight.webp, my view.PNG\)$"):
        assert find_photos(tmp_path) == photos


def test_photographs_may_be_listed(tmp_path):
    """Listed files are sorted out as a folder's are, and those of one folder are one source."""
    random = np.random.default_rng(0)
    for name in ("a/0.png", "a/1.png", "a/2.png", "a/3.png", "b/0.jpg"):
        save_blocks(tmp_path / name, 64, 48, random)
    (tmp_path / "a" / "notes.txt").touch()
    (tmp_path / "a" / "1_mask.png").write_bytes((tmp_path / "a" / "1.png").read_bytes())
    listed = [tmp_path / "a" / name for name in ("2.png", "0.png", "1.png", "notes.txt", "1_mask.png")]
    with pytest.warns(UserWarning, match=r"masks or depth maps: 1 \(1_mask.png\)"):
        assert staged(listed, tmp_path / "one").names == ["0.png", "1.png", "2.png"]
    (one, other) = staged([*listed[:3], tmp_path / "b" / "0.jpg"], tmp_path / "two").groups
    assert (one.names, other.names) == (("a/0.png", "a/1.png", "a/2.png"), ("b/0.jpg",))
    assert len(staged([*listed[:3], tmp_path / "a" / "3.png"], tmp_path / "three").names) == 4
    with pytest.raises(ValueError, match=r"^2 photographs of .*a given; at least 3 photographs are needed$"):
        staged(listed[:2], tmp_path / "four")
    (tmp_path / "a" / "clip.insv").touch()
    with pytest.raises(ValueError, match=r"clip.insv: is a recording of Insta360"):
        staged([*listed[:3], tmp_path / "a" / "clip.insv"], tmp_path / "five")


def test_photographs_with_the_same_bytes_are_left_out_and_named(tmp_path):
    """Of one source and of several, under any name. A file of equal size with other bytes is kept."""
    random = np.random.default_rng(0)
    for name in ("a/0.bmp", "a/1.bmp", "a/2.bmp", "b/0.bmp"):
        save_blocks(tmp_path / name, 64, 48, random)
    for copy, name in (("a/9.bmp", "a/1.bmp"), ("b/other.bmp", "a/0.bmp")):
        shutil.copyfile(tmp_path / name, tmp_path / copy)
    sizes = {file.stat().st_size for file in tmp_path.glob("?/*.bmp")}
    assert len(sizes) == 1
    with pytest.warns(UserWarning, match=r"^left out 1 photograph with the same bytes as another: 9\.bmp of 1\.bmp$"):
        assert staged([tmp_path / "a"], tmp_path / "one").names == ["0.bmp", "1.bmp", "2.bmp"]
    with pytest.warns(UserWarning, match=r"left out 2 photographs .*: a/9\.bmp of a/1\.bmp, b/other\.bmp of a/0\.bmp$"):
        names = staged([tmp_path / "a", tmp_path / "b"], tmp_path / "two").names
    assert names == ["a/0.bmp", "a/1.bmp", "a/2.bmp", "b/0.bmp"]


def test_all_photographs_that_cannot_be_read_are_named_at_once(tmp_path):
    """Also those that would be compared with another of their name."""
    random = np.random.default_rng(0)
    for index in range(4):
        save_blocks(tmp_path / "photos" / f"{index}.png", 64, 48, random)
    photos_of(tmp_path / "photos", "1.png", "8.jpg", "sub/1.jpg", data=b"no image")
    (tmp_path / "photos" / "9.jpg").write_bytes(b"")
    message = r"^\S*photos/1\.png: cannot be read .*; replace or remove it\. 3 more cannot be used: "
    with pytest.raises(ValueError, match=rf"{message}\S*photos/8\.jpg, \S*photos/9\.jpg, \S*photos/sub/1\.jpg$"):
        staged([tmp_path / "photos"], tmp_path / "work")


def photos_of(folder, *names, data=b"no image"):
    """A folder of files that are no images."""
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(data)
    return folder


@pytest.mark.parametrize(
    ("names", "options", "error", "message"),
    [
        (["1.jpg", "2.jpg", "3.jpg"], {}, ValueError, r"1\.jpg: cannot be read as an image"),
        ([], {"matching": "all"}, ValueError, "matching must be one of auto"),
        ([], {"camera_model": "EQUIRECTANGULAR"}, ValueError, "camera_model must be one of SIMPLE_PINHOLE"),
        ([], {}, FileNotFoundError, "no such folder of photographs"),
        (["notes"], {}, ValueError, "holds no photographs; at least 3 photographs are needed"),
        (["a b.cr2"], {}, ValueError, r"magick mogrify -format jpg '.*\*\.cr2'$"),
    ],
)  # fmt: skip
def test_what_cannot_become_a_scene(tmp_path, names, options, error, message):
    with pytest.raises(error, match=message):
        run_sfm(photos_of(tmp_path / "my photos", *names), tmp_path / "scene", progress=False, **options)


@pytest.mark.skipif(sys.platform != "linux", reason="other systems have no such names")
@pytest.mark.parametrize("name", [b"photo\xe9.png", b"caf\xe9/photo.png"])
def test_names_that_are_not_utf_8(tmp_path, name):
    photos_of(tmp_path / "photos", os.fsdecode(name), "1.jpg", "2.jpg")
    with pytest.raises(ValueError, match=r"\\xe9.*: its name is not UTF-8, .*; rename the photograph"):
        run_sfm(tmp_path / "photos", tmp_path / "scene", progress=False)


def test_loading_names_the_command_that_makes_a_scene(tmp_path, monkeypatch):
    monkeypatch.chdir(photos_of(tmp_path, "a clip.mp4", "my photos/1.jpg"))
    with pytest.raises(ValueError, match=r"run `a2tg sfm 'a clip\.mp4' SCENE` first"):
        load_scene(tmp_path / "a clip.mp4")
    with pytest.raises(FileNotFoundError, match="`a2tg sfm 'my photos' SCENE`"):
        load_scene(tmp_path / "my photos")
