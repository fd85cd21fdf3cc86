"""Decoding of photographs that may be broken or malicious.

Only formats of photographs are tried, because Pillow has others, one of which starts a program. HEIC needs its own
library. Size and bits are checked before decoding. Pixels are uint8, [H, W, 3] or, with straight alpha, [H, W, 4].
"""

import functools
import importlib
import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from io import BufferedReader
from pathlib import Path
from typing import NamedTuple

import numpy as np
from PIL import ExifTags, Image, ImageOps, UnidentifiedImageError

from a2tg_jax.base.regular_files import open_regular
from a2tg_jax.base.text import shortened

FORMATS = ("JPEG", "PNG", "TIFF", "WEBP", "AVIF", "BMP", "GIF", "PPM")
HEIC_BRANDS = {b"heic", b"heix", b"heim", b"heis", b"hevc", b"hevx"}
"""Brands of HEIC, at least one of which is in the first box of such a file; AVIF files have others."""
LONGEST_BOX = 64
BITS_PER_SAMPLE = 258
"""TIFF tag of the bits per sample."""
TIFF_SIZE = 256, 257
"""TIFF tags of the stored width and height."""
TURNED = range(2, 9)
SIDEWAYS = range(5, 9)
"""EXIF orientations other than upright, and the ones that exchange width and height."""
LENS_TAGS = (ExifTags.Base.Make, ExifTags.Base.Model, ExifTags.Base.FocalLength, ExifTags.Base.FocalLengthIn35mmFilm)
GPANO = re.compile(rb"""GPano:(\w+)(?:\s*=\s*["']|>)\s*([\w.]+)""")
"""Name and value in the XMP of a panorama."""
LONGEST_REASON = 200
LARGEST_LEVEL = {"L": 255, "I;16": 65535, "I;16B": 65535, "I": 65535}
"""Largest level of grey, by Pillow's mode. I is 16 bits of PNG, in some versions, and PPM, and 32 bits of TIFF."""
MOST_BYTES = 1 << 30
"""Largest size of an image file: the size of the largest uncompressed picture."""
MAX_PIXELS = 128_000_000
"""Largest width × height of a decoded picture, which takes up to 1 GB."""


class PictureError(ValueError):
    """An image file that cannot be used: its path, and what is wrong with it and what to do."""

    def __str__(self) -> str:
        path, text = self.args
        return f"{path}: {text}"


def read_pixels(path: Path) -> np.ndarray:
    """Return the pixels of an image file as stored, without EXIF rotation, because cameras are estimated without it.

    Greyscale and palette images become RGB; an alpha channel is kept unless it is opaque throughout.

    Raises:
      ValueError: naming the file, if it cannot be read as an image of 8 bits per channel and at most `MAX_PIXELS`.
    """
    with _opened(path) as image:
        has_alpha = _has_alpha(image)
        # Pillow turns TIFF, and no other format, as it decodes, by this tag.
        if image.format == "TIFF":
            image.getexif()[ExifTags.Base.Orientation] = 1
        pixels = np.asarray(image.convert("RGBA" if has_alpha else "RGB"))
    # One picture with alpha gives all batches an opacity (training.batches), so drop an opaque one.
    if has_alpha and (pixels[..., 3] == 255).all():
        return np.ascontiguousarray(pixels[..., :3])  # A view would keep the fourth channel in memory.
    return pixels


def picture_size(path: Path) -> tuple[int, int]:
    """Return (width, height) of an image file as stored, without decoding it, so `MAX_PIXELS` does not apply."""
    with _opened(path, is_decoded=False) as image:
        return _stored_size(image)


def _stored_size(image: Image.Image) -> tuple[int, int]:
    """Return (width, height) without EXIF rotation, which Pillow applies to the size of TIFF."""
    if image.format != "TIFF":
        return image.size
    width, height = (int(image.tag_v2[tag]) for tag in TIFF_SIZE)  # type: ignore[attr-defined]
    return width, height


class PictureFacts(NamedTuple):
    """Facts about an image file that can be decoded."""

    size: tuple[int, int]
    """(width, height) after EXIF rotation."""
    is_turned: bool
    """Whether EXIF says that the stored pixels are turned or mirrored."""
    format: str
    """Pillow's name of the format."""
    lens: tuple[str, ...]
    """Camera and focal length from EXIF."""
    is_transparent: bool
    """Whether some of its pixels are not opaque."""
    is_panorama: bool | None
    """Whether its XMP (GPano) says that it is a whole equirectangular panorama; None: it has none."""


def picture_facts(path: Path) -> PictureFacts:
    """Return facts of an image file after decoding it. Raises as `read_pixels` does."""
    with _opened(path) as image:
        turn = image.getexif().get(ExifTags.Base.Orientation, 1)  # Decoding TIFF removes it.
        width, height = _stored_size(image)
        size = (height, width) if turn in SIDEWAYS else (width, height)
        image.load()  # Opening is lazy: damage shows only now.
        exif = image.getexif()
        details = exif.get_ifd(ExifTags.IFD.Exif)
        # Make and model are in the main directory of EXIF, focal lengths in the one below.
        lens = (*(exif.get(tag) for tag in LENS_TAGS), *(details.get(tag) for tag in LENS_TAGS))
        lens_facts = tuple(str(value) for value in lens if value)
        is_transparent = _has_alpha(image) and bool((np.asarray(image.convert("RGBA"))[..., 3] < 255).any())
        return PictureFacts(size, turn in TURNED, image.format or "", lens_facts, is_transparent, _is_panorama(image))


def _is_panorama(image: Image.Image) -> bool | None:
    # https://developers.google.com/streetview/spherical-metadata: attributes or elements of RDF.
    xmp = image.info.get("xmp") or image.info.get("XML:com.adobe.xmp") or b""
    tags = dict(GPANO.findall(xmp.encode() if isinstance(xmp, str) else xmp))
    if b"ProjectionType" not in tags:
        return None
    is_whole = True
    for side in (b"Width", b"Height"):
        cropped = tags.get(b"CroppedAreaImage%sPixels" % side)
        full = tags.get(b"FullPano%sPixels" % side)
        is_whole &= cropped is None or full is None or cropped == full
    return is_whole and tags[b"ProjectionType"].lower() == b"equirectangular"


def _has_alpha(image: Image.Image) -> bool:
    return "A" in image.getbands() or "transparency" in image.info


def save_upright(path: Path, target: Path, quality: int) -> None:
    """Write an image file again with its pixels turned as EXIF says, as PNG or JPEG by the target's suffix.

    A PNG keeps the alpha channel. EXIF data of the camera are kept, because the focal length is among them. Data of a
    TIFF's layout would be wrong.
    """
    with _opened(path) as image:
        stored = image.getexif()
        exif = Image.Exif()
        exif.update({tag: stored[tag] for tag in LENS_TAGS[:2] if tag in stored})
        details = stored.get_ifd(ExifTags.IFD.Exif)
        exif.get_ifd(ExifTags.IFD.Exif).update(
            {tag: value for tag, value in details.items() if tag != ExifTags.Base.MakerNote}
        )
        upright = ImageOps.exif_transpose(image)
        mode = "RGBA" if _has_alpha(image) else "RGB"
        exif[ExifTags.Base.Orientation] = 1  # Or readers would turn the pixels again.
        if target.suffix.lower() == ".png":
            upright.convert(mode).save(target, exif=exif, compress_level=1)
        else:
            upright.convert("RGB").save(target, quality=quality, subsampling=0, exif=exif)  # 4:4:4 keeps colours sharp.


def software_of(path: Path) -> str:
    """Return the name of the program that wrote an image file; "" if the file does not say. Raises as `read_pixels`."""
    with _opened(path, is_decoded=False) as image:
        # PNG has it as a text, other formats in EXIF.
        return str(image.info.get("Software") or image.getexif().get(ExifTags.Base.Software) or "")


def upright_thumbnail(path: Path, side: int) -> tuple[tuple[int, int], np.ndarray]:
    """Return (width, height) and grey levels [side, side] of an image file turned as EXIF says."""
    with _opened(path) as image:
        upright = ImageOps.exif_transpose(image)
        return upright.size, np.asarray(upright.convert("RGB").convert("L").resize((side, side))).astype(np.float32)


def read_grey(path: Path) -> tuple[np.ndarray, int]:
    """Return the levels [H, W] int32 of a greyscale image of 8 or 16 bits, such as a depth map, and the largest level.

    Raises as `read_pixels` does, and for colours.
    """
    with _opened(path, most_bits=16) as image:
        if image.mode not in LARGEST_LEVEL or (image.mode, image.format) == ("I", "TIFF"):
            raise ValueError(
                f"{path}: must be greyscale, of 8 or 16 bits; its mode is {image.mode}; replace or remove it"
            )
        return np.asarray(image).astype(np.int32), LARGEST_LEVEL[image.mode]


@contextmanager
def _opened(path: Path, most_bits: int = 8, is_decoded: bool = True) -> Iterator[Image.Image]:
    """Open an image within the block; its size and bits are checked if it is decoded.

    Every decoding error, in the block too, becomes a PictureError.
    """
    try:
        with open_regular(path, MOST_BYTES) as file, Image.open(file, formats=_formats_of(path, file)) as image:
            if is_decoded and image.width * image.height > MAX_PIXELS:
                raise ValueError(
                    f"{path}: has {image.width}x{image.height} pixels, and {MAX_PIXELS // 10**6} megapixels is the "
                    "limit; make it smaller, or put smaller copies of all images next to them (images_2, for a "
                    "downscale of 2)"
                )
            if is_decoded and most_bits == 8 and (image.mode.startswith(("I", "F")) or _is_deep(image)):
                raise ValueError(f"{path}: has more than 8 bits per channel; convert it to an 8-bit image")
            yield image
    except Exception as error:  # Damaged pictures raise anything from SyntaxError to struct.error.
        beginning = f"{path}: "
        if str(error).startswith(beginning):  # Raised above, or by a caller.
            if type(error) is ValueError:
                raise PictureError(path, str(error).removeprefix(beginning)) from error
            raise
        reason = shortened(str(error) or type(error).__name__, LONGEST_REASON)
        if isinstance(error, UnidentifiedImageError):  # Its text names an object of Python instead of the file.
            known = f"it is none of {', '.join(FORMATS)}"
            reason = known if os.path.getsize(path) else "it is empty: 0 bytes"
        raise PictureError(path, f"cannot be read as an image ({reason}); replace or remove it") from error


def _formats_of(path: Path, file: BufferedReader) -> tuple[str, ...]:
    # HEIC and AVIF files begin with a box "ftyp": its length, its name, and the brands, each of 4 bytes.
    head = file.peek(LONGEST_BOX)[:LONGEST_BOX]
    brands = {head[at : at + 4] for at in range(8, min(len(head), int.from_bytes(head[:4], "big")), 4)}
    if head[4:8] != b"ftyp" or not brands & HEIC_BRANDS:
        return FORMATS
    if not _reads_heic():
        raise ValueError(f"{path}: is a HEIC photograph, which needs pillow-heif: pip install 'a2tg-jax[heic]'")
    return (*FORMATS, "HEIF")


@functools.cache
def _reads_heic() -> bool:
    """Have Pillow read HEIC too, and return whether it can."""
    try:
        importlib.import_module("pillow_heif").register_heif_opener()
    except ImportError:
        return False
    return True


def _is_deep(image: Image.Image) -> bool:
    """Return whether an image has more than 8 bits per channel. Pillow reads RGB of 16 bits as 8, so the file's storage
    decides."""
    arguments = [tile[-1] for tile in getattr(image, "tile", ())]
    if image.format == "TIFF":
        return bool(max(image.tag_v2.get(BITS_PER_SAMPLE, (1,))) > 8)  # type: ignore[attr-defined]
    if image.format == "PPM":
        # Pillow passes the largest level of the file last.
        return any(isinstance(args, tuple) and args[-1] > 255 for args in arguments)
    return image.format == "PNG" and any(";16" in str(args) for args in arguments)  # Such as RGB;16B.
