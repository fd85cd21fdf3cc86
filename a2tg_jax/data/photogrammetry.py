"""Cameras of programs of photogrammetry: Metashape's cameras.xml, and XMP files of RealityScan (RealityCapture).

Both are read as frames of `transforms.json`. Their camera frames are OpenCV's, and lens distortion is applied to
normalised coordinates, as Brown has it.
"""

import re
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from a2tg_jax.data.decoding import read_pixels
from a2tg_jax.data.images import check_inside
from a2tg_jax.data.transforms import Frames
from a2tg_jax.host.json_text import MOST_BYTES
from a2tg_jax.host.regular_files import is_regular, read_regular
from a2tg_jax.host.text import shortened

Element = ElementTree.Element
XCR = "{http://www.capturingreality.com/ns/xcr/1.1#}"
SUFFIXES = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".webp", ".heic")
FILM_WIDTH = 36.0
"""Width in mm of the film that FocalLength35mm refers to, for the longer side of an image."""
LARGEST_SKEW = 0.5
"""Largest skew in pixels over an image that is taken for none."""
FARTHEST = 1e3
"""Largest distance of the cameras' middle from the origin, in units of their spread, that keeps the origin."""
OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
"""Change of a camera's frame between OpenCV and OpenGL."""


def metashape_file(path: Path) -> Path | None:
    """Return the XML file of Metashape's cameras in a folder, or None."""
    files = [path] if is_regular(path) else sorted(path.glob("*.xml"))
    return next((file for file in files if file.suffix.lower() == ".xml" and b"<sensors" in _head(file)), None)


def metashape_frames(file: Path) -> Frames:
    """Return the frames of Metashape's cameras. A PLY file beside them, if it is the only one, holds their points.

    Component and chunk have a transform to the world, which poses go through; its scale leaves the cameras rigid.

    Raises:
      ValueError: if the file is no such XML, or a lens has a distortion that COLMAP's models do not know.
    """
    root = _xml(file)
    frames = []
    for chunk in root.iter("chunk"):
        sensors = {sensor.get("id"): sensor for sensor in chunk.iter("sensor")}
        worlds = {part.get("id"): _world(part, file) for part in chunk.iter("component")}
        of_chunk = _world(chunk, file)
        for camera in chunk.iter("camera"):
            pose, sensor = camera.find("transform"), sensors.get(camera.get("sensor_id"))
            image = _image_of(file.parent, camera.get("label") or "")
            if pose is None or sensor is None or image is None:
                continue
            world = worlds.get(camera.get("component_id"))
            placed = _placed(of_chunk if world is None else world, _numbers(pose.text, 16, file).reshape(4, 4))
            lens = _metashape_lens(sensor, f"{file}: {camera.get('label')}")
            frames.append({**lens, "file_path": image, "transform_matrix": placed @ OPENGL})
    if not frames:
        raise ValueError(
            f"{file}: none of its cameras has a pose and an image beside it; put the photographs into images/"
        )
    points = sorted(file.parent.glob("*.ply"))
    return _near_origin(Frames(file, frames, points[0].name if len(points) == 1 else None))


def _world(part: Element, file: Path) -> np.ndarray | None:
    """Return the similarity [4, 4] from a component or a chunk to the world, or None."""
    transform = part.find("transform")
    if transform is None or transform.find("rotation") is None:
        return None
    world = np.eye(4)
    scale = transform.findtext("scale")
    world[:3, :3] = _numbers(transform.findtext("rotation"), 9, file).reshape(3, 3)
    world[:3, :3] *= 1.0 if scale is None else _numbers(scale, 1, file)[0]
    if transform.find("translation") is not None:
        world[:3, 3] = _numbers(transform.findtext("translation"), 3, file)
    return world


def _placed(world: np.ndarray | None, pose: np.ndarray) -> np.ndarray:
    """Return a camera's pose [4, 4] in the world, with a rotation of scale 1."""
    if world is None:
        return pose
    placed = world @ pose
    placed[:3, :3] /= np.cbrt(abs(np.linalg.det(world[:3, :3]))) or 1.0
    return placed


def _metashape_lens(sensor: Element, what: str) -> dict[str, Any]:
    """Return the intrinsics of a sensor as `transforms.json` has them. P1 and P2 are OpenCV's p2 and p1."""
    kind = sensor.get("type", "frame")
    calibration = next((part for part in sensor.iter("calibration") if part.find("f") is not None), None)
    if kind != "frame" or calibration is None:
        raise ValueError(f"{what}: is of a sensor of type {shortened(kind)} without a calibration; {UNDISTORTED}")
    size = calibration.find("resolution")
    size = sensor.find("resolution") if size is None else size
    if size is None:
        raise ValueError(f"{what}: its sensor has no resolution; export the cameras again")
    read: Callable[[str], float] = lambda name: _numbers(calibration.findtext(name, "0"), 1, what)[0]  # noqa: E731
    width, height = (_numbers(size.get(side), 1, what)[0] for side in ("width", "height"))
    if read("k4") or abs(read("b2")) * height / max(read("f"), 1.0) > LARGEST_SKEW:
        raise ValueError(f"{what}: its lens has k4 or b2, which are not known here; {UNDISTORTED}")
    return {
        "w": int(width), "h": int(height), "fl_x": read("f") + read("b1"), "fl_y": read("f"),
        "cx": width / 2 + read("cx"), "cy": height / 2 + read("cy"),
        "k1": read("k1"), "k2": read("k2"), "k3": read("k3"), "p1": read("p2"), "p2": read("p1"),
    }  # fmt: skip


UNDISTORTED = "export undistorted images in COLMAP's format instead"


def realityscan_files(path: Path) -> list[Path]:
    """Return XMP files with RealityScan's poses in a folder or its folder images."""
    for folder in (path, path / "images"):
        files = [file for file in sorted(folder.glob("*.xmp")) if b"xcr:Rotation" in read_regular(file, MOST_BYTES)]
        if files:
            return files
    return []


def realityscan_frames(path: Path, files: list[Path]) -> Frames:
    """Return the frames of XMP files, each beside its image.

    Raises:
      ValueError: if a file is no such XMP, or a lens has a distortion that COLMAP's models do not know.
    """
    frames = []
    for file in files:
        image = _named(file.parent, file.stem)
        if image is None:
            continue
        values = _xcr_values(file)
        pose = np.eye(4)
        pose[:3, :3] = _numbers(values.get("Rotation"), 9, file).reshape(3, 3).T
        pose[:3, 3] = _numbers(values.get("Position"), 3, file)
        height, width = read_pixels(image).shape[:2]
        lens = _xcr_lens(values, width, height, file)
        frames.append({**lens, "file_path": image.relative_to(path).as_posix(), "transform_matrix": pose @ OPENGL})
    if not frames:
        raise ValueError(f"{path}: no photograph lies beside an XMP file of its name; put them together")
    return _near_origin(Frames(path / "*.xmp", frames))


def _xcr_values(file: Path) -> dict[str, str]:
    """Return RealityScan's values in an XMP file, which are attributes or elements."""
    values: dict[str, str] = {}
    for element in _xml(file).iter():
        values |= {key.removeprefix(XCR): text for key, text in element.attrib.items() if key.startswith(XCR)}
        if element.tag.startswith(XCR):
            values[element.tag.removeprefix(XCR)] = element.text or ""
    return values


def _xcr_lens(values: dict[str, str], width: int, height: int, file: Path) -> dict[str, Any]:
    """Return the intrinsics of an XMP file; lengths in it are in units of the longer side."""
    read: Callable[[str, str], float] = lambda name, default: _numbers(values.get(name, default), 1, file)[0]  # noqa: E731
    k1, k2, k3, k4, t1, t2 = _numbers(values.get("DistortionCoeficients", "0 0 0 0 0 0"), 6, file)
    model, longer = values.get("DistortionModel", "perspective"), max(width, height)
    has_brown = model.startswith("brown") or not any((k1, k2, k3))
    if k4 or t1 or t2 or not has_brown or abs(read("Skew", "0")) * longer > LARGEST_SKEW:
        raise ValueError(
            f"{file}: has the distortion model {shortened(model)} with skew, k4, t1 or t2, which are not known here; "
            f"align with Brown3, or {UNDISTORTED}"
        )
    focal = read("FocalLength35mm", "0") / FILM_WIDTH * longer
    return {
        "w": width, "h": height, "fl_x": focal, "fl_y": focal * read("AspectRatio", "1"),
        "cx": width / 2 + longer * read("PrincipalPointU", "0"), "cy": height / 2 + longer * read("PrincipalPointV", "0"),
        "k1": k1, "k2": k2, "k3": k3,
    }  # fmt: skip


def _near_origin(frames: Frames) -> Frames:
    """Return frames with poses as lists. If the world is a map's, its origin is moved to the cameras, with a warning."""
    poses = np.stack([frame["transform_matrix"] for frame in frames.frames])
    middle = np.rint(np.median(poses[:, :3, 3], axis=0))
    spread = np.linalg.norm(poses[:, :3, 3] - middle, axis=1).max()
    if np.linalg.norm(middle) > FARTHEST * spread > 0 and frames.points is None:
        poses[:, :3, 3] -= middle
        told = " ".join(f"{value:.0f}" for value in middle)
        warnings.warn(f"{frames.file}: its world lies far from its origin, which was moved to {told}", stacklevel=2)
    moved = [{**frame, "transform_matrix": pose.tolist()} for frame, pose in zip(frames.frames, poses, strict=True)]
    return frames._replace(frames=moved)


def _image_of(folder: Path, label: str) -> str | None:
    """Return the path, below the folder, of the image of a camera's label: a path of any machine, or a name."""
    name = re.split(r"[/\\]", label)[-1]
    check_inside(folder, name)
    for base in (folder / "images", folder):
        found = _named(base, name)
        if found is not None:
            return found.relative_to(folder).as_posix()
    return None


def _named(folder: Path, name: str) -> Path | None:
    """Return the image of a name, with or without its suffix, or None."""
    return next((file for file in _candidates(folder, name) if name and is_regular(file)), None)


def _candidates(folder: Path, name: str) -> Iterator[Path]:
    if Path(name).suffix.lower() in SUFFIXES:
        yield folder / name
    for suffix in SUFFIXES:
        yield folder / f"{name}{suffix}"
        yield folder / f"{name}{suffix.upper()}"


def _head(file: Path) -> bytes:
    with open(file, "rb") as opened:
        return opened.read(1 << 16)


def _xml(file: Path) -> Element:
    """Return the root of an XML file. Declarations of entities, which can grow without end, are refused."""
    data = read_regular(file, MOST_BYTES)
    try:
        if b"<!ENTITY" in data or b"<!DOCTYPE" in data:
            raise ValueError("it declares entities")
        return ElementTree.fromstring(data)
    except (ElementTree.ParseError, ValueError, LookupError) as error:
        raise ValueError(f"{file}: cannot be read as XML ({shortened(str(error))}); export it again") from None


def _numbers(text: str | None, count: int, what: object) -> np.ndarray:
    """Return the numbers in a text, or raise ValueError unless there are so many and all are finite."""
    try:
        numbers = np.array([float(word) for word in (text or "").split()])
    except ValueError:
        numbers = np.empty(0)
    if len(numbers) != count or not np.isfinite(numbers).all():
        raise ValueError(f"{what}: {count} numbers are expected; got {shortened(text or 'none')}")
    return numbers
