"""Plain photographs in a folder: which are read, which are skipped, and what to do about those."""

import itertools
import warnings
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

from a2tg_jax.data.images import PHOTO_SUFFIXES
from a2tg_jax.data.other_pictures import other_pictures
from a2tg_jax.data.unread_captures import told_of_capture
from a2tg_jax.host.text import as_argument, counted

FOREIGN_SUFFIXES = (
    ".jxl", ".jp2", ".j2k", ".dng", ".raw", ".cr2", ".cr3", ".nef", ".arw", ".raf", ".orf", ".rw2", ".pef", ".gif",
    ".ppm", ".tga", ".psd", ".exr", ".hdr",
)  # fmt: skip
"""Suffixes of pictures that are not read."""
VIDEO_SUFFIXES = (".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm")
LEAST_PHOTOS = 3
MOST_TOLD = 5
"""Largest number of suffixes that a message counts."""


def is_video(path: Path) -> bool:
    """Return whether a path is a file named as videos are."""
    return path.suffix.lower() in VIDEO_SUFFIXES and path.is_file()


def holds_photos(folder: Path) -> bool:
    """Return whether a folder has enough photographs in it or below it."""
    photos = (file for file in _files_below(folder) if file.suffix.lower() in PHOTO_SUFFIXES)
    return len(list(itertools.islice(photos, LEAST_PHOTOS))) == LEAST_PHOTOS


def find_photos(folder: Path, least: int = LEAST_PHOTOS) -> list[str]:
    """Return paths of the photographs below a folder, relative to it, sorted.

    Warnings count pictures that are no photographs (`other_pictures`), and files of other formats.

    Raises:
      FileNotFoundError: if there is no such folder.
      ValueError: if it is a file, or holds fewer than `least` photographs.
    """
    if folder.is_file():
        raise ValueError(f"{folder}: {told_of_capture(folder) or 'is a file; give its folder'}")
    if not folder.is_dir():
        raise FileNotFoundError(f"{folder}: no such folder of photographs")
    files = sorted(file.relative_to(folder) for file in _files_below(folder))
    pictures = [file.as_posix() for file in files if file.suffix.lower() in PHOTO_SUFFIXES]
    left_out, told_others = other_pictures(folder, pictures)
    photos = [name for name in pictures if name not in left_out]
    unread = [file for file in files if file.suffix.lower() not in PHOTO_SUFFIXES]
    if len(photos) < least:
        held = f"holds {counted(len(photos), 'photograph') if photos else 'no photographs'}" if files else "is empty"
        told = f"{folder}: {held}; at least {counted(least, 'photograph')} {'is' if least == 1 else 'are'} needed"
        skipped = [_skipped(folder, unread)] if unread else []
        raise ValueError(". ".join([told, *([told_others] if left_out else []), *skipped]))
    if left_out:
        warnings.warn(f"{folder}: {told_others}", stacklevel=3)
    foreign = [file for file in unread if file.suffix.lower() in FOREIGN_SUFFIXES + VIDEO_SUFFIXES]
    if foreign:
        warnings.warn(f"{folder}: {_skipped(folder, foreign)}", stacklevel=3)
    return photos


def _files_below(folder: Path) -> Iterator[Path]:
    return (file for file in folder.rglob("*") if file.name[0] != "." and file.is_file())


def check_no_video(path: Path) -> None:
    """Raise ValueError if the path is that of a video, telling how it becomes a scene."""
    if is_video(path):
        raise ValueError(f"{path}: is a video; to make a scene of it, run `a2tg sfm {as_argument(path)} SCENE` first")


def _skipped(folder: Path, files: list[Path]) -> str:
    """Return the number of skipped files by suffix, the formats that are read, and how to convert."""
    counts = Counter(file.suffix.lower() or "without suffix" for file in files)
    parts = [f"{number} {suffix}" for suffix, number in counts.most_common(MOST_TOLD)]
    told = f"Skipped: {', '.join(parts)}{', …' if len(counts) > MOST_TOLD else ''}; read: {', '.join(PHOTO_SUFFIXES)}"
    foreign = next((file for file in files if file.suffix.lower() in FOREIGN_SUFFIXES), None)
    video = next((file for file in files if file.suffix.lower() in VIDEO_SUFFIXES), None)
    if foreign is not None:
        pattern = as_argument(folder / foreign.parent / f"*{foreign.suffix}")  # ImageMagick itself expands the star.
        told += f". To make JPEG files of them: magick mogrify -format jpg {pattern}"
    if video is not None:
        told += f". A video is given by itself: a2tg sfm {as_argument(folder / video)} SCENE"
    return told
