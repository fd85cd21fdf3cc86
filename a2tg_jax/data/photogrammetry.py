"""Cameras of photogrammetry programs, read as frames of `transforms.json`.

Metashape writes one XML file (File > Export > Export Cameras). Its lenses follow the manual's appendix on camera
models: a projection onto the plane z = 1 (frame), or onto radii θ (equidistant fisheye) or 2·sin(θ/2) (equisolid
fisheye) for a ray at the angle θ, then Brown's distortion. RealityScan (RealityCapture) writes an XMP file next to
each photograph.
"""

import functools
import re
from collections import defaultdict
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from a2tg_jax.base.json_text import MOST_BRACKETS, MOST_BYTES
from a2tg_jax.base.regular_files import is_regular, names_in, open_regular, read_regular
from a2tg_jax.base.text import shortened
from a2tg_jax.base.user_warnings import warn
from a2tg_jax.data.assembly import rigid_motion
from a2tg_jax.data.decoding import picture_size
from a2tg_jax.data.image_files import files_below, find_image, is_photo, warn_of_unposed
from a2tg_jax.data.ply import read_ply_points
from a2tg_jax.data.transforms import Cameras, Frames, check_images

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
HIGHER_TERMS = {
    "frame": ("k4", "p3", "p4"), "fisheye": ("p3", "p4"), "equidistant_fisheye": ("p3", "p4"),
    "equisolid_fisheye": ("p1", "p2", "p3", "p4"),
}  # fmt: skip
"""Types of sensors that are read, with the coefficients of distortion that COLMAP's models do not have."""
LARGEST_MISFIT = 0.05
"""Largest difference in pixels between an equisolid fisheye and its polynomial approximation."""
NUM_ANGLES = 200
"""Number of angles at which they are compared."""
HEAD_BYTES = 1 << 16
"""Number of bytes of an XML file that are searched for a chunk's sensors."""
XCR = "{http://www.capturingreality.com/ns/xcr/1.1#}"
FILM_WIDTH = 36.0
"""Width in mm of the film that FocalLength35mm refers to, for the longer side of an image."""


def metashape(path: Path) -> list[Cameras]:
    """Return Metashape's cameras, an XML file or those in a folder: cameras.xml first, and then by name."""
    files = [path] if is_regular(path) else [path / name for name in names_in(path)]
    cameras = []
    for file in files:
        if file.suffix.lower() == ".xml" and is_regular(file):
            with open_regular(file) as opened:
                if b"<sensors" in opened.read(HEAD_BYTES):
                    cameras.append(Cameras(file, functools.partial(_metashape_frames, file)))
    return sorted(cameras, key=lambda each: each.file.name.lower() != METASHAPE_FILE)


def _metashape_frames(file: Path) -> Frames:
    """Return the frames of Metashape's cameras. A PLY file next to them, if it is the only one, has their points."""
    folder = file.parent
    images = folder / "images"
    below: dict[str, set[Path]] = defaultdict(set)  # Images in all folders below, with and without suffix.
    for each in filter(is_photo, files_below(images)):
        below[each.name].add(each)
        below[each.stem].add(each)
    frames = []
    lacking: list[str] = []
    for label, sensor, pose in _posed_cameras(file):
        name = re.split(r"[/\\]", label)[-1]  # A label is a path of any machine, or a name.
        image = find_image(images, name) or find_image(folder, name)
        if image is None and len(below[name]) == 1:
            (image,) = below[name]
        if image is None:
            lacking.append(label)
        else:
            lens = _metashape_lens(sensor, f"{file}: {label}")
            frames.append(_frame(image.relative_to(folder), pose, lens))
    nothing = f"{file}: none of its cameras has a pose and an image beside it; put the photographs into images/"
    check_images(file, frames, lacking, nothing)
    return _with_points(file, frames)


def _posed_cameras(file: Path) -> list[tuple[str, Element, np.ndarray]]:
    """Return label, sensor and pose [4, 4] in the world of each camera that has a pose and is switched on.

    A camera without a pose in a rig has the pose of its master and the offset of its sensor. Warnings count
    those, and cameras that are not used.
    """
    posed: list[tuple[str, Element, np.ndarray]] = []
    unused = []
    in_rigs = []
    for chunk in _read_xml(file).iter("chunk"):
        sensors = {sensor.get("id"): sensor for sensor in chunk.iter("sensor")}
        cameras = {camera.get("id"): camera for camera in chunk.iter("camera")}
        components = {part.get("id"): _world(part, file) for part in chunk.iter("component")}
        world_of_chunk = _world(chunk, file)
        for camera in chunk.iter("camera"):
            label = camera.get("label") or ""
            sensor = sensors.get(camera.get("sensor_id"))
            master = cameras.get(camera.get("master_id"))
            with_pose = camera
            offset: np.ndarray | None = np.eye(4)
            if sensor is not None and master is not None and camera.find("transform") is None:
                with_pose = master
                offset = _offset(sensor, sensors.get(master.get("sensor_id")), file)
            transform = with_pose.find("transform")
            if sensor is None or transform is None or offset is None or camera.get("enabled") in SWITCHED_OFF:
                unused.append(label)
                continue
            if with_pose is not camera:
                in_rigs.append(label)
            pose = _numbers_in(transform.text, 16, file).reshape(4, 4) @ offset
            world = components.get(with_pose.get("component_id"))
            if world is None:
                world = world_of_chunk
            if world is not None:
                pose = world @ pose
                # s·R has the determinant s³; poses are rigid. rigid_motion reports a scale of 0.
                pose[:3, :3] /= np.cbrt(abs(np.linalg.det(world[:3, :3]))) or 1.0
            posed.append((label, sensor, pose))
    num = len(posed) + len(unused)
    if in_rigs:
        warn(
            f"{file}: {len(in_rigs)} of {num} cameras have no own pose, such as {shortened(in_rigs[0])}: placed by "
            "their sensors' offsets from the master, in units of its pose"
        )
    if unused:
        warn(
            f"{file}: {len(unused)} of {num} cameras have no pose or are switched off, such as "
            f"{shortened(unused[0])}: not used"
        )
    return posed


def _offset(sensor: Element, master: Element | None, file: Path) -> np.ndarray | None:
    """Return the rigid motion [4, 4] from a sensor of a rig to the sensor of its master camera; None if the file has
    neither's place in the rig. A sensor without a place is the origin of the rig."""
    from_sensor = _place_in_rig(sensor, file)
    from_master = None if master is None else _place_in_rig(master, file)
    if from_sensor is None and (from_master is None or sensor.get("master_id") is not None):
        return None
    offset = np.eye(4) if from_master is None else np.linalg.inv(from_master)
    return offset if from_sensor is None else offset @ from_sensor  # From sensor to rig to master.


def _place_in_rig(sensor: Element, file: Path) -> np.ndarray | None:
    """Return the rigid motion [4, 4] from a sensor's frame to its rig's; None if it has none."""
    if sensor.find("rotation") is None and sensor.find("translation") is None:
        return None
    return rigid_motion(_motion(sensor, file), f"{file}: sensor {sensor.get('id')}")


def _world(part: Element, file: Path) -> np.ndarray | None:
    """Return the similarity [4, 4] from a component or a chunk to the world, or None."""
    transform = part.find("transform")
    if transform is None or transform.find("rotation") is None:
        return None
    world = _motion(transform, file)
    scale = transform.findtext("scale")
    if scale is not None:
        world[:3, :3] *= _numbers_in(scale, 1, file)
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
    if kind not in HIGHER_TERMS:
        advice = "cut panoramas into views with a2tg sfm" if kind == "spherical" else UNDISTORTED
        raise ValueError(f"{what}: is of a sensor of type {shortened(kind)}, which is not read; {advice}")
    calibrations = [part for part in sensor.iter("calibration") if part.find("f") is not None]
    if not calibrations:
        raise ValueError(f"{what}: is of a sensor without a calibration; {UNDISTORTED}")
    # A sensor may have its initial calibration as well; poses belong to the adjusted one.
    calibration = min(calibrations, key=lambda part: part.get("class") != "adjusted")
    resolution = calibration.find("resolution")
    if resolution is None:
        resolution = sensor.find("resolution")
    if resolution is None:
        raise ValueError(f"{what}: its sensor has no resolution; export the cameras again")
    width = _number_in(resolution.get("width"), what)
    height = _number_in(resolution.get("height"), what)

    def term(name: str) -> float:
        return _number_in(calibration.findtext(name, "0"), what)

    focal = term("f")
    higher = HIGHER_TERMS[kind]
    # Skew is b2·y, where y goes up to height / f.
    if any(map(term, higher)) or abs(term("b2")) * height / max(focal, 1.0) > LARGEST_SKEW:
        names = ", ".join(higher)
        raise ValueError(f"{what}: its {kind} lens has {names} or b2, which are not supported; {UNDISTORTED}")
    # Metashape's manual: u = w/2 + cx + x·(f + b1) + y·b2, v = h/2 + cy + y·f.
    lens: dict[str, Any] = {
        "w": int(width), "h": int(height), "fl_x": focal + term("b1"), "fl_y": focal,
        "cx": width / 2 + term("cx"), "cy": height / 2 + term("cy"),
        "k1": term("k1"), "k2": term("k2"), "k3": term("k3"), "p1": term("p2"), "p2": term("p1"),
    }  # fmt: skip
    if kind != "frame":
        lens |= {"camera_model": "THIN_PRISM_FISHEYE", "k4": term("k4")}
    if kind == "equisolid_fisheye":
        lens |= _equidistant_terms(lens, what)
    return lens


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


def realityscan(path: Path) -> list[Cameras]:
    """Return the cameras of RealityScan's XMP files in a folder, and of those anywhere below its folder images."""
    cameras = []
    for found in (map(path.joinpath, names_in(path)), files_below(path / "images")):
        xmp = (file for file in found if file.suffix.lower() == ".xmp" and is_regular(file))
        files = [file for file in sorted(xmp) if b"xcr:Rotation" in read_regular(file, MOST_BYTES)]
        # Files of another alignment may be left in one of the two.
        if files:
            cameras.append(Cameras(files[0], functools.partial(_realityscan_frames, path, files), files))
    return cameras


def _realityscan_frames(path: Path, files: list[Path]) -> Frames:
    """Return the frames of XMP files, each next to its image. The only PLY file in the folder has the points."""
    frames = []
    lacking = []
    for file in files:
        image = find_image(file.parent, file.stem)
        if image is None:
            lacking.append(file.name)
            continue
        values: dict[str, str] = {}  # RealityScan's, which are attributes or elements.
        for element in _read_xml(file).iter():
            for key, text in (*element.attrib.items(), (element.tag, element.text or "")):
                if key.startswith(XCR):
                    values[key.removeprefix(XCR)] = text
        pose = np.eye(4)
        pose[:3, :3] = _numbers_in(values.get("Rotation"), 9, file).reshape(3, 3).T  # Stored from world to camera.
        pose[:3, 3] = _numbers_in(values.get("Position"), 3, file)
        width, height = picture_size(image)
        frames.append(_frame(image.relative_to(path), pose, _xcr_lens(values, width, height, file)))
    place = path / "*.xmp"
    nothing = f"{path}: no photograph is beside an XMP file of its name; put them together"
    check_images(place, frames, lacking, nothing)
    images = path / "images"
    is_deep = files[0].is_relative_to(images)
    folder = images if is_deep else path
    posed = [(path / frame["file_path"]).relative_to(folder).as_posix() for frame in frames]
    warn_of_unposed(folder, posed, is_deep=is_deep)
    return _with_points(place, frames)


def _xcr_lens(values: dict[str, str], width: int, height: int, file: Path) -> dict[str, Any]:
    """Return the intrinsics of an XMP file; lengths in it are in units of the longer side."""

    def value(name: str, default: str = "0") -> float:
        return _number_in(values.get(name, default), file)

    k1, k2, k3, k4, t1, t2 = _numbers_in(values.get("DistortionCoeficients", "0 0 0 0 0 0"), 6, file)
    model = values.get("DistortionModel", "perspective")
    longer = max(width, height)
    has_brown = model.startswith("brown") or not any((k1, k2, k3))
    if k4 or t1 or t2 or not has_brown or abs(value("Skew")) * longer > LARGEST_SKEW:
        raise ValueError(
            f"{file}: has the distortion model {shortened(model)} with skew, k4, t1 or t2, which are not supported; "
            f"align with Brown3, or {UNDISTORTED}"
        )
    focal = value("FocalLength35mm") / FILM_WIDTH * longer
    return {
        "w": width, "h": height, "fl_x": focal, "fl_y": focal * value("AspectRatio", "1"),
        "cx": width / 2 + longer * value("PrincipalPointU"), "cy": height / 2 + longer * value("PrincipalPointV"),
        "k1": k1, "k2": k2, "k3": k3,
    }  # fmt: skip


def _frame(path: Path, pose: np.ndarray, lens: dict[str, Any]) -> dict[str, Any]:
    """Return the frame of an image, by its path below the scene, with a pose [4, 4] from camera to world (OpenCV)."""
    return {**lens, "file_path": path.as_posix(), "transform_matrix": (pose @ OPENGL).tolist()}


def _with_points(file: Path, frames: list[dict[str, Any]]) -> Frames:
    """Return frames with the points of the only PLY file next to `file`, if they are near the cameras."""
    files = sorted(file.parent.glob("*.ply"))
    if len(files) > 1:
        names = ", ".join(each.name for each in files)
        warn(f"{file}: {len(files)} PLY files are beside it, {shortened(names)}: none used")
    if len(files) != 1:
        return Frames(file, frames)
    cloud = read_ply_points(files[0])
    centers = np.array([frame["transform_matrix"] for frame in frames])[:, :3, 3]
    middle = np.median(centers, axis=0)
    farthest = FARTHEST_POINTS * np.linalg.norm(centers - middle, axis=1).max()
    points = cloud.points[np.isfinite(cloud.points).all(axis=-1)]
    if len(points) and farthest and not np.linalg.norm(np.median(points, axis=0) - middle) <= farthest:
        warn(f"{file}: the points beside it are far from its cameras, in another coordinate system: not used")
        return Frames(file, frames)
    return Frames(file, frames, cloud)


def _read_xml(file: Path) -> Element:
    """Return the root of an XML file. Entities, which can expand without limit, and very many elements are rejected."""
    data = read_regular(file, MOST_BYTES)
    try:
        # Of the encodings that the parser reads, only UTF-16 would hide these bytes, and it has zeros.
        if b"<!DOCTYPE" in data or b"\0" in data:
            raise ValueError("it declares entities, or is UTF-16")
        num_tags = data.count(b"<")
        if num_tags > MOST_BRACKETS:
            raise ValueError(f"it has {num_tags:,} tags; the limit is {MOST_BRACKETS:,}")
        return ElementTree.fromstring(data)
    except (ElementTree.ParseError, ValueError, LookupError) as error:
        raise ValueError(f"{file}: cannot be read as XML ({shortened(str(error))}); export it again") from None


def _number_in(text: str | None, what: object) -> float:
    return float(_numbers_in(text, 1, what)[0])


def _numbers_in(text: str | None, count: int, what: object) -> np.ndarray:
    """Return the numbers in a text, or raise ValueError unless there are `count` finite ones."""
    try:
        numbers = np.array([float(word) for word in (text or "").split()])
    except ValueError:
        numbers = np.empty(0)
    if len(numbers) != count or not np.isfinite(numbers).all():
        raise ValueError(f"{what}: {count} numbers are expected; got {shortened(text or 'none')}")
    return numbers
