"""Cameras of Metashape: the XML file of File > Export > Export Cameras, read as frames of `transforms.json`.

Lenses are those of the manual's appendix on camera models: a projection onto the plane z = 1 (frame), or onto radii
θ (equidistant fisheye) or 2·sin(θ/2) (equisolid fisheye) for a ray at the angle θ, then Brown's distortion.
"""

import warnings
from pathlib import Path
from typing import Any

import numpy as np

from a2tg_jax.data.assembly import rigid_viewmat
from a2tg_jax.data.frames import Frames, warn_of_missing_images
from a2tg_jax.data.photogrammetry import (
    LARGEST_SKEW,
    OPENGL,
    UNDISTORTED,
    Element,
    image_of,
    images_below,
    numbers_in,
    points_beside,
    read_xml,
    with_near_points,
)
from a2tg_jax.host.regular_files import is_regular, open_regular
from a2tg_jax.host.text import shortened

SWITCHED_OFF = ("0", "false")
"""Values of a camera's attribute enabled that leave it out."""
HIGHER_TERMS = {"frame": ("k4", "p3", "p4"), "equidistant": ("p3", "p4"), "equisolid": ("p1", "p2", "p3", "p4")}
"""Coefficients of distortion that COLMAP's models do not have, by projection."""
PROJECTIONS = {
    "frame": "frame", "fisheye": "equidistant", "equidistant_fisheye": "equidistant", "equisolid_fisheye": "equisolid",
}  # fmt: skip
"""Projections that are read, by the type of a sensor."""
LARGEST_MISFIT = 0.05
"""Largest difference in pixels between an equisolid fisheye and the polynomial that stands for it."""
NUM_ANGLES = 200
"""Number of angles at which they are compared."""
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
    return with_near_points(Frames(file, frames, points_beside(file)))


def _posed_cameras(file: Path) -> list[tuple[str, Element, np.ndarray]]:
    """Return label, sensor and pose [4, 4] in the world of each camera that has a pose and is switched on.

    A camera without a pose of its own in a rig has the pose of its master and the offset of its sensor. Warnings count
    those, and cameras that are not used.
    """
    found: list[tuple[str, Element, np.ndarray]] = []
    unused, in_rigs = [], []
    for chunk in read_xml(file).iter("chunk"):
        sensors = {sensor.get("id"): sensor for sensor in chunk.iter("sensor")}
        worlds = {part.get("id"): _world(part, file) for part in chunk.iter("component")}
        of_chunk = _world(chunk, file)
        cameras = {camera.get("id"): camera for camera in chunk.iter("camera")}
        for camera in chunk.iter("camera"):
            label, sensor, posed = camera.get("label") or "", sensors.get(camera.get("sensor_id")), camera
            offset: np.ndarray | None = np.eye(4)
            if sensor is not None and camera.find("transform") is None and camera.get("master_id") in cameras:
                posed = cameras[camera.get("master_id")]
                offset = _offset(sensor, sensors.get(posed.get("sensor_id")), file)
            pose = posed.find("transform")
            if sensor is None or pose is None or offset is None or camera.get("enabled") in SWITCHED_OFF:
                unused.append(label)
                continue
            if posed is not camera:
                in_rigs.append(label)
            world = worlds.get(posed.get("component_id"))
            own = numbers_in(pose.text, 16, file).reshape(4, 4) @ offset
            found.append((label, sensor, _placed(of_chunk if world is None else world, own)))
    for labels, told in (
        (
            in_rigs,
            "have no own pose, such as {}: placed by their sensors' offsets from the master, in units of its pose",
        ),
        (unused, "have no pose or are switched off, such as {}: not used"),
    ):
        if labels:
            count = f"{file}: {len(labels)} of {len(found) + len(unused)} cameras"
            warnings.warn(f"{count} {told.format(shortened(labels[0]))}", stacklevel=3)
    return found


def _offset(sensor: Element, master: Element | None, file: Path) -> np.ndarray | None:
    """Return the rigid motion [4, 4] from a sensor of a rig to the sensor of its master camera; None if the file has
    neither's place in the rig. A sensor without a place is the origin of the rig."""
    from_sensor, from_master = (None if part is None else _in_rig(part, file) for part in (sensor, master))
    if from_sensor is None and (from_master is None or sensor.get("master_id") is not None):
        return None
    offset: np.ndarray = np.linalg.inv(np.eye(4) if from_master is None else from_master)
    return offset if from_sensor is None else offset @ from_sensor


def _in_rig(sensor: Element, file: Path) -> np.ndarray | None:
    """Return the rigid motion [4, 4] from a sensor's frame to its rig's; None without one."""
    rotation, translation = sensor.find("rotation"), sensor.find("translation")
    if rotation is None and translation is None:
        return None
    motion = np.eye(4)
    if rotation is not None:
        motion[:3, :3] = numbers_in(rotation.text, 9, file).reshape(3, 3)
    if translation is not None:
        motion[:3, 3] = numbers_in(translation.text, 3, file)
    return rigid_viewmat(motion, f"{file}: sensor {sensor.get('id')}")


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
    projection = PROJECTIONS.get(kind)
    if projection is None:
        advice = "cut panoramas into views with a2tg sfm" if kind == "spherical" else UNDISTORTED
        raise ValueError(f"{what}: is of a sensor of type {shortened(kind)}, which is not read; {advice}")
    with_focal = [part for part in sensor.iter("calibration") if part.find("f") is not None]
    calibration = min(with_focal, key=lambda part: part.get("class") != "adjusted", default=None)
    if calibration is None:
        raise ValueError(f"{what}: is of a sensor without a calibration; {UNDISTORTED}")
    size = calibration.find("resolution")
    size = sensor.find("resolution") if size is None else size
    if size is None:
        raise ValueError(f"{what}: its sensor has no resolution; export the cameras again")
    width, height = (float(numbers_in(size.get(side), 1, what)[0]) for side in ("width", "height"))

    def read(name: str) -> float:
        return float(numbers_in(calibration.findtext(name, "0"), 1, what)[0])

    higher = HIGHER_TERMS[projection]
    if any(map(read, higher)) or abs(read("b2")) * height / max(read("f"), 1.0) > LARGEST_SKEW:
        told = ", ".join(higher)
        raise ValueError(f"{what}: its {projection} lens has {told} or b2, which are not known here; {UNDISTORTED}")
    lens: dict[str, Any] = {
        "w": int(width), "h": int(height), "fl_x": read("f") + read("b1"), "fl_y": read("f"),
        "cx": width / 2 + read("cx"), "cy": height / 2 + read("cy"),
        "k1": read("k1"), "k2": read("k2"), "k3": read("k3"), "p1": read("p2"), "p2": read("p1"),
    }  # fmt: skip
    if projection == "frame":
        return lens
    lens |= {"camera_model": "THIN_PRISM_FISHEYE", "k4": read("k4")}
    return lens | (_equidistant_terms(lens, what) if projection == "equisolid" else {})


def _equidistant_terms(lens: dict[str, Any], what: str) -> dict[str, float]:
    """Return k1 to k4 of the equidistant fisheye nearest to an equisolid one with its own k1 to k4.

    Raises:
      ValueError: if they differ by more than `LARGEST_MISFIT`.
    """
    farthest = np.hypot(max(lens["cx"], lens["w"] - lens["cx"]), max(lens["cy"], lens["h"] - lens["cy"]))
    widest = min(2 * np.arcsin(min(farthest / max(lens["fl_y"], 1.0) / 2, 1.0)), np.pi / 2)
    angles = np.linspace(0, widest, NUM_ANGLES + 1)[1:]
    radii = 2 * np.sin(angles / 2)
    distorted = radii * (1 + sum(lens[f"k{power}"] * radii ** (2 * power) for power in range(1, 5)))
    powers = angles[:, None] ** (2 * np.arange(1, 5))
    terms, *_ = np.linalg.lstsq(angles[:, None] * powers, distorted - angles, rcond=None)
    misfit = lens["fl_y"] * np.abs(angles * (1 + powers @ terms) - distorted).max()
    if not misfit <= LARGEST_MISFIT:  # Also for NaN.
        raise ValueError(f"{what}: its equisolid lens is {misfit:.2g} pixels off COLMAP's fisheyes; {UNDISTORTED}")
    return {f"k{power}": float(term) for power, term in enumerate(terms, 1)}


def _head(file: Path) -> bytes:
    with open_regular(file) as opened:
        return opened.read(HEAD_BYTES)
