"""Cameras of RealityScan (RealityCapture): an XMP file beside each photograph, read as frames of `transforms.json`."""

from pathlib import Path
from typing import Any

import numpy as np

from a2tg_jax.data.decoding import picture_size
from a2tg_jax.data.frames import Frames, warn_of_missing_images
from a2tg_jax.data.images import named_image, warn_of_unposed
from a2tg_jax.data.photogrammetry import (
    LARGEST_SKEW,
    OPENGL,
    UNDISTORTED,
    numbers_in,
    points_beside,
    read_xml,
    with_near_points,
)
from a2tg_jax.host.json_text import MOST_BYTES
from a2tg_jax.host.regular_files import read_regular
from a2tg_jax.host.text import shortened

XCR = "{http://www.capturingreality.com/ns/xcr/1.1#}"
FILM_WIDTH = 36.0
"""Width in mm of the film that FocalLength35mm refers to, for the longer side of an image."""


def realityscan_files(path: Path) -> list[Path]:
    """Return XMP files with RealityScan's poses in a folder, or anywhere below its folder images."""
    for found in (path.glob("*.xmp"), (path / "images").rglob("*.xmp")):
        files = [file for file in sorted(found) if b"xcr:Rotation" in read_regular(file, MOST_BYTES)]
        if files:
            return files
    return []


def realityscan_frames(path: Path, files: list[Path]) -> Frames:
    """Return the frames of XMP files, each beside its image. The only PLY file in the folder holds the points.

    Raises:
      ValueError: if a file is no such XMP, or a lens has a distortion that COLMAP's models do not know.
    """
    frames, lacking = [], []
    for file in files:
        image = named_image(file.parent, file.stem)
        if image is None:
            lacking.append(file.name)
            continue
        values = _xcr_values(file)
        pose = np.eye(4)
        pose[:3, :3] = numbers_in(values.get("Rotation"), 9, file).reshape(3, 3).T
        pose[:3, 3] = numbers_in(values.get("Position"), 3, file)
        width, height = picture_size(image)
        lens = _xcr_lens(values, width, height, file)
        frames.append({**lens, "file_path": image.relative_to(path).as_posix(), "transform_matrix": pose @ OPENGL})
    if not frames:
        raise ValueError(f"{path}: no photograph lies beside an XMP file of its name; put them together")
    warn_of_missing_images(path / "*.xmp", lacking, len(files))
    folder = path / "images" if files[0].is_relative_to(path / "images") else path
    posed = [(path / frame["file_path"]).relative_to(folder).as_posix() for frame in frames]
    warn_of_unposed(folder, posed, is_deep=folder != path)
    return with_near_points(Frames(path / "*.xmp", frames, points_beside(path / "*.xmp")))


def _xcr_values(file: Path) -> dict[str, str]:
    """Return RealityScan's values in an XMP file, which are attributes or elements."""
    values: dict[str, str] = {}
    for element in read_xml(file).iter():
        values |= {key.removeprefix(XCR): text for key, text in element.attrib.items() if key.startswith(XCR)}
        if element.tag.startswith(XCR):
            values[element.tag.removeprefix(XCR)] = element.text or ""
    return values


def _xcr_lens(values: dict[str, str], width: int, height: int, file: Path) -> dict[str, Any]:
    """Return the intrinsics of an XMP file; lengths in it are in units of the longer side."""

    def read(name: str, default: str) -> float:
        return float(numbers_in(values.get(name, default), 1, file)[0])

    k1, k2, k3, k4, t1, t2 = numbers_in(values.get("DistortionCoeficients", "0 0 0 0 0 0"), 6, file)
    model, longer = values.get("DistortionModel", "perspective"), max(width, height)
    has_brown = model.startswith("brown") or not any((k1, k2, k3))
    if k4 or t1 or t2 or not has_brown or abs(read("Skew", "0")) * longer > LARGEST_SKEW:
        raise ValueError(
            f"{file}: has the distortion model {shortened(model)} with skew, k4, t1 or t2, which are not known here; "
            f"align with Brown3, or {UNDISTORTED}"
        )
    focal = read("FocalLength35mm", "0") / FILM_WIDTH * longer
    cx, cy = width / 2 + longer * read("PrincipalPointU", "0"), height / 2 + longer * read("PrincipalPointV", "0")
    size = {"w": width, "h": height, "cx": cx, "cy": cy}
    return {**size, "fl_x": focal, "fl_y": focal * read("AspectRatio", "1"), "k1": k1, "k2": k2, "k3": k3}
