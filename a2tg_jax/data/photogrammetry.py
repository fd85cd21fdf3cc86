"""What captures of photogrammetry share: XML, numbers in texts, images by name, and worlds of maps."""

import dataclasses
import re
import warnings
from collections.abc import Iterator
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from a2tg_jax.data.frames import Frames
from a2tg_jax.data.images import check_inside
from a2tg_jax.host.json_text import MOST_BYTES
from a2tg_jax.host.regular_files import is_regular, read_regular
from a2tg_jax.host.text import shortened

Element = ElementTree.Element
SUFFIXES = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".webp", ".heic")
LARGEST_SKEW = 0.5
"""Largest skew in pixels over an image that is taken for none."""
FARTHEST = 1e3
"""Largest distance of the cameras' middle from the origin, in units of their spread, that keeps the origin."""
OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
"""Change of a camera's frame between OpenCV and OpenGL."""
UNDISTORTED = "export undistorted images in COLMAP's format instead"


def near_origin(frames: Frames) -> Frames:
    """Return frames with poses as lists. The origin of a map's world is moved to the cameras, with a warning."""
    poses = np.stack([frame["transform_matrix"] for frame in frames.frames])
    middle = np.rint(np.median(poses[:, :3, 3], axis=0))
    spread = np.linalg.norm(poses[:, :3, 3] - middle, axis=1).max()
    if np.linalg.norm(middle) > FARTHEST * spread > 0:
        poses[:, :3, 3] -= middle
        if frames.cloud is not None:
            frames = frames._replace(cloud=dataclasses.replace(frames.cloud, points=frames.cloud.points - middle))
        told = " ".join(f"{value:.0f}" for value in middle)
        warnings.warn(f"{frames.file}: its world lies far from its origin, which was moved to {told}", stacklevel=2)
    moved = [{**frame, "transform_matrix": pose.tolist()} for frame, pose in zip(frames.frames, poses, strict=True)]
    return frames._replace(frames=moved)


def image_of(folder: Path, label: str) -> str | None:
    """Return the path, below the folder, of the image of a camera's label: a path of any machine, or a name."""
    name = re.split(r"[/\\]", label)[-1]
    check_inside(folder, name)
    for base in (folder / "images", folder):
        found = named_image(base, name)
        if found is not None:
            return found.relative_to(folder).as_posix()
    return None


def named_image(folder: Path, name: str) -> Path | None:
    """Return the image of a name, with or without its suffix, or None."""
    return next((file for file in _candidates(folder, name) if name and is_regular(file)), None)


def _candidates(folder: Path, name: str) -> Iterator[Path]:
    if Path(name).suffix.lower() in SUFFIXES:
        yield folder / name
    for suffix in SUFFIXES:
        yield folder / f"{name}{suffix}"
        yield folder / f"{name}{suffix.upper()}"


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
