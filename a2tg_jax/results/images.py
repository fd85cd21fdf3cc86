"""Pictures made from renders (errors, crops, side-by-side sheets, animations) and their files.

Images are uint8 [H, W, 3] unless said otherwise.
"""

import base64
import hashlib
import io
import os
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import BinaryIO

import matplotlib
import numpy as np
from numpy.typing import ArrayLike
from PIL import ExifTags, Image, ImageDraw, ImageFont
from PIL.PngImagePlugin import PngInfo
from scipy.ndimage import gaussian_filter, uniform_filter

from a2tg_jax.base.atomic import replacing
from a2tg_jax.base.text import PROGRAM
from a2tg_jax.core.notebook_display import enlarged

ERROR_GAIN = 4
CHECKER = (0.75, 0.55)
"""Greys of `checkered`."""
MARGIN = 6
CAPTION_HEIGHT = 22
FONT = Path(matplotlib.get_data_path(), "fonts/ttf/DejaVuSans.ttf")
"""Font of captions; Pillow's default lacks × and ²."""
LONGEST_STEM = 190
"""Largest number of bytes of a view's name in a file name; file systems allow 255, partial files' names are longer."""
LONGEST_SIDE = 1280
"""Longest side of a picture in the report, in pixels."""


def to_uint8(image: ArrayLike) -> np.ndarray:
    """Return 8-bit pixels of a float image, clipped to [0, 1] and rounded."""
    return np.rint(255 * np.clip(np.asarray(image), 0, 1)).astype(np.uint8)


def checkered(shape: tuple[int, ...], side: int) -> np.ndarray:
    """Return a chequered background [H, W, 1] with squares of `side` pixels."""
    y, x = np.indices(shape) // side
    return np.where((x + y) % 2, *CHECKER)[..., None]


def error_picture(image: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Return the absolute difference, brightened ERROR_GAIN times."""
    # uint8 differences would wrap.
    difference = np.abs(image.astype(np.int32) - target.astype(np.int32))
    return np.minimum(ERROR_GAIN * difference, 255).astype(np.uint8)


def largest_gain(target: np.ndarray, before: np.ndarray, after: np.ndarray) -> tuple[slice, slice]:
    """Return the square, a quarter of the shorter side, where details gain most from `before` to `after`.

    The gain is in the squared error without its low frequencies, for a shift in colour on a wall shows nothing.
    Squares whose error stays above the picture's mean are left out, unless all are.
    """
    height, width = target.shape[:2]
    side = max(8, min(height, width) // 4)
    errors = []
    for image in (before, after):
        residual = image.astype(np.float32) - target
        errors.append(np.sum((residual - gaussian_filter(residual, (side / 8, side / 8, 0))) ** 2, axis=-1))

    def in_squares(error: np.ndarray) -> np.ndarray:
        # The origin shifts each window so that its pixel is the upper left corner, not the centre.
        means: np.ndarray = uniform_filter(error, size=side, mode="constant", origin=-(side // 2))
        return means[: max(1, height - side + 1), : max(1, width - side + 1)]

    gain = in_squares(errors[0] - errors[1])
    is_good = in_squares(errors[1]) <= errors[1].mean()
    best = np.where(is_good, gain, -np.inf) if is_good.any() else gain
    top, left = map(int, np.unravel_index(int(best.argmax()), best.shape))
    return slice(top, top + side), slice(left, left + side)


def side_by_side(images: Sequence[np.ndarray], captions: Sequence[str]) -> Image.Image:
    """Return images in a row, each under its caption, which is cut off at the image's width. Small images are enlarged
    to make room for captions."""
    images = [enlarged(image) for image in images]
    height, width = images[0].shape[:2]
    sheet = Image.new("RGB", ((width + MARGIN) * len(images) - MARGIN, height + CAPTION_HEIGHT), "white")
    font = ImageFont.truetype(FONT, size=13)
    for index, (image, caption) in enumerate(zip(images, captions, strict=True)):
        left = index * (width + MARGIN)
        strip = Image.new("RGB", (width, CAPTION_HEIGHT), "white")
        ImageDraw.Draw(strip).text((2, 2), caption, fill="black", font=font)
        sheet.paste(strip, (left, 0))
        sheet.paste(Image.fromarray(image), (left, CAPTION_HEIGHT))
    return sheet


def picture_names(view_names: Iterable[str]) -> dict[str, str]:
    """Return file names of the views' pictures, on one line and unique regardless of case; folders become a part.

    Long names are cut and end in a hash. If two names would be equal, as for a/b.png and a_b.jpg, the later in sorted
    order gets a number.
    """
    names: dict[str, str] = {}
    taken: set[str] = set()
    for view_name in sorted(view_names):
        # Lists of files have a name on each line.
        stem = "_".join(os.path.splitext(view_name)[0].replace("/", "_").splitlines())
        data = stem.encode(errors="surrogatepass")
        if len(data) > LONGEST_STEM:
            # ignore drops a character that the cut divided.
            stem = f"{data[:LONGEST_STEM].decode(errors='ignore')}-{hashlib.sha256(data).hexdigest()[:8]}"
        unique = stem
        number = 1
        # casefold: macOS and Windows do not distinguish case.
        while unique.casefold() in taken:
            number += 1
            unique = f"{stem}-{number}"
        taken.add(unique.casefold())
        names[view_name] = f"{unique}.png"
    return names


def save_picture(path: Path, picture: Image.Image | np.ndarray) -> None:
    """Write a PNG atomically."""
    with replacing(path) as temporary:
        write_png(temporary, picture)


def write_png(path: Path, picture: Image.Image | np.ndarray) -> None:
    picture = Image.fromarray(picture) if isinstance(picture, np.ndarray) else picture
    text = PngInfo()
    text.add_text("Software", PROGRAM)  # `data.photo_folder` takes no such picture for a photograph.
    picture.save(path, format="PNG", pnginfo=text)


def jpeg_uri(image: np.ndarray, *, zoom: int = 1, quality: int = 88) -> str:
    """Return an image as a data: URI, enlarged `zoom` times without smoothing, and reduced if very large."""
    picture = Image.fromarray(np.ascontiguousarray(image))
    # NEAREST: pixels of a crop stay visible.
    picture = picture.resize((picture.width * zoom, picture.height * zoom), Image.Resampling.NEAREST)
    picture.thumbnail((LONGEST_SIDE, LONGEST_SIDE))
    buffer = io.BytesIO()
    # Full colour resolution: differences in texture are often differences in colour only.
    picture.save(buffer, format="JPEG", quality=quality, subsampling=0)
    return "data:image/jpeg;base64," + base64.b64encode(buffer.getvalue()).decode()


def file_uri(path: Path) -> str:
    """Return an image file, by its suffix, as a data: URI."""
    return f"data:image/{path.suffix[1:]};base64," + base64.b64encode(path.read_bytes()).decode()


def save_animation(
    file: Path | BinaryIO, pictures: Iterator[Image.Image], frames_per_second: float, **options: int
) -> None:
    """Write pictures as a looping animated WebP, with one of them in memory at a time."""
    duration = round(1000 / frames_per_second)
    exif = Image.Exif()
    exif[ExifTags.Base.Software] = PROGRAM  # As in `write_png`.
    # Pillow draws the rest from the generator, one at a time.
    next(pictures).save(
        file, "WEBP", save_all=True, append_images=pictures, duration=duration, loop=0, exif=exif, **options
    )
