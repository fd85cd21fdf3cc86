"""File formats of splats: how each is read and written, by suffix, and what it keeps."""

import dataclasses
import os
from collections.abc import Callable
from pathlib import Path

from a2tg_jax import Model, load_model, save_model
from a2tg_jax.base.regular_files import expanded, is_regular
from a2tg_jax.base.text import did_you_mean, shortened
from a2tg_jax.data.other_runs import HOW_TO_EXPORT, model_hint
from a2tg_jax.io.compact import load_compact, save_compact
from a2tg_jax.io.gltf import load_gltf, save_gltf
from a2tg_jax.io.gltf_container import buffer_files
from a2tg_jax.io.other_programs import World, cut_numbers, reader_of, writer_as
from a2tg_jax.io.ply import encode_packed_ply, load_ply_model, save_ply
from a2tg_jax.io.sog import HEADER, STREAMED_HEADER, encode_sog, load_sog, sog_files
from a2tg_jax.io.splat_files import decode_ksplat, decode_splat, encode_ksplat, encode_splat
from a2tg_jax.io.spz import decode_spz, encode_spz
from a2tg_jax.io.torch_checkpoint import save_checkpoint_gaussians
from a2tg_jax.io.usd import import_usd, load_usd, save_usd

LEARNED = {
    "exposure": "learned exposures",
    "bilateral_grid": "learned bilateral grids",
    "pose": "learned motions of cameras",
}
"""Corrections of photographs in words, by name."""
Writer = Callable[..., None]
"""Function of a path and a model and, in formats that keep no origin, the `world` of the file."""


@dataclasses.dataclass(frozen=True)
class FileFormat:
    """Format of files, and what it keeps of a model besides its Gaussians."""

    name: str
    load: Callable[[Path], Model] | None
    save: Writer | None
    keeps_appearance: bool = False
    """Whether textures, and everything else that splats show, are kept."""
    keeps_origin: bool = False
    """Whether cameras, background and the normalised world are kept; other formats hold the original world, or that
    one turned upright."""
    keeps_corrections: bool = False
    """Whether learned exposures and poses of photographs are kept."""
    highest_degree: int = 3
    """Highest degree of spherical harmonics."""
    is_exact: bool = True
    """Whether numbers come back unrounded."""
    has_extension: bool = False
    """Whether other programs also read the file, but only its plain splats."""
    import_library: Callable[[], object] | None = None
    """Import of the optional library that writing needs; raises ValueError, with what to install, without it."""


_GLTF = FileFormat(
    "glTF", load_gltf, save_gltf, keeps_appearance=True, keeps_origin=True, is_exact=False, has_extension=True
)
_USD = FileFormat("OpenUSD", load_usd, save_usd, keeps_origin=True, is_exact=False, import_library=import_usd)
_CHECKPOINT = FileFormat("checkpoint", None, save_checkpoint_gaussians)
FORMATS = {
    ".npz": FileFormat(
        "model", load_model, save_model, keeps_appearance=True, keeps_origin=True, keeps_corrections=True
    ),
    ".a2tgz": FileFormat(
        "compact scene", load_compact, save_compact, keeps_appearance=True, keeps_origin=True, is_exact=False
    ),
    ".compressed.ply": FileFormat(
        "compressed PLY", load_ply_model, writer_as("compressed.ply", encode_packed_ply), is_exact=False
    ),
    ".ply": FileFormat("PLY", load_ply_model, save_ply),
    ".spz": FileFormat("SPZ", reader_of(decode_spz), writer_as("spz", encode_spz), is_exact=False),
    ".sog": FileFormat("SOG", load_sog, writer_as("sog", encode_sog), is_exact=False),
    HEADER: FileFormat("unbundled SOG", load_sog, None),
    ".splat": FileFormat(
        ".splat", reader_of(decode_splat), writer_as("splat", encode_splat), highest_degree=0, is_exact=False
    ),
    ".ksplat": FileFormat(
        ".ksplat", reader_of(decode_ksplat), writer_as("ksplat", encode_ksplat), highest_degree=2, is_exact=False
    ),
    **dict.fromkeys((".glb", ".gltf"), _GLTF),
    **dict.fromkeys((".usda", ".usdc", ".usdz", ".usd"), _USD),
    **dict.fromkeys((".pt", ".pth", ".ckpt"), _CHECKPOINT),
}
"""Formats by suffix. If two match a name, the first is used."""


def format_of(path: Path) -> FileFormat:
    """Return the format of a file by its suffix. ValueError: the suffix is unknown."""
    # Not Path.suffix: .compressed.ply has two dots.
    name = path.name.lower()
    for suffix, format in FORMATS.items():
        if name.endswith(suffix):
            return format
    near = did_you_mean(Path(name).suffix, FORMATS)
    if name.endswith(".zip"):
        near = "; if it is SOG, rename it to *.sog; otherwise unpack it"
    hint = model_hint(path) or f"{near}; known are {', '.join(FORMATS)}"
    raise ValueError(f"{shortened(str(path))}: unknown suffix{hint}")


def writer_of(path: Path) -> Writer:
    """Return the function that writes a file, by its suffix, after importing what it needs. ValueError: the suffix is
    unknown, an optional library is missing, or the format is read-only."""
    format = format_of(path)
    if format.save is None:
        raise ValueError(f"{shortened(str(path))}: {format.name} can be read, but not written; write *.sog")
    if format.import_library is not None:
        format.import_library()
    return format.save


def splats_at(path: Path) -> Path:
    """Return the file of splats at a path: the meta.json of a folder that is SOG, or else the path."""
    # Reading the header of streamed SOG fails with what to read instead.
    headers = [path / name for name in (HEADER, STREAMED_HEADER) if path.is_dir() and is_regular(path / name)]
    return headers[0] if headers else path


def load_splats(path: str | os.PathLike[str]) -> Model:
    """Read a model from a file of any format that is known by its suffix, such as *.npz, *.ply, *.spz or *.sog.

    Ellipsoids of 3DGS files become flat, with a warning if that changes them.

    Args:
      path: the file, whose suffix is its format; SOG may also be a folder with a meta.json.

    Returns:
      The model.

    Raises:
      FileNotFoundError: if there is no such file.
      ValueError: if the suffix is unknown, an optional library is missing, or the file is damaged.
    """
    path = splats_at(expanded(path))
    format = format_of(path)
    if format.load is None:
        raise ValueError(f"{path}: a {format.name} can be written, but not read; {HOW_TO_EXPORT}")
    return format.load(path)


def save_splats(path: str | os.PathLike[str], model: Model, *, world: World = "original") -> None:
    """Write a model in the format of the suffix, and replace a file of that name.

    Other programs' formats hold its Gaussians in the original world.

    Args:
      path: the file.
      model: any model that the format can hold.
      world: as in `save_ply`, for all formats without cameras; glTF and OpenUSD are always upright.

    Raises:
      ValueError: if the suffix is unknown, an optional library is missing, or the format cannot hold the model.

    Examples:
      >>> a2tg.save_splats("scene.splat", model)
      >>> a2tg.load_splats("scene.splat").num
      200
    """
    path = expanded(path)
    save = writer_of(path)
    if format_of(path).keeps_origin:
        save(path, model)
    else:
        save(path, model, world=world)


def files_written(path: Path) -> list[Path]:
    """Return the files that a model is written as: its own first, then the buffer of a *.gltf."""
    # As `Builder.save` names its buffer.
    return [path, path.with_suffix(".bin")] if path.suffix.lower() == ".gltf" else [path]


def files_of(path: Path) -> list[Path]:
    """Return the files that hold a written model: its own first, then the buffers that a *.gltf names, or the pictures
    of an unbundled SOG."""
    if path.name.lower() == HEADER:
        return sog_files(path)
    return [path, *buffer_files(path)] if path.suffix.lower() == ".gltf" else [path]


def file_bytes(path: Path) -> int:
    """Return the bytes of all files that hold a written model."""
    return sum(file.stat().st_size for file in files_of(path))


def _bakeable(model: Model) -> str:
    """Describe what a model shows that baking turns into plain splats; "" if nothing."""
    shown = []
    if model.textures is not None:
        shown.append("textures")
    if model.appearance.exponents is not None:
        shown.append("shapes of kernels")
    return f"{' and '.join(shown)} (bake turns them into plain splats)" if shown else ""


def unseen_elsewhere(model: Model, path: Path) -> str:
    """Describe what a file keeps of a model, by its suffix, but other programs do not show; "" if nothing."""
    return _bakeable(model) if format_of(path).has_extension else ""


def lost_by(model: Model, path: Path) -> list[str]:
    """Describe what a file, by its suffix, does not keep of a model."""
    into = format_of(path)
    shown = model.appearance
    origin = model.origin
    lost: list[str] = []
    if not into.keeps_appearance:
        bakeable = _bakeable(model)
        if bakeable:
            lost.append(bakeable)
        if not shown.is_portable and model.textures is None:
            lost.append(f"what {type(shown).__name__} shows besides Gaussians")
    if model.live.degrees.max(initial=0) > into.highest_degree:
        lost.append(f"spherical harmonics above degree {into.highest_degree}")
    lost += cut_numbers(into.name, model)
    if not into.keeps_origin:
        if origin is not None and origin.names:
            lost.append("cameras and background")
        elif any(model.background):
            lost.append("background")
    if origin is not None and not into.keeps_corrections:
        lost += [LEARNED.get(name, f"learned {name}") for name in sorted(origin.corrections)]
    if not into.is_exact:
        lost.append("last digits")
    return lost
