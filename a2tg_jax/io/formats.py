"""Formats of files of splats: by suffix how each is read and written, and what it keeps."""

import dataclasses
import importlib
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

from a2tg_jax.core.gaussians import Gaussians
from a2tg_jax.host.text import shortened
from a2tg_jax.io.compact import load_compact, save_compact
from a2tg_jax.io.gaussforge_files import import_gaussforge, load_by_gaussforge, save_by_gaussforge
from a2tg_jax.io.gltf_reader import buffer_files
from a2tg_jax.io.ksplat import load_ksplat, save_ksplat
from a2tg_jax.io.model_file import load_model, save_model
from a2tg_jax.io.number_ranges import RANGES, cut_numbers
from a2tg_jax.io.ply import load_ply_model, save_ply, world_gaussians
from a2tg_jax.io.torch_checkpoint import load_checkpoint_gaussians
from a2tg_jax.model import Model

LEARNED = {
    "exposure": "learned exposures",
    "bilateral_grid": "learned bilateral grids",
    "pose": "learned motions of cameras",
}
"""Corrections of photographs in words, by name."""
BAKES = "(--bake turns them into plain splats)"
"""Remedy for what plain splats do not keep."""
Reader = Callable[[Path], Model | Gaussians]
Writer = Callable[[Path, Model], None]


@dataclasses.dataclass(frozen=True)
class FileFormat:
    """Format of files, and what it keeps of a model beside its Gaussians."""

    name: str
    load: Reader | None
    save: Writer | None
    keeps_appearance: bool = False
    """Whether textures, and whatever else splats show, are kept."""
    keeps_origin: bool = False
    """Whether cameras, background and the normalised world are kept; other formats hold the original world."""
    keeps_corrections: bool = False
    """Whether learned exposures and poses of photographs are kept."""
    highest_degree: int = 3
    """Highest degree of spherical harmonics."""
    is_exact: bool = True
    """Whether numbers come back unrounded."""
    has_extension: bool = False
    """Whether other programs read the file, too, but only its plain splats."""
    import_library: Callable[[Path], object] | None = None
    """Import of the optional library that writing needs; raises ValueError, with what to install, without it."""


def _later(module: str, function: str) -> Callable[..., Any]:
    """Return a function that imports a function of a module of this room when it is called."""

    def call(*arguments: object) -> Any:
        return getattr(importlib.import_module(f"a2tg_jax.io.{module}"), function)(*arguments)

    return call


def _by_gaussforge(name: str, degree: int = 3) -> FileFormat:
    return FileFormat(
        name,
        load_by_gaussforge,
        save_by_gaussforge,
        highest_degree=degree,
        is_exact=False,
        import_library=import_gaussforge,
    )


_GLTF = FileFormat(
    "glTF",
    _later("gltf", "load_gltf"),
    _later("gltf", "save_gltf"),
    keeps_appearance=True,
    keeps_origin=True,
    is_exact=False,
    has_extension=True,
)
_USD = FileFormat(
    "OpenUSD",
    _later("usd", "load_usd"),
    _later("usd", "save_usd"),
    keeps_origin=True,
    is_exact=False,
    import_library=lambda path: _later("usd", "import_usd")(),
)
_CHECKPOINT = FileFormat("checkpoint", load_checkpoint_gaussians, None)
FORMATS = {
    ".npz": FileFormat("model", load_model, save_model, True, True, True),
    ".a2tgz": FileFormat("compact scene", load_compact, save_compact, True, True, is_exact=False),
    ".compressed.ply": FileFormat(
        "compressed PLY", load_ply_model, save_by_gaussforge, is_exact=False, import_library=import_gaussforge
    ),
    ".ply": FileFormat("PLY", load_ply_model, save_ply),
    ".spz": _by_gaussforge("SPZ"),
    ".sog": _by_gaussforge("SOG"),
    ".splat": _by_gaussforge(".splat", degree=0),
    ".ksplat": FileFormat(".ksplat", load_ksplat, save_ksplat, highest_degree=2, is_exact=False),
    ".glb": _GLTF,
    ".gltf": _GLTF,
    ".usda": _USD,
    ".usdc": _USD,
    ".usdz": _USD,
    ".usd": _USD,
    ".pt": _CHECKPOINT,
    ".pth": _CHECKPOINT,
    ".ckpt": _CHECKPOINT,
}
"""Formats by suffix. Of two that fit a name the first counts."""


def format_of(path: str | os.PathLike[str]) -> FileFormat:
    """Return the format of a file by its suffix.

    Raises:
      ValueError: if the suffix is unknown.
    """
    name = Path(path).name.lower()
    for suffix, found in FORMATS.items():
        if name.endswith(suffix):
            return found
    raise ValueError(f"{shortened(os.fspath(path))}: no format is known by this suffix; known are {', '.join(FORMATS)}")


def writer_of(path: str | os.PathLike[str]) -> Writer:
    """Return the function that writes a file, chosen by its suffix, once it is sure to have what it needs.

    Raises:
      ValueError: if the suffix is unknown, an optional library is missing, or the format can only be read.
    """
    found = format_of(path)
    if found.save is None:
        raise ValueError(f"{shortened(os.fspath(path))}: {found.name} files can be read, but not written")
    if found.import_library is not None:
        found.import_library(Path(path))
    return found.save


def load_splats(path: str | os.PathLike[str]) -> Model:
    """Read a model from a file of any format that is known by its suffix, such as *.npz, *.ply, *.spz or *.sog.

    Ellipsoids of files of 3DGS become flat, with a warning if that changes them.

    Raises:
      FileNotFoundError: if there is no such file.
      ValueError: if the suffix is unknown, an optional library is missing, or the file is damaged.
    """
    found = format_of(path)
    if found.load is None:
        raise ValueError(f"{shortened(os.fspath(path))}: {found.name} files can be written, but not read")
    loaded = found.load(Path(path))
    return Model(loaded) if isinstance(loaded, Gaussians) else loaded


def save_splats(path: str | os.PathLike[str], model: Model) -> None:
    """Write a model in the format of the suffix. Formats of other programs hold its Gaussians in the original world.

    Raises:
      ValueError: if the suffix is unknown, an optional library is missing, or the format cannot hold the model.
    """
    writer_of(path)(Path(path), model)


def files_written(path: Path) -> list[Path]:
    """Return the files that a model is written as: its own first, and the buffer beside a *.gltf."""
    return [path, path.with_suffix(".bin")] if path.suffix.lower() == ".gltf" else [path]


def files_of(path: Path) -> list[Path]:
    """Return the files that hold a written model: its own first, and the buffers that a *.gltf names."""
    return [path, *(buffer_files(path) if path.suffix.lower() == ".gltf" else [])]


def file_bytes(path: Path) -> int:
    """Return the bytes of all files that hold a written model."""
    return sum(file.stat().st_size for file in files_of(path))


def beside_gaussians(model: Model) -> str:
    """Return in words what a model shows beside plain splats, of what baking turns into these; "" if nothing."""
    has_textures, has_shapes = model.textures is not None, model.appearance.exponents is not None
    return " and ".join(["textures"] * has_textures + ["shapes of kernels"] * has_shapes)


def _bakeable(model: Model) -> str:
    """Return `beside_gaussians` with its remedy; "" if nothing."""
    beside = beside_gaussians(model)
    return f"{beside} {BAKES}" if beside else ""


def _lost_appearance(model: Model) -> list[str]:
    """Return in words what plain splats do not keep of what a model shows."""
    lost = [_bakeable(model)]
    if not model.appearance.is_portable and model.textures is None:
        lost.append(f"what {type(model.appearance).__name__} shows besides Gaussians")
    return [found for found in lost if found]


def unseen_elsewhere(model: Model, path: str | os.PathLike[str]) -> str:
    """Return in words what a file of some suffix keeps of a model and other programs do not show; "" if nothing."""
    return _bakeable(model) if format_of(path).has_extension else ""


def lost_by(model: Model, path: str | os.PathLike[str]) -> list[str]:
    """Return in words what a file of some suffix does not keep of a model."""
    into, lost = format_of(path), list[str]()
    if not into.keeps_appearance:
        lost += _lost_appearance(model)
    degree = model.gaussians.sh_degree if model.appearance.bands is None else 3
    if degree > into.highest_degree:
        lost.append(f"spherical harmonics above degree {into.highest_degree}")
    if into.name in RANGES:
        lost += cut_numbers(into.name, world_gaussians(model).gaussians)
    if model.origin is not None and model.origin.names and not into.keeps_origin:
        lost.append("cameras and background")
    if model.origin is not None and not into.keeps_corrections:
        lost += [LEARNED.get(name, f"learned {name}") for name in sorted(model.origin.corrections)]
    if not into.is_exact:
        lost.append("last digits")
    return lost
