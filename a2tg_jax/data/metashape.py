"""Cameras of Metashape: the XML file of File > Export > Export Cameras, read as frames of `transforms.json`."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from a2tg_jax.data.frames import Frames, warn_of_missing_images
from a2tg_jax.data.photogrammetry import (
    LARGEST_SKEW,
    OPENGL,
    UNDISTORTED,
    Element,
    image_of,
    images_below,
    numbers_in,
    read_xml,
    with_near_points,
)
from a2tg_jax.data.ply_points import read_ply_points
from a2tg_jax.host.regular_files import is_regular, open_regular
from a2tg_jax.host.text import shortened

SWITCHED_OFF = ("0", "false")
"""Values of a camera's attribute enabled that leave it out."""
HIGHER_TERMS = ("k4", "p3", "p4")
"""Coefficients of distortion that COLMAP's models do not have."""
HEAD_BYTES = 1 << 16
"""Number of bytes of an XML file in which a chunk's sensors are looked for."""


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
    frames, lacking = [], []
    below = images_below(file.parent / "images")
    for label, sensor, pose in _posed_cameras(file):
        image = image_of(file.parent, label, below)
        if image is None:
            lacking.append(label)
            continue
        lens = _metashape_lens(sensor, f"{file}: {label}")
        frames.append({**lens, "file_path": image, "transform_matrix": pose @ OPENGL})
    if not frames:
        raise ValueError(
            f"{file}: none of its cameras has a pose and an image beside it; put the photographs into images/"
        )
    warn_of_missing_images(file, lacking, len(frames) + len(lacking))
    points = sorted(file.parent.glob("*.ply"))
    return with_near_points(Frames(file, frames, read_ply_points(points[0]) if len(points) == 1 else None))


def _posed_cameras(file: Path) -> Iterator[tuple[str, Element, np.ndarray]]:
    """Yield label, sensor and pose [4, 4] in the world of each camera that has a pose and is switched on."""
    for chunk in read_xml(file).iter("chunk"):
        sensors = {sensor.get("id"): sensor for sensor in chunk.iter("sensor")}
        worlds = {part.get("id"): _world(part, file) for part in chunk.iter("component")}
        of_chunk = _world(chunk, file)
        for camera in chunk.iter("camera"):
            pose, sensor = camera.find("transform"), sensors.get(camera.get("sensor_id"))
            if pose is None or sensor is None or camera.get("enabled") in SWITCHED_OFF:
                continue
            world = worlds.get(camera.get("component_id"))
            placed = _placed(of_chunk if world is None else world, numbers_in(pose.text, 16, file).reshape(4, 4))
            yield camera.get("label") or "", sensor, placed


def _world(part: Element, file: Path) -> np.ndarray | None:
    """Return the similarity [4, 4] from a component or a chunk to the world, or None."""
    transform = part.find("transform")
    if transform is None or transform.find("rotation") is None:
        return None
    world = np.eye(4)
    scale = transform.findtext("scale")
    world[:3, :3] = numbers_in(transform.findtext("rotation"), 9, file).reshape(3, 3)
    world[:3, :3] *= 1.0 if scale is None else numbers_in(scale, 1, file)[0]
    if transform.find("translation") is not None:
        world[:3, 3] = numbers_in(transform.findtext("translation"), 3, file)
    return world


def _placed(world: np.ndarray | None, pose: np.ndarray) -> np.ndarray:
    """Return a camera's pose [4, 4] in the world, with a rotation of scale 1."""
    if world is None:
        return pose
    placed: np.ndarray = world @ pose
    placed[:3, :3] /= np.cbrt(abs(np.linalg.det(world[:3, :3]))) or 1.0
    return placed


def _metashape_lens(sensor: Element, what: str) -> dict[str, Any]:
    """Return the adjusted intrinsics of a sensor as `transforms.json` has them. P1 and P2 are OpenCV's p2 and p1."""
    kind = sensor.get("type", "frame")
    with_focal = [part for part in sensor.iter("calibration") if part.find("f") is not None]
    calibration = min(with_focal, key=lambda part: part.get("class") != "adjusted", default=None)
    if kind != "frame" or calibration is None:
        raise ValueError(f"{what}: is of a sensor of type {shortened(kind)} without a calibration; {UNDISTORTED}")
    size = calibration.find("resolution")
    size = sensor.find("resolution") if size is None else size
    if size is None:
        raise ValueError(f"{what}: its sensor has no resolution; export the cameras again")
    width, height = (float(numbers_in(size.get(side), 1, what)[0]) for side in ("width", "height"))

    def read(name: str) -> float:
        return float(numbers_in(calibration.findtext(name, "0"), 1, what)[0])

    if any(map(read, HIGHER_TERMS)) or abs(read("b2")) * height / max(read("f"), 1.0) > LARGEST_SKEW:
        raise ValueError(f"{what}: its lens has k4, p3, p4 or b2, which are not known here; {UNDISTORTED}")
    return {
        "w": int(width), "h": int(height), "fl_x": read("f") + read("b1"), "fl_y": read("f"),
        "cx": width / 2 + read("cx"), "cy": height / 2 + read("cy"),
        "k1": read("k1"), "k2": read("k2"), "k3": read("k3"), "p1": read("p2"), "p2": read("p1"),
    }  # fmt: skip


def _head(file: Path) -> bytes:
    with open_regular(file) as opened:
        return opened.read(HEAD_BYTES)
