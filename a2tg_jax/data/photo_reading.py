"""Reading of a scene's photographs with their masks and depth maps.

All photographs are read, so that a broken one is found before training.

Next to the folder `images` may be
 - `masks` with NAME.EXT.png (as in COLMAP), NAME.png or NAME.EXT for NAME.EXT. Black, or transparent, excludes a
   pixel; everything else keeps it, as with COLMAP and nerfstudio. Black may be 16, as in videos, or noisy, as in JPEG;
 - `depths` with NAME.npy or NAME.png. What they hold is an option of the training (`training.depth_prior`). They are
   read when a training needs them;
 - `images_k` and `masks_k` with copies at 1/k of the size.
"""

import contextlib
import dataclasses
import functools
from collections import defaultdict
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from PIL import Image
from scipy.ndimage import maximum_filter, minimum_filter

from a2tg_jax import DepthMap, Mask
from a2tg_jax.base.checks import check_literal
from a2tg_jax.base.npz import read_npy
from a2tg_jax.base.text import shortened
from a2tg_jax.base.user_warnings import warn
from a2tg_jax.data.assembly import Shot, check_test_every
from a2tg_jax.data.decoding import MAX_PIXELS, picture_size, read_grey, read_pixels
from a2tg_jax.data.image_files import find_image, map_in_threads, on_disk
from a2tg_jax.data.lenses import Lens, LensUse, resize_pixels
from a2tg_jax.data.photo_store import Shelf

MASKS = "masks"
DEPTHS = "depths"
HALF = 128
"""Level from which on a pixel of a mask is bright."""
AlphaMeaning = Literal["transparency", "mask"]
"""Meaning of the alpha channel: transparency over a background, or a mask, of which only opaque pixels count."""
MaskMeaning = Literal["ignored", "background"]
"""Meaning of the pixels that a mask excludes: they do not count, or they are empty, as transparent ones are."""
Counted = Callable[[np.ndarray], np.ndarray]
"""Function from a view's pixels [H, W, C] to [H, W] bool, True where they count."""
MAX_ASPECT_ERROR = 0.01
"""Largest relative difference of aspect between an image and its camera, beyond one pixel of rounding."""
MAX_DEPTH_ASPECT_ERROR = 0.02
"""Largest relative difference of aspect between a depth map and its photograph, beyond two pixels of rounding."""
NEARLY_BLACK = 1 / 8
"""Largest level of black in a mask, as a share of its largest level: 16 of 235 in videos, and noise of JPEG."""
NEAR_EDGE = 17
"""Side in pixels of the square around a grey pixel of a mask that has black and white if it is on an edge: blocks of
JPEG, which have 8 pixels, reach half as far."""
MOST_GREY = 0.01
"""Largest share of other grey pixels in a mask without a warning."""
ROUNDING = 1.0
"""Largest difference in pixels between a side of a smaller copy and the photograph's side divided by the downscale."""


@dataclasses.dataclass(frozen=True)
class SceneOptions:
    """Path of a scene, and options for reading its photographs."""

    path: str = ""
    """Scene folder with photographs and cameras, or a built-in scene, "synthetic" or "cells"; not needed with --config
    or --resume."""
    downscale: int = 1
    """Factor k by which images are downscaled."""
    test_every: int = 8
    """Hold out every k-th image for testing; 0: train on all, for the final picture."""
    alpha: AlphaMeaning = "transparency"
    """Meaning of the alpha channel: transparency before a background, or a mask that leaves pixels out."""
    mask_as: MaskMeaning = "ignored"
    """Meaning of the pixels that masks exclude: ignored, or background, empty as transparent pixels are, which cuts
    the subject out."""
    lens: LensUse = "undistort"
    """Photographs of distorted cameras, such as fisheyes: undistort them to pinholes, or keep them as they are."""

    def check_options(self) -> None:
        """Raise ValueError, naming the option, if one is invalid."""
        check_literal("alpha", self.alpha, AlphaMeaning)
        check_literal("mask_as", self.mask_as, MaskMeaning)
        check_literal("lens", self.lens, LensUse)
        if self.alpha == "mask" and self.mask_as == "background":
            raise ValueError(
                "`alpha` must be transparency where `mask_as` is background, which makes pixels transparent; got mask"
            )
        if self.downscale < 1 or self.downscale != int(self.downscale):
            raise ValueError(f"downscale must be a whole number of at least 1; got {self.downscale}")
        check_test_every(self.test_every)


class Photo(NamedTuple):
    """A photograph that the scene names, with its camera."""

    name: str
    viewmat: np.ndarray
    """[4, 4] float64 world to camera (OpenCV), in the original world."""
    image: tuple[Path, str]
    """Folder of the full images, and path below it."""
    below_images: tuple[Path, str] | None
    """Folder `images` and path below it, for masks and depth maps; None if it is elsewhere."""
    lens: Lens | Callable[[tuple[int, int]], Lens]
    """Lens, or a function from the full image's (width, height) to it."""
    what: str
    """Name of the photograph in errors of its lens."""
    mask: Path | None = None
    """Mask that the scene names."""
    depths: Path | None = None
    """Depth map that the scene names."""
    counted: Counted | None = None
    """Function that finds the pixels that count, for photographs without a mask."""
    panorama: int | None = None
    """Number of the panorama that it was cut from."""


class _Files(NamedTuple):
    """The files of a photograph, and the factors by which their pixels are downscaled."""

    photo: Photo
    image: Path
    downscale: int
    mask: Path | None
    mask_downscale: int
    depths: Path | None


def read_photos(
    photos: Sequence[Photo],
    options: SceneOptions,
    shelf: Shelf,
    place: Path,
    root: Path,
    how_to_remove: Callable[[str], str],
) -> list[Shot]:
    """Read the photographs of a scene.

    Args:
      photos: the photographs.
      options: how they are read.
      shelf: store of the pixels.
      place: path of the scene in messages.
      root: the scene's folder, which has no smaller copies: its siblings are other scenes.
      how_to_remove: function from an image name to advice on removing it from the scene.
    """
    files = _find_files(photos, options.downscale, root, how_to_remove)
    names: dict[Path, str] = {}
    for each in files:  # Where capitals or suffixes were lost, one file may fit two names.
        name = names.setdefault(each.image, each.photo.name)
        if name != each.photo.name:
            raise ValueError(
                f"{each.image}: is the only file for {name} and {each.photo.name}; put both there, or remove one from "
                "the scene"
            )
    read = map_in_threads(lambda each: _read(each, options, shelf), files)
    masks = [each.mask for each in files if each.mask is not None]
    lacking = [each.photo.name for each in files if each.mask is None]
    if not masks:
        _warn_of_unused_masks(photos)
        if options.mask_as == "background":
            warn(
                f"{place}: no photograph has a mask, so that `mask_as` background changes nothing; masks are read "
                f"from the folder {MASKS} next to images, or from the mask_path of a frame of transforms.json"
            )
    else:
        warn_of_lacking_masks(place, lacking, len(files))
    warn_of_grey([grey for _, grey in read if grey is not None], masks)
    return [shot for shot, _ in read]


# Files of photographs


def _find_files(
    photos: Sequence[Photo], downscale: int, root: Path, how_to_remove: Callable[[str], str]
) -> list[_Files]:
    """Return the files of photographs, from folders of smaller copies where they are complete."""
    masks = map_in_threads(lambda photo: _full_mask(photo, downscale), photos)
    named = [*(photo.image for photo in photos), *(mask for mask in masks if mask is not None)]
    copies = _find_copies(named, downscale, root)

    def find(photo: Photo, mask: tuple[Path, str] | None) -> _Files | None:
        folder, name = photo.image
        image = find_image(copies.get(folder, folder), name)
        mask_file = None
        mask_downscale = downscale
        if mask is not None:
            mask_folder, mask_name = mask
            mask_file = on_disk(copies.get(mask_folder, mask_folder), mask_name)
            mask_downscale = 1 if mask_folder in copies else downscale
            if mask_file is None and photo.mask is not None:
                raise FileNotFoundError(
                    f"{photo.mask}: no such mask, but the scene names it; add the mask or remove its mask_path"
                )
        depths = photo.depths
        if depths is None and photo.below_images is not None:
            depths = find_depths(*photo.below_images)
        if image is None:
            return None
        return _Files(photo, image, 1 if folder in copies else downscale, mask_file, mask_downscale, depths)

    of_photos = map_in_threads(find, photos, masks)
    missing = [photo.image for photo, files in zip(photos, of_photos, strict=True) if files is None]
    if missing:
        folder, name = missing[0]
        others = f", and {len(missing) - 1} more of its {len(photos)} are missing" if len(missing) > 1 else ""
        raise FileNotFoundError(
            f"{copies.get(folder, folder) / name}: no such image, but the scene has a camera for it{others}; put it "
            f"there, or {how_to_remove(name)}"
        )
    return [files for files in of_photos if files is not None]


def _full_mask(photo: Photo, downscale: int) -> tuple[Path, str] | None:
    """Return the folder of a photograph's full mask, and the mask's path below it, from the mask or a smaller copy."""
    if photo.mask is not None:
        return photo.mask.parent, photo.mask.name
    if photo.below_images is None:
        return None
    images, name = photo.below_images
    folder = images.with_name(MASKS)
    folders = [folder, images.with_name(f"{MASKS}_{downscale}")] if downscale > 1 else [folder]
    for each in folders:
        file = on_disk(each, *mask_names(name))
        if file is not None:
            return folder, file.relative_to(each).as_posix()
    return None


def _find_copies(files: Sequence[tuple[Path, str]], downscale: int, root: Path) -> dict[Path, Path]:
    """Return the folders NAME_k that hold the files of folders NAME of a scene at 1/k of their size, by NAME.

    Such a folder may also be another clip of the scene. It counts if the scene names no file in it, and it has a copy
    of each file of NAME, 1/k as large. A folder that fails is not used, with a warning. Files whose full size is
    missing or cannot be read are not compared.

    Args:
      files: folder, and path below it, of every photograph and mask that the scene names.
      downscale: k >= 1.
      root: as in `read_photos`.
    """
    if downscale == 1:
        return {}
    names: dict[Path, list[str]] = defaultdict(list)
    for folder, name in files:
        names[folder].append(name)
    named = {(folder / name).parent for folder, name in files}
    copies: dict[Path, Path] = {}
    for folder, of_folder in names.items():
        smaller = folder.with_name(f"{folder.name}_{downscale}")
        if folder == root or not smaller.is_dir() or any(each.is_relative_to(smaller) for each in named):
            continue
        compare = functools.partial(_difference_of_copy, folder, smaller, downscale)
        unlike = [difference for difference in map_in_threads(compare, of_folder) if difference]
        if unlike:
            warn(
                f"{smaller}: does not hold the files of {folder} at 1/{downscale} of their size, for {len(unlike)} of "
                f"{len(of_folder)}, such as {unlike[0]}: not used"
            )
        else:
            copies[folder] = smaller
    return copies


def _difference_of_copy(folder: Path, smaller: Path, downscale: int, name: str) -> str:
    """Return how the copy of a file differs from one of 1/downscale of its size; "" if it does not."""
    full = find_image(folder, name)
    copy = find_image(smaller, name)
    if full is None:
        return ""
    if copy is None:
        return f"{name}, which is missing"
    with contextlib.suppress(ValueError):  # A photograph may be too large to be read in full.
        size = picture_size(full)
        copied = picture_size(copy)
        if np.abs(np.subtract(copied, np.divide(size, downscale))).max() > ROUNDING:
            return f"{name}, which is {copied[0]}x{copied[1]} for {size[0]}x{size[1]}"
    return ""


def mask_names(name: str) -> tuple[str, str, str]:
    """Return the names that the mask of a photograph may have, the preferred one first."""
    return f"{name}.png", str(Path(name).with_suffix(".png")), name


def find_depths(images: Path, name: str) -> Path | None:
    """Return the depth map of an image below a folder: NAME.npy, NAME.png, NAME.EXT.npy or NAME.EXT.png in the sibling
    folder `depths`; None if there is none.
    """
    stem = Path(name).with_suffix("")
    names = (f"{stem}.npy", f"{name}.npy", f"{stem}.png", f"{name}.png")
    return on_disk(images.with_name(DEPTHS), *names)


# Photographs


def _read(files: _Files, options: SceneOptions, shelf: Shelf) -> tuple[Shot, Path | None]:
    """Read a photograph, and undistort and downscale it. Also return its mask file if that has areas that are neither
    black nor white."""
    photo = files.photo
    photograph = read_pixels(files.image)
    height, width = photograph.shape[:2]
    stored = (width, height)
    lens = _lens_of(files, stored, options.downscale)
    try:
        size, K = lens.view_of(stored, files.downscale)
        rays = lens.rays(*size)
    except ValueError as error:
        raise ValueError(f"{photo.what}: its camera model {error}") from None
    mask = None if files.mask is None else read_mask(files.mask, stored, lens.size)
    pixels = photograph
    if mask is not None and options.mask_as == "background":
        pixels = _cut_out(photograph, mask.counts)
    pixels = lens.view_pixels(pixels, files.downscale)
    counted = []
    if mask is not None and options.mask_as == "ignored":
        counted.append(_view_mask(mask.counts, files.mask_downscale, lens, size))
    if mask is None and photo.counted is not None:
        counted.append(photo.counted(pixels))
    if options.alpha == "mask" and pixels.shape[2] == 4:
        counted.append(pixels[..., 3] == 255)
        pixels = np.ascontiguousarray(pixels[..., :3])  # A view would keep the alpha channel in memory.
    shot = Shot(
        photo.name,
        photo.viewmat,
        K,
        shelf.keep(pixels, files.image if pixels is photograph else None),
        Mask.of(np.logical_and.reduce(counted)) if counted else None,
        rays,
        None if files.depths is None else _depth_map(files.depths, lens, stored, size),
        photo.panorama,
    )
    return shot, files.mask if mask is not None and mask.has_grey_areas else None


def _lens_of(files: _Files, stored: tuple[int, int], downscale: int) -> Lens:
    """Return the lens of a photograph whose file is of a size (width, height); ValueError: of another aspect."""
    lens = files.photo.lens
    if not isinstance(lens, Lens):
        full = stored
        if files.downscale < downscale:  # The file is a smaller copy, and the full image may be missing.
            original = find_image(*files.photo.image)
            full = (downscale * stored[0], downscale * stored[1]) if original is None else picture_size(original)
        lens = lens(full)
    width, height = stored
    camera_width, camera_height = lens.size
    ratio = (width * camera_height) / (height * camera_width)
    if abs(ratio - 1) > max(MAX_ASPECT_ERROR, 1 / min(stored)):  # Or a pixel of the shorter side.
        is_turned = (height, width) == lens.size
        advice = "write it turned as EXIF says (magick mogrify -auto-orient FILE), or " if is_turned else ""
        raise ValueError(
            f"{files.image}: is {width}x{height}, but its camera is {camera_width}x{camera_height}, of another aspect; "
            f"{advice}use the image that the camera was estimated from"
        )
    return lens


def _view_mask(counts: np.ndarray, downscale: int, lens: Lens, view_size: tuple[int, int]) -> np.ndarray:
    """Return the mask [H, W] of a view of (width, height), undistorted and downscaled as its photograph was.

    A pixel counts if all its source pixels count.
    """
    # Pillow takes no [H, W, 1]. Resampled, only 255 from nothing but 255 stays 255.
    planes = np.repeat(np.where(counts, np.uint8(255), np.uint8(0))[..., None], 3, axis=2)
    planes = lens.view_pixels(planes, downscale)
    return np.asarray(resize_pixels(planes, *view_size)[..., 0] == 255)


def _cut_out(pixels: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """Return the pixels of a photograph [H, W, C] that are transparent too where a mask of any size excludes them."""
    if counts.all():
        return pixels
    size = pixels.shape[1], pixels.shape[0]
    counts = np.asarray(Image.fromarray(counts).resize(size, Image.Resampling.NEAREST))
    opacities = pixels[..., 3] if pixels.shape[2] == 4 else np.uint8(255)
    return np.dstack([pixels[..., :3], np.where(counts, opacities, np.uint8(0))])


# Masks


class MaskFile(NamedTuple):
    """A mask as a file has it."""

    counts: np.ndarray
    """[H, W] bool, True where pixels count."""
    has_grey_areas: bool
    """Whether it has areas that are neither black nor white."""


def read_mask(file: Path, *sizes: tuple[int, int]) -> MaskFile:
    """Return a mask of one of some sizes (width, height), the photograph's first."""
    pixels = read_pixels(file)
    counts, has_grey_areas = _divided(pixels[..., :3].max(axis=-1))
    if pixels.shape[2] == 4 and (pixels[..., 3] != pixels[0, 0, 3]).any():  # The alpha channel is a mask.
        is_opaque, has_grey_areas = _divided(pixels[..., 3])
        lit = pixels[is_opaque & counts]
        # Colours hold a mask too if there are two of them, one black: not in a cut-out photograph, nor where all are
        # black. A file with a mask in both excludes what either does.
        has_both = 0 < len(lit) < is_opaque.sum() and (lit[:, :3] == lit[0, :3]).all()
        counts = is_opaque & counts if has_both else is_opaque
    height, width = counts.shape
    if (width, height) not in sizes:
        wanted = f"{sizes[0][0]}x{sizes[0][1]}"
        raise ValueError(
            f"{file}: is {width}x{height}, but its photograph is {wanted}; a mask must be of the same size; a2tg sfm "
            "takes masks of the photographs by --masks, and undistorts both"
        )
    return MaskFile(counts, has_grey_areas)


def _divided(levels: np.ndarray) -> MaskFile:
    """Divide the pixels of a mask [H, W] uint8 into black and white.

    White is the largest level: 255, or 1 in a mask of 0 and 1. Grey pixels on edges between black and white, as JPEG
    and resizing make them, are what they are nearer to; in larger areas they count.
    """
    white = int(levels.max())
    black = int(levels.min())
    # Dark levels are numbers of classes, of which 0 is none.
    darkest = NEARLY_BLACK * white if white >= HALF else 0.0
    is_grey = (levels > darkest) & (levels <= white / 2)
    if is_grey.mean() > MOST_GREY:
        is_on_edge = (minimum_filter(levels, NEAR_EDGE) <= darkest) & (maximum_filter(levels, NEAR_EDGE) > white / 2)
        if (is_grey & ~is_on_edge).mean() > MOST_GREY:
            return MaskFile(levels > darkest, white >= HALF or black > 0)
    # Of one dark level, such as 16, it may be black or the number of a class.
    return MaskFile(levels > white / 2, 1 < white < HALF and black > 0)


def _warn_of_unused_masks(photos: Sequence[Photo]) -> None:
    """Warn of folders that may hold masks, for a scene without any."""
    folders = {photo.below_images[0].with_name(MASKS) for photo in photos if photo.below_images}
    for folder in filter(Path.is_dir, folders):
        warn(f"{folder}: holds no mask of a photograph of the scene, called NAME.jpg.png or NAME.png: not used")
    for root in {folder.parent for folder in folders}:
        for folder in sorted(root.glob("*[mM]ask*/")):
            if not folder.name.startswith(MASKS):
                warn(f"{folder}: not read; if it holds masks, rename it to {MASKS}")


def warn_of_lacking_masks(place: Path, lacking: Sequence[str], num: int) -> None:
    """Warn of the photographs, among `num`, that have no mask although others have."""
    if lacking:
        warn(
            f"{place}: {len(lacking)} of {num} photographs have no mask, such as {lacking[0]}: all of their pixels "
            "count"
        )


def warn_of_grey(grey: Sequence[Path], masks: Sequence[Path]) -> None:
    """Warn of masks with areas that are neither black nor white, among all masks."""
    if grey:
        warn(
            f"{grey[0].parent}: {len(grey)} of {len(masks)} masks have areas that are neither black nor white, such as "
            f"{grey[0].name}: pixels above an eighth of the largest level count; make a mask black where pixels must "
            "not count, and white elsewhere"
        )


# Depth maps


def _depth_map(file: Path, lens: Lens, stored: tuple[int, int], size: tuple[int, int]) -> DepthMap:
    """Return the depth map of a view, which is undistorted and resized as its photograph when it is read.

    Sizes are (width, height), of the photograph's file and of the view.
    """

    def load() -> np.ndarray:
        values = read_depths(file)
        height, width = values.shape
        if abs(width * stored[1] - height * stored[0]) > max(
            MAX_DEPTH_ASPECT_ERROR * width * stored[1], 2 * max(stored)
        ):
            raise ValueError(
                f"{file}: is {width}x{height}, of another aspect than its photograph, {stored[0]}x{stored[1]}"
            )
        return np.asarray(Image.fromarray(lens.view_plane(values)).resize(size, Image.Resampling.BILINEAR))

    return DepthMap((size[1], size[0]), load)


def read_depths(file: Path) -> np.ndarray:
    """Return the numbers [H, W] float32 of a depth map, an .npy or a greyscale PNG, whose largest value is 1."""
    if file.suffix.lower() == ".npy":
        try:
            values = read_npy(file)
        except Exception as error:  # Damaged files raise anything from SyntaxError to struct.error.
            if str(error).startswith(f"{file}: "):  # It says already which file and what to do.
                raise
            reason = shortened(str(error) or type(error).__name__)
            raise ValueError(f"{file}: cannot be read as a depth map ({reason}); replace or remove it") from error
        # With the axis of a batch or a channel, such as [1, H, W].
        values = values.reshape([side for side in values.shape if side != 1]) if values.ndim > 2 else values
    else:
        levels, largest = read_grey(file)
        values = levels.astype(np.float32) / largest
    if values.ndim != 2 or not 0 < values.size <= MAX_PIXELS:
        raise ValueError(f"{file}: a depth map must be [H, W]; got {list(values.shape)}")
    return np.ascontiguousarray(values, np.float32)
