"""Folders of plain photographs: which files are photographs, and what to do about the others.

Masks, depth maps, copies and pictures that this program wrote are left out: as photographs they would give a test view
a twin among the training views, or get a pose. Captures in formats that are not read are recognised.
"""

import contextlib
import itertools
import math
import re
from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from fnmatch import fnmatchcase
from pathlib import Path, PurePosixPath

import numpy as np

from a2tg_jax.base.regular_files import is_regular, names_in, read_regular
from a2tg_jax.base.text import PROGRAM, counted, first_names
from a2tg_jax.base.user_warnings import warn
from a2tg_jax.data.decoding import software_of, upright_thumbnail
from a2tg_jax.data.image_files import PHOTO_SUFFIXES, files_below, is_hidden, is_photo, map_in_threads
from a2tg_jax.data.other_runs import other_run
from a2tg_jax.host.errors import as_argument

FOREIGN_SUFFIXES = (
    ".jxl", ".jp2", ".j2k", ".dng", ".raw", ".cr2", ".cr3", ".nef", ".arw", ".raf", ".orf", ".rw2", ".pef", ".gif",
    ".ppm", ".tga", ".psd", ".exr", ".hdr",
)  # fmt: skip
"""Suffixes of pictures that are not read."""
VIDEO_SUFFIXES = (
    ".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm", ".mts", ".m2ts", ".ts", ".mpg", ".mpeg", ".vob", ".3gp", ".3g2",
    ".wmv", ".asf", ".flv", ".ogv",
)  # fmt: skip
SPHERICAL_SUFFIXES = (".insp", ".insv", ".osv", ".360")
"""Suffixes of photographs and videos of 360° cameras that are two fisheyes, and in `FOUND_BY`."""
LEAST_PHOTOS = 3
MOST_TOLD = 5
"""Largest number of suffixes that a message counts."""
CAMERA_PICTURE = "cameras.png"
"""Picture of the cameras that `a2tg sfm` puts next to `sparse`."""
OWN_SUFFIXES = (".png", ".webp")
"""Suffixes of the pictures that this program writes."""
OWN = "written by a2tg"
LISTS = (".a2tg-run", ".a2tg-frames")
"""Lists of what runs and renders wrote into a folder, a name a line, after its checksum if it has one."""
MOST_LIST_BYTES = 1 << 26
# "masked" is left out: a masked photograph is one.
NOT_PHOTOGRAPHS = re.compile(
    r"(?<![a-z])(mask(?!ed)[a-z]*|(mattes?|segmentations?|depths?|depthmaps?|normals|confidences?)(?![a-z]))",
    re.IGNORECASE,
)
"""Words in names of folders, and in names of files around the name of a photograph."""
THUMBNAIL = 32
SMALLER_TOLERANCE = 2.0
EQUAL_TOLERANCE = 0.5
"""Largest mean difference in grey levels of thumbnails between a photograph and its copy, smaller or of its size.

Copies at 1/4 differ by up to 1.2, neighbouring frames of six captures by at least 2.4.
"""
FOUND_BY: tuple[tuple[str, str], ...] = (
    ("run.toml", "is the record of a run of a2tg train, which --resume continues; to train again, give its scene"),
    ("*.psx", "is a project of Metashape: File > Export > Export Cameras as Agisoft XML, beside a folder images"),
    ("*.rcproj", "is a project of RealityCapture: export the registration as COLMAP, or as XMP beside the photographs"),
    ("*.rsproj", "is a project of RealityScan: export the registration as COLMAP, or as XMP beside the photographs"),
    ("*.r3d", "is a recording of Record3D: rename it to .zip, unpack it, and give the folder with metadata and rgbd"),
    ("*.insp", "is a photograph of Insta360: export an equirectangular JPEG with Insta360 Studio, then a2tg sfm"),
    ("*.insv", "is a recording of Insta360: export an equirectangular MP4 with Insta360 Studio, then a2tg sfm"),
    ("*.osv", "is a recording of DJI Osmo 360: export an equirectangular MP4 with DJI Studio, then a2tg sfm"),
    ("*.360", "is a recording of GoPro MAX: export an equirectangular MP4 with GoPro Player, then a2tg sfm"),
    ("*.usdz", "is a finished model, without photographs: export the raw data of the capture"),
    ("*.zip", "is packed: unpack it, and give the folder in it"),
    ("poses_bounds.npy", "has LLFF's poses only, which are not read: a2tg sfm finds them again from its images"),
    ("bundle.out", "has Bundler's cameras, which are not read: export COLMAP's format"),
    ("*.nvm", "has VisualSFM's cameras, which are not read: export COLMAP's format"),
    ("reconstruction.json", "has OpenSfM's cameras: opensfm export_colmap writes what is read"),
    ("opensfm/reconstruction.json", "has OpenSfM's cameras: opensfm export_colmap opensfm writes what is read"),
    ("*.sfm", "has Meshroom's cameras: its node ExportColmap writes what is read"),
    ("*.mvs", "is a scene of OpenMVS, which is not read: export COLMAP's format"),
    ("pose/*.txt", "has a pose for each image (ScanNet), which are not read: write transforms.json"),
    ("*.csv", "may be RealityScan's list of cameras, which is not read: export COLMAP, or XMP beside the photographs"),
    ("database.db", "has COLMAP's database without a model: colmap mapper writes sparse/0"),
)
"""Pattern of files below the capture's folder, and what to do. The first that fits is reported."""


def is_video(path: Path) -> bool:
    return path.suffix.lower() in VIDEO_SUFFIXES and path.is_file()


def holds_photos(folder: Path) -> bool:
    """Return whether a folder has enough photographs in it or below it."""
    photos = filter(is_photo, files_below(folder))
    return len(list(itertools.islice(photos, LEAST_PHOTOS))) == LEAST_PHOTOS


def listed_photos(folder: Path) -> list[Path]:
    """Return the photographs in a folder and below it, sorted, with damaged ones.

    Unlike `find_photos`, with copies of others, which take long to find, and in any number.
    """
    pictures = {file.relative_to(folder).as_posix(): file for file in sorted(filter(is_photo, files_below(folder)))}
    others = set().union(*_no_photographs(folder, list(pictures)).values())
    return [file for name, file in pictures.items() if name not in others]


def find_photos(folder: Path, least: int = LEAST_PHOTOS, chosen: Sequence[Path] | None = None) -> list[str]:
    """Return paths of the photographs below a folder, relative to it, sorted.

    Warnings count pictures that are no photographs, and files of other formats.

    Args:
      folder: folder of photographs.
      least: smallest number of photographs.
      chosen: files in the folder to choose from; None: all in it and below it.

    Raises:
      FileNotFoundError: if there is no such folder.
      ValueError: if it holds fewer than `least` photographs, or a chosen file is another program's.
    """
    if not folder.is_dir():
        raise FileNotFoundError(f"{folder}: no such folder of photographs, photograph or video")
    for file in chosen or ():
        hint = capture_hint(file)
        if hint is not None:
            raise ValueError(f"{file}: {hint}")
    found = files_below(folder) if chosen is None else set(chosen)
    files = sorted(file.relative_to(folder) for file in found if file.name[0] != ".")
    pictures = [file.as_posix() for file in files if is_photo(file)]
    unread = [file for file in files if not is_photo(file)]
    left_out = _left_out(folder, pictures)
    others = set().union(*left_out.values())
    photos = [name for name in pictures if name not in others]
    if len(photos) < least:
        held = counted(len(photos), "photograph")
        if chosen is not None:
            outcome = f"{held} of {folder} given"
        elif files:
            outcome = f"{folder}: holds {held if photos else 'no photographs'}"
        else:
            outcome = f"{folder}: is empty"
        sentences = [f"{outcome}; at least {counted(least, 'photograph')} {'is' if least == 1 else 'are'} needed"]
        if left_out:
            sentences.append(_about_left_out(left_out))
        if chosen is None and other_run(folder) is not None:
            sentences.append(f"{folder} {capture_hint(folder)}")
        elif unread:
            sentences.append(_skipped(folder, unread))
        raise ValueError(". ".join(sentences))
    if left_out:
        warn(f"{folder}: {_about_left_out(left_out)}")
    foreign = [file for file in unread if file.suffix.lower() in FOREIGN_SUFFIXES + VIDEO_SUFFIXES + SPHERICAL_SUFFIXES]
    if foreign:
        warn(f"{folder}: {_skipped(folder, foreign)}")
    return photos


def _left_out(folder: Path, pictures: Sequence[str]) -> dict[str, set[str]]:
    """Return the pictures that are left out by the reason, without reasons that apply to none."""
    left_out = _no_photographs(folder, pictures)
    others = set().union(*left_out.values())
    left_out["copies of others"] = _copies(folder, [name for name in pictures if name not in others])
    return {kind: names for kind, names in left_out.items() if names}


def _no_photographs(folder: Path, pictures: Sequence[str]) -> dict[str, set[str]]:
    """Return the pictures that are no photographs by what they are."""
    return {
        OWN: _written(folder, pictures),
        "in hidden folders": {name for name in pictures if is_hidden(PurePosixPath(name))},
        "masks or depth maps": _masks(pictures),
    }


def _about_left_out(left_out: Mapping[str, set[str]]) -> str:
    counts = [f"{kind}: {len(names)} ({first_names(_patterns(names))})" for kind, names in left_out.items()]
    advice = "" if left_out.keys() == {OWN} else ". To use some, give a folder of these only"
    return f"Not taken for photographs: {'; '.join(counts)}{advice}"


def _skipped(folder: Path, files: list[Path]) -> str:
    """Return the number of skipped files by suffix, the formats that are read, and how to convert others."""
    counts = Counter(file.suffix.lower() or "without suffix" for file in files)
    parts = [f"{number} {suffix}" for suffix, number in counts.most_common(MOST_TOLD)]
    message = (
        f"Skipped: {', '.join(parts)}{', …' if len(counts) > MOST_TOLD else ''}; read: {', '.join(PHOTO_SUFFIXES)}; "
        f"videos: {', '.join(VIDEO_SUFFIXES[:MOST_TOLD])}, …"
    )

    def first_of(suffixes: Sequence[str]) -> Path | None:
        return next((file for file in files if file.suffix.lower() in suffixes), None)

    spherical = first_of(SPHERICAL_SUFFIXES)
    if spherical is not None:
        message += f". {spherical} {capture_hint(spherical)}"
    foreign = first_of(FOREIGN_SUFFIXES)
    if foreign is not None:
        pattern = as_argument(folder / foreign.parent / f"*{foreign.suffix}")  # ImageMagick itself expands the star.
        message += f". To make JPEG files of them: magick mogrify -format jpg {pattern}"
    video = first_of(VIDEO_SUFFIXES)
    if video is not None:
        message += f". A video is given by itself: a2tg sfm {as_argument(folder / video)} SCENE"
    return message


def capture_hint(path: Path) -> str | None:
    """Return what a file or folder of another program is and what to do with it, or None if it is unknown."""
    if not path.is_dir():
        name = path.name.lower()
        return next((text for pattern, text in FOUND_BY if fnmatchcase(name, pattern)), None)
    run = other_run(path)
    if run is not None:
        scene = "the scene that it was made from" if run.scene is None else f"its scene, {run.scene}"
        return f"is an output folder of {run.program}, whose model is {run.model}; to train, give {scene}"
    names = names_in(path)
    for pattern, text in FOUND_BY:
        # Cameras write suffixes in capitals, but Python's glob is case-sensitive before 3.12.
        fitting = [name for name in names if fnmatchcase(name.lower(), pattern)]
        if "/" in pattern:
            fitting = sorted(file.relative_to(path).as_posix() for file in path.glob(pattern))
        if fitting:
            return f"{fitting[0]} {text}"
    return None


def _written(folder: Path, names: Sequence[str]) -> set[str]:
    """Return the pictures that this program wrote, by its name in them or by a list next to or above them."""

    def is_own(name: str) -> bool:
        with contextlib.suppress(ValueError):  # Damaged pictures are reported when they are read.
            return software_of(folder / name) == PROGRAM
        return False

    tried = [name for name in names if name.lower().endswith(OWN_SUFFIXES)]
    written = set(itertools.compress(tried, map_in_threads(is_own, tried)))
    # Older ones, and copies by programs that drop the name.
    cameras = (name for name in names if PurePosixPath(name).name == CAMERA_PICTURE)
    written |= {name for name in cameras if (folder / name).with_name("sparse").is_dir()}
    for place in {parent for name in names for parent in PurePosixPath(name).parents}:
        for file in filter(is_regular, (folder / place / name for name in LISTS)):
            lines = read_regular(file, MOST_LIST_BYTES).decode(errors="replace").splitlines()
            # As sha256sum writes lines: checksum, two spaces, name.
            written |= {str(place / line.rpartition("  ")[2]) for line in lines}.intersection(names)
    return written


def _masks(names: Sequence[str]) -> set[str]:
    """Return the pictures in folders called masks, depths etc., and those called so next to a photograph."""
    pictures = set(names)
    known = pictures | {str(PurePosixPath(name).with_suffix("")) for name in names}
    masks = set()
    for path in map(PurePosixPath, names):
        is_mask = any(map(NOT_PHOTOGRAPHS.search, path.parts[:-1]))
        if path.suffix.lower() == ".png":  # 0.jpg.png next to 0.jpg
            is_mask |= str(path.with_suffix("")) in pictures
        word = NOT_PHOTOGRAPHS.search(path.stem)
        if word is not None:  # 0_mask.png next to 0.jpg
            around = (path.stem[: word.start()].strip("_-. "), path.stem[word.end() :].strip("_-. "))
            is_mask |= any(name and str(path.with_name(name)) in known for name in around)
        if is_mask:
            masks.add(str(path))
    return masks


def _copies(folder: Path, names: Sequence[str]) -> set[str]:
    """Return the pictures that show the same as a larger or earlier one of the same name, in this or another folder."""
    same_name = defaultdict(list)
    for name in names:
        path = PurePosixPath(name)
        while path.suffix.lower() in PHOTO_SUFFIXES:  # 0.heic.jpg is a copy of 0.heic.
            path = path.with_suffix("")
        # Copies may be in a separate folder at any level: two names are alike with one folder left out of either.
        for key in {path.parts, *(path.parts[:at] + path.parts[at + 1 :] for at in range(len(path.parts) - 1))}:
            same_name[key].append(name)
    groups = [group for group in same_name.values() if len(group) > 1]
    wanted = sorted(set().union(*groups))

    def thumbnail(name: str) -> tuple[tuple[int, int], np.ndarray] | None:
        with contextlib.suppress(ValueError):  # Damaged pictures are reported when all are read.
            return upright_thumbnail(folder / name, THUMBNAIL)
        return None

    thumbnails = zip(wanted, map_in_threads(thumbnail, wanted), strict=True)
    pictures = {name: picture for name, picture in thumbnails if picture is not None}

    def is_copy(name: str, larger: str) -> bool:
        """Return whether two pictures have the same aspect, up to a pixel of rounding, and show the same."""
        size, grey = pictures[name]
        larger_size, larger_grey = pictures[larger]
        # A side rounded by a pixel changes w·H - h·W by H or W.
        if abs(size[0] * larger_size[1] - size[1] * larger_size[0]) > sum(larger_size):
            return False
        tolerance = EQUAL_TOLERANCE if size == larger_size else SMALLER_TOLERANCE
        return bool(np.abs(grey - larger_grey).mean() <= tolerance)

    copies: set[str] = set()
    for group in groups:
        kept: list[str] = []
        for name in sorted(pictures.keys() & group, key=lambda name: (-math.prod(pictures[name][0]), name)):
            if any(is_copy(name, larger) for larger in kept):
                copies.add(name)
            else:
                kept.append(name)
    return copies


def _patterns(names: Iterable[str]) -> list[str]:
    """Return a pattern for the pictures of each folder and suffix; a single one by its name."""
    groups = defaultdict(list)
    for path in map(PurePosixPath, sorted(names)):
        groups[path.with_name(f"*{path.suffix}")].append(path)
    return [str(group[0] if len(group) == 1 else pattern) for pattern, group in groups.items()]
