"""Folders of smaller copies: images_2 beside images, masks_2 beside masks, for a downscale of 2."""

import functools
import warnings
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

from a2tg_jax.data.decoding import picture_size
from a2tg_jax.data.images import find_image, map_in_threads, num_readers
from a2tg_jax.host.regular_files import is_folder
from a2tg_jax.host.remote_files import is_remote

ROUNDING = 1.0
"""Largest difference in pixels between a side of a smaller copy and the photograph's side divided by the downscale."""


class SmallerCopies(NamedTuple):
    """Where a scene has smaller copies of its files."""

    downscale: int
    folders: Mapping[Path, Path]
    """Folder of the copies, by folder of the full files."""

    def of(self, folder: Path) -> tuple[Path, int]:
        """Return the folder to read a folder's files from, and the remaining factor of downscaling."""
        return (self.folders[folder], 1) if folder in self.folders else (folder, self.downscale)


def find_copies(files: Sequence[tuple[Path, str]], downscale: int, root: Path) -> SmallerCopies:
    """Find the folders NAME_k beside folders NAME of a scene that hold its files at 1/k of their size.

    Such a folder may also be another clip of the scene. It counts if the scene names no file in it, and it has a copy
    of each file of NAME, 1/k as large. A folder that fails is not used, with a warning. Files whose full size is
    missing, cannot be read or is in object storage are not compared.

    Args:
      files: folder, and path below it, of every photograph and mask that the scene names.
      downscale: k >= 1.
      root: the scene's folder, which has no copies: its siblings are other scenes.
    """
    found: dict[Path, Path] = {}
    named = {(folder / name).parent for folder, name in files} if downscale > 1 else set()
    for folder in dict.fromkeys(folder for folder, _ in files if downscale > 1 and folder != root):
        smaller = folder.with_name(f"{folder.name}_{downscale}")
        if not is_folder(smaller) or any(place.is_relative_to(smaller) for place in named):
            continue
        names = [name for own, name in files if own == folder]
        difference = functools.partial(_difference, folder, smaller, downscale)
        differences = map_in_threads(difference, names, num_readers(folder))
        if told := [each for each in differences if each]:
            warnings.warn(
                f"{smaller}: does not hold the files of {folder} at 1/{downscale} of their size, for {len(told)} of "
                f"{len(names)}, such as {told[0]}: not used",
                stacklevel=4,
            )
        else:
            found[folder] = smaller
    return SmallerCopies(downscale, found)


def _difference(folder: Path, smaller: Path, downscale: int, name: str) -> str:
    """Return how the copy of a file differs from one of 1/downscale of its size; "" if it does not."""
    full, copy = (find_image(place, name) for place in (folder, smaller))
    if full is None:
        return ""
    if copy is None:
        return f"{name}, which is missing"
    if is_remote(full):
        return ""
    with suppress(ValueError):  # A photograph may be too large to be read in full.
        size, copied = picture_size(full), picture_size(copy)
        if any(abs(side - whole / downscale) > ROUNDING for side, whole in zip(copied, size, strict=True)):
            return f"{name}, which is {copied[0]}x{copied[1]} for {size[0]}x{size[1]}"
    return ""
