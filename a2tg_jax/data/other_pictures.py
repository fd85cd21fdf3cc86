"""Pictures in a folder of photographs that are none: masks, depth maps, copies, and what this program wrote.

Taken for photographs they would give a test view a twin among the training views, or a pose of their own.
"""

import math
import re
from collections import defaultdict
from collections.abc import Iterable, Sequence
from pathlib import Path, PurePosixPath
from typing import NamedTuple

import numpy as np

from a2tg_jax.data.decoding import upright_thumbnail
from a2tg_jax.data.images import PHOTO_SUFFIXES, map_in_threads
from a2tg_jax.host.regular_files import is_regular, read_regular
from a2tg_jax.host.text import first_names

CAMERA_PICTURE = "cameras.png"
"""Picture of the cameras that `a2tg sfm` puts beside `sparse`."""
LISTS = (".a2tg-run", ".a2tg-frames")
"""Lists of what runs and renders wrote into a folder, a name a line, after its checksum if it has one."""
MOST_LIST_BYTES = 1 << 26
NOT_PHOTOGRAPHS = re.compile(
    r"(?<![a-z])(mask(?!ed)[a-z]*|(mattes?|segmentations?|depths?|depthmaps?|normals|confidences?)(?![a-z]))",
    re.IGNORECASE,
)
"""Words in names of folders, and in names of files around the name of a photograph."""
THUMBNAIL = 32
SMALLER_TOLERANCE, EQUAL_TOLERANCE = 2.0, 0.5
"""Largest mean difference in grey levels of thumbnails between a photograph and its copy, smaller or of its size.

Copies at 1/4 differ by up to 1.2, and neighbouring frames of six captures by at least 2.4.
"""


class _Candidate(NamedTuple):
    """A picture that shares its name with others."""

    name: str
    size: tuple[int, int]
    grey: np.ndarray
    """[THUMBNAIL, THUMBNAIL] grey levels."""


def other_pictures(folder: Path, names: Sequence[str]) -> tuple[set[str], str]:
    """Find pictures that are not photographs of a capture.

    Args:
      folder: the capture. Names of folders count below it only.
      names: paths of all pictures below it, sorted.

    Returns:
      (those to leave out, line that counts them and says how to use them).

    Raises:
      ValueError: naming a picture that cannot be read, if others have its name.
    """
    kinds = {
        "written by a2tg": _written(folder, names),
        "in hidden folders": {name for name in names if any(part[0] in ".@" for part in name.split("/")[:-1])},
        "masks or depth maps": _masks(names),
    }
    others = set().union(*kinds.values())
    kinds["copies of others"] = _copies(folder, [name for name in names if name not in others])
    told = [f"{kind}: {len(found)} ({first_names(_patterns(found))})" for kind, found in kinds.items() if found]
    line = f"Not taken for photographs: {'; '.join(told)}. To use some, give a folder of these only"
    return others | kinds["copies of others"], line


def _written(folder: Path, names: Sequence[str]) -> set[str]:
    """Return the pictures that `a2tg` wrote."""
    cameras = (name for name in names if PurePosixPath(name).name == CAMERA_PICTURE)
    found = {name for name in cameras if (folder / name).with_name("sparse").is_dir()}
    for file in folder.rglob(".a2tg-*"):
        if file.name in LISTS and is_regular(file):
            place = PurePosixPath(file.parent.relative_to(folder).as_posix())
            lines = read_regular(file, MOST_LIST_BYTES).decode(errors="replace").splitlines()
            found |= {str(place / line.rpartition("  ")[2]) for line in lines}.intersection(names)
    return found


def _masks(names: Sequence[str]) -> set[str]:
    """Return the pictures in folders of masks and the like, and those named so beside a photograph."""
    pictures = set(names)
    known = pictures | {str(PurePosixPath(name).with_suffix("")) for name in names}
    found = set()
    for path in map(PurePosixPath, names):
        word = NOT_PHOTOGRAPHS.search(path.stem)
        parts = () if word is None else (path.stem[: word.start()], path.stem[word.end() :])
        rest = [part.strip("_-. ") for part in parts]
        if (
            any(map(NOT_PHOTOGRAPHS.search, path.parts[:-1]))
            or any(name and str(path.with_name(name)) in known for name in rest)  # 0_mask.png beside 0.jpg
            or (path.suffix.lower() == ".png" and str(path.with_suffix("")) in pictures)  # 0.jpg.png beside 0.jpg
        ):
            found.add(str(path))
    return found


def _copies(folder: Path, names: Sequence[str]) -> set[str]:
    """Return the pictures that show the same as a larger or earlier one of the same name, in this or another folder."""
    same_name = defaultdict(list)
    for name in names:
        path = PurePosixPath(name)
        while path.suffix.lower() in PHOTO_SUFFIXES:  # 0.heic.jpg is a copy of 0.heic.
            path = path.with_suffix("")
        for key in {path.parts, *(path.parts[:at] + path.parts[at + 1 :] for at in range(len(path.parts) - 1))}:
            same_name[key].append(name)
    groups = [group for group in same_name.values() if len(group) > 1]
    wanted = sorted(set().union(*groups))
    candidates = dict(zip(wanted, map_in_threads(lambda name: _candidate(folder, name), wanted), strict=True))
    found: set[str] = set()
    for group in groups:
        kept: list[_Candidate] = []
        for one in sorted((candidates[name] for name in group), key=lambda one: (-math.prod(one.size), one.name)):
            if any(_is_copy(one, larger) for larger in kept):
                found.add(one.name)
            else:
                kept.append(one)
    return found


def _candidate(folder: Path, name: str) -> _Candidate:
    return _Candidate(name, *upright_thumbnail(folder / name, THUMBNAIL))


def _is_copy(one: _Candidate, larger: _Candidate) -> bool:
    """Return whether two pictures have the same aspect, up to a pixel of rounding, and show the same."""
    (width, height), (larger_width, larger_height) = one.size, larger.size
    if abs(width * larger_height - height * larger_width) > larger_width + larger_height:
        return False
    tolerance = EQUAL_TOLERANCE if one.size == larger.size else SMALLER_TOLERANCE
    return bool(np.abs(one.grey - larger.grey).mean() <= tolerance)


def _patterns(names: Iterable[str]) -> list[str]:
    """Return a pattern for the pictures of each folder and suffix; a single one by its name."""
    groups = defaultdict(list)
    for path in map(PurePosixPath, sorted(names)):
        groups[path.with_name(f"*{path.suffix}")].append(path)
    return [str(group[0] if len(group) == 1 else pattern) for pattern, group in groups.items()]
