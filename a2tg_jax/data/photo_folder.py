"""Plain photographs in a folder: which are read, which are skipped, and what to do about those."""

import shlex
import warnings
from collections import Counter
from pathlib import Path

from a2tg_jax.core.display import counted

PHOTO_SUFFIXES = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp", ".webp")
FOREIGN_SUFFIXES = (".heic", ".heif", ".avif", ".jxl", ".dng", ".raw", ".cr2", ".cr3", ".nef", ".arw", ".gif")
"""Suffixes of pictures that COLMAP does not read."""
VIDEO_SUFFIXES = (".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm")
LEAST_PHOTOS = 3
MOST_TOLD = 5
"""Largest number of suffixes that a message counts."""


def find_photos(folder: Path) -> list[str]:
    """Return paths of the photographs below a folder, relative to it, sorted. A warning counts pictures and videos
    among the other files.

    Raises:
      FileNotFoundError: if there is no such folder.
      ValueError: if it is a file, or holds fewer than 3 photographs.
    """
    check_no_video(folder)
    if folder.is_file():
        raise ValueError(f"{folder}: is a file; give its folder")
    if not folder.is_dir():
        raise FileNotFoundError(f"{folder}: no such folder of photographs")
    files = sorted(file.relative_to(folder) for file in folder.rglob("*") if file.is_file() and file.name[0] != ".")
    photos = [file.as_posix() for file in files if file.suffix.lower() in PHOTO_SUFFIXES]
    others = [file for file in files if file.suffix.lower() not in PHOTO_SUFFIXES]
    if len(photos) < LEAST_PHOTOS:
        held = f"holds {counted(len(photos), 'photograph') if photos else 'no photographs'}" if files else "is empty"
        told = f"{folder}: {held}; at least {counted(LEAST_PHOTOS, 'photograph')} are needed"
        raise ValueError(told + (f". {_skipped(folder, others)}" if others else ""))
    pictures = [file for file in others if file.suffix.lower() in FOREIGN_SUFFIXES + VIDEO_SUFFIXES]
    if pictures:
        warnings.warn(f"{folder}: {_skipped(folder, pictures)}", stacklevel=3)
    return photos


def check_no_video(path: Path) -> None:
    """Raise ValueError if the path is that of a video, telling how it becomes photographs."""
    if path.suffix.lower() in VIDEO_SUFFIXES and path.is_file():
        frames = f"mkdir photos && {_to_frames(path, Path('photos'))}"
        raise ValueError(
            f"{path}: is a video. First make a folder and extract frames: {frames}. Then: a2tg sfm photos SCENE"
        )


def _skipped(folder: Path, files: list[Path]) -> str:
    """Return the number of skipped files by suffix, the formats that are read, and how to convert."""
    counts = Counter(file.suffix.lower() or "without suffix" for file in files)
    parts = [f"{number} {suffix}" for suffix, number in counts.most_common(MOST_TOLD)]
    told = f"Skipped: {', '.join(parts)}{', …' if len(counts) > MOST_TOLD else ''}; read: {', '.join(PHOTO_SUFFIXES)}"
    foreign = next((file for file in files if file.suffix.lower() in FOREIGN_SUFFIXES), None)
    video = next((file for file in files if file.suffix.lower() in VIDEO_SUFFIXES), None)
    if foreign is not None:
        pattern = folder / foreign.parent / f"*{foreign.suffix}"
        told += f". To make JPEG files of them: magick mogrify -format jpg {pattern}"
    if video is not None:
        told += f". To extract two frames a second from a video: {_to_frames(folder / video, folder)}"
    return told


def _to_frames(video: Path, folder: Path) -> str:
    """Return a command that writes frames of a video into a folder."""
    command = ["ffmpeg", "-i", str(video), "-vf", "fps=2", "-q:v", "2", str(folder / "%04d.jpg")]
    return shlex.join(command)
