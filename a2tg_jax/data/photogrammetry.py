"""Parts that readers of photogrammetry programs share: XML, numbers in texts, images by name, and worlds of maps."""

import re
import warnings
from collections import defaultdict
from collections.abc import Mapping
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from a2tg_jax.data.assembly import PointCloud
from a2tg_jax.data.frames import Frames
from a2tg_jax.data.images import PHOTO_SUFFIXES, inside, named_image
from a2tg_jax.data.ply_points import read_ply_points
from a2tg_jax.host.json_text import MOST_BYTES
from a2tg_jax.host.regular_files import is_regular, read_regular
from a2tg_jax.host.text import shortened

Element = ElementTree.Element
LARGEST_SKEW = 0.5
"""Largest skew, in pixels over an image, that is ignored."""
FARTHEST_POINTS = 100.0
"""Largest distance of the points' median from the cameras' middle, in units of the cameras' spread."""
OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
"""Change of a camera's frame between OpenCV and OpenGL."""
UNDISTORTED = "export undistorted images in COLMAP's format instead"


def with_near_points(frames: Frames) -> Frames:
    """Return frames with poses as lists. Points far from the cameras are left out, with a warning."""
    poses = np.stack([frame["transform_matrix"] for frame in frames.frames])
    middle = np.median(poses[:, :3, 3], axis=0)
    spread = np.linalg.norm(poses[:, :3, 3] - middle, axis=1).max()
    if frames.cloud is not None and not _are_near(frames.cloud.points, middle, FARTHEST_POINTS * spread):
        warnings.warn(
            f"{frames.file}: the points beside it lie far from its cameras, in another coordinate system: not used",
            stacklevel=2,
        )
        frames = frames._replace(cloud=None)
    listed = [{**frame, "transform_matrix": pose.tolist()} for frame, pose in zip(frames.frames, poses, strict=True)]
    return frames._replace(frames=listed)


def points_beside(file: Path) -> PointCloud | None:
    """Return the points of the only PLY file in the folder of a file; None, with a warning, of several."""
    points = sorted(file.parent.glob("*.ply"))
    if len(points) > 1:
        names = ", ".join(point.name for point in points)
        warnings.warn(f"{file}: {len(points)} PLY files are beside it, {shortened(names)}: none used", stacklevel=3)
    return read_ply_points(points[0]) if len(points) == 1 else None


def _are_near(points: np.ndarray, middle: np.ndarray, farthest: float) -> bool:
    """Return whether the median of points [P, 3] is near a place, or cannot be told."""
    finite = points[np.isfinite(points).all(axis=-1)]
    return not len(finite) or not farthest or bool(np.linalg.norm(np.median(finite, axis=0) - middle) <= farthest)


def images_below(folder: Path) -> dict[str, Path]:
    """Return the images in all folders below a folder, by name and by name without suffix, as far as that is unique."""
    found: dict[str, set[Path]] = defaultdict(set)
    for file in folder.rglob("*"):
        if file.suffix.lower() in PHOTO_SUFFIXES and is_regular(file):
            found[file.name].add(file)
            found[file.stem].add(file)
    return {name: next(iter(files)) for name, files in found.items() if len(files) == 1}


def image_of(folder: Path, label: str, below: Mapping[str, Path]) -> str | None:
    """Return the path, from the folder, of the image of a camera's label: a path of any machine, or a name.

    It is looked for in `images`, in the folder itself, and then among the images `below`.
    """
    name = re.split(r"[/\\]", label)[-1]
    inside(folder, name)
    found = named_image(folder / "images", name) or named_image(folder, name) or below.get(name)
    return None if found is None else found.relative_to(folder).as_posix()


def read_xml(file: Path) -> Element:
    """Return the root of an XML file. Declarations of entities, which can grow without end, are refused."""
    data = read_regular(file, MOST_BYTES)
    try:
        if b"<!ENTITY" in data or b"<!DOCTYPE" in data:
            raise ValueError("it declares entities")
        return ElementTree.fromstring(data)
    except (ElementTree.ParseError, ValueError, LookupError) as error:
        raise ValueError(f"{file}: cannot be read as XML ({shortened(str(error))}); export it again") from None


def numbers_in(text: str | None, count: int, what: object) -> np.ndarray:
    """Return the numbers in a text, or raise ValueError unless there are so many and all are finite."""
    try:
        numbers = np.array([float(word) for word in (text or "").split()])
    except ValueError:
        numbers = np.empty(0)
    if len(numbers) != count or not np.isfinite(numbers).all():
        raise ValueError(f"{what}: {count} numbers are expected; got {shortened(text or 'none')}")
    return numbers
