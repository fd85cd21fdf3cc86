"""Conversion of models between file formats."""

import contextlib
import dataclasses
import os
import time
from importlib.metadata import version
from pathlib import Path

from a2tg_jax import Model, load_model, save_model
from a2tg_jax.base.archive import read_archive_header
from a2tg_jax.base.even_spacing import evenly_chosen
from a2tg_jax.base.regular_files import is_regular, sha256_of
from a2tg_jax.base.text import counted, in_bytes
from a2tg_jax.finish.baking import MOST_VIEWS, bake, likeness, pictures
from a2tg_jax.io.formats import (
    file_bytes,
    files_of,
    files_written,
    format_of,
    lost_by,
    save_splats,
    unseen_elsewhere,
    writer_of,
)
from a2tg_jax.io.other_programs import world_line
from a2tg_jax.io.ply import save_ply
from a2tg_jax.io.sog import HEADER
from a2tg_jax.model_file import FORMAT
from a2tg_jax.results.folder import RunFolder
from a2tg_jax.results.model_source import Source, open_source
from a2tg_jax.results.options import BakeOptions, PlacementOptions
from a2tg_jax.results.output_paths import check_new, check_output


def convert(
    source: Path,
    out: Path,
    name: str | None = None,
    *,
    edit: Path | None = None,
    baking: BakeOptions,
    placement: PlacementOptions,
    overwrite: bool = False,
) -> str:
    """Write a run's model `name`, or a file of any known format, in another suffix's format, and return a summary.
    `edit` is as in `open_source`. Raises ValueError or OSError if a format is unknown, an option is invalid, or a file
    cannot be read or written."""
    baking.check()
    check_conversion(source, out, placement, overwrite=overwrite)  # Baking takes minutes.
    start = time.perf_counter()
    opened = open_source(source, name, edit)
    if not baking.bake:
        return write_converted(opened.path, opened.model, out, start, placement)
    model, line = _kept_or_baked(source, opened, baking, edit)
    return f"{line}\n{write_converted(opened.path, model, out, start, placement)}"


def check_conversion(
    source: Path,
    out: Path,
    placement: PlacementOptions,
    *,
    overwrite: bool = False,
    option: str = "OUT",
) -> None:
    """Raise ValueError or OSError unless `out`, named by an option, can be written from a source. Other arguments as in
    `convert`."""
    writer_of(out)
    if placement.float64 and format_of(out).save is not save_ply:
        raise ValueError(f"`float64` needs an OUT that ends in .ply and is not packed; got {out}")
    if placement.world == "original" and format_of(out).keeps_origin:
        raise ValueError(
            f"`world` has no effect on {out}, which also holds the way to the original world: leave it out"
        )
    # A *.gltf is several files, none of which may be both read and written.
    # Not Path.resolve, which raises RuntimeError for links in a circle before Python 3.13.
    sources = {os.path.realpath(file) for file in files_of(source)}
    for file in files_written(out):
        if os.path.realpath(file) in sources:
            whole = "the source" if file == out else f"part of the source and would be written together with {out}"
            raise ValueError(f"{file} is {whole}: choose another name")
        check_new(file, option, overwrite=overwrite)
    check_output(out)


def write_converted(
    source_file: Path,
    model: Model,
    out: Path,
    start: float,
    placement: PlacementOptions,
) -> str:
    """Write a model that was read from a file, after `check_conversion`, and return a summary with the seconds since
    `start` (`time.perf_counter`). Other arguments as in `convert`."""
    world = placement.world
    if placement.float64:
        save_ply(out, model, float64=True, world=world)
    else:
        save_splats(out, model, world=world)
    before = file_bytes(source_file)
    after = file_bytes(out)
    seconds = time.perf_counter() - start
    sizes = f"{in_bytes(after)} from {in_bytes(before)} ({after / max(before, 1):.2f} times)"
    lines = [f"{out}: {counted(model.num, 'Gaussian')}, {sizes}, {seconds:.1f} s"]
    lost = lost_by(model, out)
    if lost:
        lines.append(f"not kept by this format: {', '.join(lost)}")
    unseen = unseen_elsewhere(model, out)
    if unseen:
        lines.append(f"not shown by other programs: {unseen}")
    if not format_of(out).keeps_origin:
        lines.append(world_line(model, world))
    if out.suffix.lower() == ".spz" and world == "upright":
        lines.append("programs that expect SPZ with +y up show it upside down: turn it half about x there")
    if source_file.name.lower() == HEADER:
        lines.append(f"source: {source_file.parent} is SOG as a folder; its files, zipped without it, are a *.sog")
    return "\n".join(lines)


def _kept_or_baked(source: Path, opened: Source, options: BakeOptions, edit: Path | None) -> tuple[Model, str]:
    """Return the baked model of a run that an earlier call has kept for the same model, edit and options, or else bake
    and keep it. The models of files are baked each time."""
    if not source.is_dir():
        return _baked(source, opened.model, options)
    run = RunFolder(source)
    path = run.baked(opened.path.stem)
    key = {
        "sha256": sha256_of(opened.path),
        "version": version("a2tg-jax"),
        **dataclasses.asdict(options),
        "edit": None if edit is None else sha256_of(edit),
    }
    with contextlib.suppress(ValueError, OSError, KeyError, TypeError):  # Damaged: baked again.
        if is_regular(path):
            kept = read_archive_header(path, format=FORMAT)["baked"]
            if kept["key"] == key:
                return load_model(path), f"{kept['line']}; kept in {path}"
    plain, line = _baked(source, opened.model, options)
    if plain is not opened.model:
        with contextlib.suppress(OSError):  # A run may be read-only.
            save_model(run.own(path), plain, {"baked": {"key": key, "line": line}})
    return plain, line


def _baked(source: Path, model: Model, options: BakeOptions) -> tuple[Model, str]:
    """Return a plain model, and a line about the baking."""
    if model.origin is None or not model.origin.cameras:
        raise ValueError(f"`bake` needs a model with cameras; {source} has none")
    appearance = model.appearance
    if appearance.is_portable and appearance.texture is None and appearance.exponents is None:
        return model, "baked: nothing, because the model is plain"
    training = model.origin.training_cameras
    plain = bake(model, training, growth=options.bake_growth, iterations=options.bake_iterations, progress=True)
    # The bake has not seen held-out cameras, so that they judge it fairly.
    held_out = model.origin.held_out_cameras
    views = evenly_chosen(held_out or training, MOST_VIEWS)
    likeness_db = likeness(pictures(plain, views), pictures(model, views))
    splats = counted(model.num, "splat")
    judged = counted(len(views), "held-out view" if held_out else "training view")
    return plain, (
        f"baked: {splats} into {plain.num:,} plain ones of SH degree {plain.gaussians.sh_degree}, "
        f"{plain.num_bytes / model.num_bytes:.2f} times the numbers' bytes, {likeness_db:.1f} dB against the model in "
        f"{judged}"
    )
