"""Captures in formats that are known but not read, and what to do with them."""

from pathlib import Path

FOUND_BY: tuple[tuple[str, str], ...] = (
    ("*.psx", "is a project of Metashape: File > Export > Export Cameras as Agisoft XML, beside a folder images"),
    ("*.rcproj", "is a project of RealityCapture: export the registration as COLMAP, or as XMP beside the photographs"),
    ("*.rsproj", "is a project of RealityScan: export the registration as COLMAP, or as XMP beside the photographs"),
    ("*.r3d", "is a recording of Record3D: rename it to .zip, unpack it, and give the folder with metadata and rgbd"),
    ("*.insv", "is a recording of Insta360: export an equirectangular MP4 with Insta360 Studio, then a2tg sfm"),
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
    ("database.db", "has COLMAP's database without a model: colmap mapper writes sparse/0"),
)
"""Pattern of files below the capture's folder, and what to do. The first that fits is told."""


def told_of_capture(path: Path) -> str | None:
    """Return what a file or folder is and what to do with it, or None if nothing is known of it."""
    if path.is_dir():
        return next((f"{_first(path, pattern)} {told}" for pattern, told in FOUND_BY if any(path.glob(pattern))), None)
    return next((told for pattern, told in FOUND_BY if "/" not in pattern and path.match(pattern)), None)


def _first(folder: Path, pattern: str) -> str:
    return min(folder.glob(pattern)).relative_to(folder).as_posix()
