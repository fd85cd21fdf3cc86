"""Cameras of photogrammetry programs, read as frames of `transforms.json`.

Metashape writes one XML file (File > Export > Export Cameras). Its lenses follow the manual's appendix on camera
models: a projection onto the plane z = 1 (frame), or onto radii θ (equidistant fisheye) or 2·sin(θ/2) (equisolid
fisheye) for a ray at the angle θ, then Brown's distortion. RealityScan (RealityCapture) writes an XMP file next to
each photograph.
"""

import functools
import re
import warnings
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from a2tg_jax.data.assembly import PointCloud, rigid_motion
from a2tg_jax.data.decoding import picture_size
from a2tg_jax.data.image_files import PHOTO_SUFFIXES, find_image, warn_of_unposed
from a2tg_jax.data.ply import read_ply_points
from a2tg_jax.data.transforms import Frames, check_images, reading_one
from a2tg_jax.host.json_text import MOST_BYTES
from a2tg_jax.host.regular_files import is_regular, names_in, open_regular, read_regular
from a2tg_jax.host.text import shortened

Element = ElementTree.Element
LARGEST_SKEW = 0.5
"""Largest skew, in pixels over an image, that is ignored."""
FARTHEST_POINTS = 100.0
"""Largest distance of the points' median from the cameras' middle, in units of the cameras' spread."""
OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
"""Change of a camera's frame between OpenCV and OpenGL."""
UNDISTORTED = "export undistorted images in COLMAP's format instead"
METASHAPE_FILE = "cameras.xml"
SWITCHED_OFF = ("0", "false")
"""Values of a camera's attribute enabled that leave it out."""
HIGHER_TERMS = {"frame": ("k4", "p3", "p4"), "equidistant": ("p3", "p4"), "equisolid": ("p1", "p2", "p3", "p4")}
"""Coefficients of distortion that COLMAP's models do not have, by projection."""
PROJECTIONS = {
    "frame": "frame", "fisheye": "equidistant", "equidistant_fisheye": "equidistant", "equisolid_fisheye": "equisolid",
}  # fmt: skip
"""Projections that are read, by the type of a sensor."""
LARGEST_MISFIT = 0.05
"""Largest difference in pixels between an equisolid fisheye and its polynomial approximation."""
NUM_ANGLES = 200
"""Number of angles at which they are compared."""
HEAD_BYTES = 1 << 16
"""Number of bytes of an XML file that are searched for a chunk's sensors."""
XCR = "{http://www.capturingreality.com/ns/xcr/1.1#}"
FILM_WIDTH = 36.0
"""Width in mm of the film that FocalLength35mm refers to, for the longer side of an image."""


def metashape(path: Path) -> Callable[[], Frames] | None:
    """Return the function that reads Metashape's cameras, an XML file or one in a folder; None if there is none.

    Of several in a folder, cameras.xml is read, or else the first by name, with a warning.
    """
    files = []
    for file in [path] if is_regular(path) else [path / name for name in names_in(path)]:
        if file.suffix.lower() == ".xml" and is_regular(file):
            with open_regular(file) as opened:
                if b"<sensors" in opened.read(HEAD_BYTES):
                    files.append(file)
    if not files:
        return None
    chosen = next((file for file in files if file.name.lower() == METASHAPE_FILE), files[0])
    return reading_one(chosen, files, functools.partial(_metashape_frames, chosen))


def _metashape_frames(file: Path) -> Frames:
    """Return the frames of Metashape's cameras. A PLY file next to them, if it is the only one, has their points."""
    frames, lacking = [], []
    folder, images = file.parent, file.parent / "images"
    below: dict[str, set[Path]] = defaultdict(set)  # Images in all folders below, with and without suffix.
    for image in images.rglob("*"):
        if image.suffix.lower() in PHOTO_SUFFIXES and is_regular(image):
            below[image.name].add(image)
            below[image.stem].add(image)
    for label, sensor, pose in _posed_cameras(file):
        name = re.split(r"[/\\]", label)[-1]  # A label is a path of any machine, or a name.
        unique = next(iter(below[name])) if len(below[name]) == 1 else None
        found = find_image(images, name) or find_image(folder, name) or unique
        if found is None:
            lacking.append(label)
            continue
        lens, path = _metashape_lens(sensor, f"{file}: {label}"), found.relative_to(folder).as_posix()
        frames.append({**lens, "file_path": path, "transform_matrix": pose @ OPENGL})
    nothing = f"{file}: none of its cameras has a pose and an image beside it; put the photographs into images/"
    check_images(file, frames, lacking, nothing)
    return _with_points(file, frames)


def _posed_cameras(file: Path) -> list[tuple[str, Element, np.ndarray]]:
    """Return label, sensor and pose [4, 4] in the world of each camera that has a pose and is switched on.

    A camera without a pose in a rig has the pose of its master and the offset of its sensor. Warnings count
    those, and cameras that are not used.
    """
    found: list[tuple[str, Element, np.ndarray]] = []
    unused, in_rigs = [], []
    for chunk in _read_xml(file).iter("chunk"):
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
            own = _numbers_in(pose.text, 16, file).reshape(4, 4) @ offset
            world = of_chunk if world is None else world
            if world is not None:
                own = world @ own
                # s·R has the determinant s³; poses are rigid. rigid_motion reports a scale of 0.
                own[:3, :3] /= np.cbrt(abs(np.linalg.det(world[:3, :3]))) or 1.0
            found.append((label, sensor, own))
    by_offset = "have no own pose, such as {}: placed by their sensors' offsets from the master, in units of its pose"
    for labels, text in ((in_rigs, by_offset), (unused, "have no pose or are switched off, such as {}: not used")):
        if labels:
            count = f"{file}: {len(labels)} of {len(found) + len(unused)} cameras"
            warnings.warn(f"{count} {text.format(shortened(labels[0]))}", stacklevel=3)
    return found


def _offset(sensor: Element, master: Element | None, file: Path) -> np.ndarray | None:
    """Return the rigid motion [4, 4] from a sensor of a rig to the sensor of its master camera; None if the file has
    neither's place in the rig. A sensor without a place is the origin of the rig."""

    def in_rig(part: Element) -> np.ndarray | None:
        """Return the rigid motion [4, 4] from a sensor's frame to its rig's; None if it has none."""
        if part.find("rotation") is None and part.find("translation") is None:
            return None
        return rigid_motion(_motion(part, file), f"{file}: sensor {part.get('id')}")

    from_sensor, from_master = (None if part is None else in_rig(part) for part in (sensor, master))
    if from_sensor is None and (from_master is None or sensor.get("master_id") is not None):
        return None
    offset: np.ndarray = np.linalg.inv(np.eye(4) if from_master is None else from_master)
    return offset if from_sensor is None else offset @ from_sensor  # From sensor to rig to master.


def _world(part: Element, file: Path) -> np.ndarray | None:
    """Return the similarity [4, 4] from a component or a chunk to the world, or None."""
    transform = part.find("transform")
    if transform is None or transform.find("rotation") is None:
        return None
    world, scale = _motion(transform, file), transform.findtext("scale")
    world[:3, :3] *= 1.0 if scale is None else _numbers_in(scale, 1, file)[0]
    return world


def _motion(part: Element, file: Path) -> np.ndarray:
    """Return [4, 4] of the rotation and the translation in an element, if they are there."""
    motion = np.eye(4)
    if part.find("rotation") is not None:
        motion[:3, :3] = _numbers_in(part.findtext("rotation"), 9, file).reshape(3, 3)
    if part.find("translation") is not None:
        motion[:3, 3] = _numbers_in(part.findtext("translation"), 3, file)
    return motion


def _metashape_lens(sensor: Element, what: str) -> dict[str, Any]:
    """Return the adjusted intrinsics of a sensor as in `transforms.json`. P1 and P2 are OpenCV's p2 and p1."""
    kind = sensor.get("type", "frame")
    projection = PROJECTIONS.get(kind)
    if projection is None:
        advice = "cut panoramas into views with a2tg sfm" if kind == "spherical" else UNDISTORTED
        raise ValueError(f"{what}: is of a sensor of type {shortened(kind)}, which is not read; {advice}")
    with_focal = [part for part in sensor.iter("calibration") if part.find("f") is not None]
    # A sensor may have its initial calibration as well; poses belong to the adjusted one.
    calibration = min(with_focal, key=lambda part: part.get("class") != "adjusted", default=None)
    if calibration is None:
        raise ValueError(f"{what}: is of a sensor without a calibration; {UNDISTORTED}")
    size = calibration.find("resolution")
    size = sensor.find("resolution") if size is None else size
    if size is None:
        raise ValueError(f"{what}: its sensor has no resolution; export the cameras again")
    width, height = (float(_numbers_in(size.get(side), 1, what)[0]) for side in ("width", "height"))

    def read(name: str) -> float:
        return float(_numbers_in(calibration.findtext(name, "0"), 1, what)[0])

    higher = HIGHER_TERMS[projection]
    # Skew is b2·y, where y goes up to height / f.
    if any(map(read, higher)) or abs(read("b2")) * height / max(read("f"), 1.0) > LARGEST_SKEW:
        names = ", ".join(higher)
        raise ValueError(f"{what}: its {projection} lens has {names} or b2, which are not supported; {UNDISTORTED}")
    # Metashape's manual: u = w/2 + cx + x·(f + b1) + y·b2, v = h/2 + cy + y·f.
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
    """Return k1 to k4 of the equidistant fisheye nearest to an equisolid one with its own k1 to k4, up to
    `LARGEST_MISFIT`."""
    farthest = np.hypot(max(lens["cx"], lens["w"] - lens["cx"]), max(lens["cy"], lens["h"] - lens["cy"]))
    # Inverse of r = 2·sin(θ/2) at the farthest corner.
    widest = min(2 * np.arcsin(min(farthest / max(lens["fl_y"], 1.0) / 2, 1.0)), np.pi / 2)
    angles = np.linspace(0, widest, NUM_ANGLES + 1)[1:]  # At 0 both radii are 0.
    radii = 2 * np.sin(angles / 2)
    distorted = radii * (1 + sum(lens[f"k{power}"] * radii ** (2 * power) for power in range(1, 5)))
    powers = angles[:, None] ** (2 * np.arange(1, 5))
    # θ·(1 + Σ k_p·θ^2p) is linear in k_p.
    terms, *_ = np.linalg.lstsq(angles[:, None] * powers, distorted - angles, rcond=None)
    misfit = lens["fl_y"] * np.abs(angles * (1 + powers @ terms) - distorted).max()
    if not misfit <= LARGEST_MISFIT:  # Also for NaN.
        raise ValueError(f"{what}: its equisolid lens is {misfit:.2g} pixels off COLMAP's fisheyes; {UNDISTORTED}")
    return {f"k{power}": float(term) for power, term in enumerate(terms, 1)}


def realityscan(path: Path) -> Callable[[], Frames] | None:
    """Return the function that reads RealityScan's XMP files in a folder, or anywhere below its folder images; None if
    there are none."""
    folders = []
    for found in (path.glob("*.xmp"), (path / "images").rglob("*.xmp")):
        files = [file for file in sorted(found) if b"xcr:Rotation" in read_regular(file, MOST_BYTES)]
        if files:
            folders.append(files)
    if not folders:
        return None
    # Files of another alignment may be left in one of the two.
    first_files = [files[0] for files in folders]
    return reading_one(first_files[0], first_files, functools.partial(_realityscan_frames, path, folders[0]))


def _realityscan_frames(path: Path, files: list[Path]) -> Frames:
    """Return the frames of XMP files, each next to its image. The only PLY file in the folder has the points."""
    frames, lacking = [], []
    for file in files:
        image = find_image(file.parent, file.stem)
        if image is None:
            lacking.append(file.name)
            continue
        values: dict[str, str] = {}  # RealityScan's, which are attributes or elements.
        for element in _read_xml(file).iter():
            values |= {key.removeprefix(XCR): text for key, text in element.attrib.items() if key.startswith(XCR)}
            if element.tag.startswith(XCR):
                values[element.tag.removeprefix(XCR)] = element.text or ""
        pose = np.eye(4)
        pose[:3, :3] = _numbers_in(values.get("Rotation"), 9, file).reshape(3, 3).T  # Stored from world to camera.
        pose[:3, 3] = _numbers_in(values.get("Position"), 3, file)
        lens = _xcr_lens(values, *picture_size(image), file)
        frames.append({**lens, "file_path": image.relative_to(path).as_posix(), "transform_matrix": pose @ OPENGL})
    nothing = f"{path}: no photograph is beside an XMP file of its name; put them together"
    check_images(path / "*.xmp", frames, lacking, nothing)
    folder = path / "images" if files[0].is_relative_to(path / "images") else path
    posed = [(path / frame["file_path"]).relative_to(folder).as_posix() for frame in frames]
    warn_of_unposed(folder, posed, is_deep=folder != path)
    return _with_points(path / "*.xmp", frames)


def _xcr_lens(values: dict[str, str], width: int, height: int, file: Path) -> dict[str, Any]:
    """Return the intrinsics of an XMP file; lengths in it are in units of the longer side."""

    def read(name: str, default: str) -> float:
        return float(_numbers_in(values.get(name, default), 1, file)[0])

    k1, k2, k3, k4, t1, t2 = _numbers_in(values.get("DistortionCoeficients", "0 0 0 0 0 0"), 6, file)
    model, longer = values.get("DistortionModel", "perspective"), max(width, height)
    has_brown = model.startswith("brown") or not any((k1, k2, k3))
    if k4 or t1 or t2 or not has_brown or abs(read("Skew", "0")) * longer > LARGEST_SKEW:
        raise ValueError(
            f"{file}: has the distortion model {shortened(model)} with skew, k4, t1 or t2, which are not supported; "
            f"align with Brown3, or {UNDISTORTED}"
        )
    focal = read("FocalLength35mm", "0") / FILM_WIDTH * longer
    cx, cy = width / 2 + longer * read("PrincipalPointU", "0"), height / 2 + longer * read("PrincipalPointV", "0")
    size = {"w": width, "h": height, "cx": cx, "cy": cy}
    return {**size, "fl_x": focal, "fl_y": focal * read("AspectRatio", "1"), "k1": k1, "k2": k2, "k3": k3}


def _with_points(file: Path, frames: list[dict[str, Any]]) -> Frames:
    """Return frames with poses as lists, and the points of the only PLY file next to `file`, if they are near."""
    poses = np.stack([frame["transform_matrix"] for frame in frames])
    middle = np.median(poses[:, :3, 3], axis=0)
    farthest = FARTHEST_POINTS * np.linalg.norm(poses[:, :3, 3] - middle, axis=1).max()
    cloud: PointCloud | None = None
    files = sorted(file.parent.glob("*.ply"))
    if len(files) > 1:
        names = ", ".join(each.name for each in files)
        warnings.warn(f"{file}: {len(files)} PLY files are beside it, {shortened(names)}: none used", stacklevel=3)
    elif files:
        cloud = read_ply_points(files[0])
        finite = cloud.points[np.isfinite(cloud.points).all(axis=-1)]
        if len(finite) and farthest and not np.linalg.norm(np.median(finite, axis=0) - middle) <= farthest:
            warnings.warn(
                f"{file}: the points beside it are far from its cameras, in another coordinate system: not used",
                stacklevel=3,
            )
            cloud = None
    listed = [{**frame, "transform_matrix": pose.tolist()} for frame, pose in zip(frames, poses, strict=True)]
    return Frames(file, listed, cloud)


def _read_xml(file: Path) -> Element:
    """Return the root of an XML file. Entity declarations, which can expand without limit, are rejected."""
    data = read_regular(file, MOST_BYTES)
    try:
        if b"<!ENTITY" in data or b"<!DOCTYPE" in data:
            raise ValueError("it declares entities")
        return ElementTree.fromstring(data)
    except (ElementTree.ParseError, ValueError, LookupError) as error:
        raise ValueError(f"{file}: cannot be read as XML ({shortened(str(error))}); export it again") from None


def _numbers_in(text: str | None, count: int, what: object) -> np.ndarray:
    """Return the numbers in a text, or raise ValueError unless there are `count` finite ones."""
    try:
        numbers = np.array([float(word) for word in (text or "").split()])
    except ValueError:
        numbers = np.empty(0)
    if len(numbers) != count or not np.isfinite(numbers).all():
        raise ValueError(f"{what}: {count} numbers are expected; got {shortened(text or 'none')}")
    return numbers
