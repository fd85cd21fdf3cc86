"""Export of a model: the viewer with a scene, for a web server or as one file, and Gaussians as PLY."""

import contextlib
import dataclasses
import json
from pathlib import Path

from a2tg_jax.finish.compaction import ASSUMED_PSNR, loss_beside_renders, loss_on_views
from a2tg_jax.host.atomic import replacing
from a2tg_jax.host.text import counted, in_bytes
from a2tg_jax.io.formats import lost_by
from a2tg_jax.io.ply import save_ply
from a2tg_jax.io.web_scene import decode_web_scene
from a2tg_jax.results.checks import check_new
from a2tg_jax.results.folder import read_json, remove_if_empty
from a2tg_jax.results.model_source import Source
from a2tg_jax.results.viewing import ServedPhotographs
from a2tg_jax.web.page import PHOTOGRAPHS_NAME, SCENE_NAME, photograph_name, viewer_html, viewer_html_with

MOST_VIEWS = 8
"""Largest number of views measured, evenly chosen."""


def check_page(out: Path, *, single_file: bool, photographs: bool, overwrite: bool) -> list[Path]:
    """Return the files of a page, photographs left out: one, or several in a folder. Arguments and errors as in
    `export_web`."""
    single_file = single_file or (out.suffix.lower() == ".html" and not out.is_dir())
    if single_file and photographs:
        raise ValueError("--photographs needs a folder: leave out --single-file, and .html at the end of --web")
    if single_file and out.is_dir():
        raise FileExistsError(f"{out} is a folder; with --single-file, --web must be the path of a file")
    if not single_file and out.is_file():
        raise FileExistsError(f"{out} is a file; choose a folder with --web, or a name that ends in .html for one file")
    if not single_file and (out / "index.html").exists() and not (out / SCENE_NAME).exists():
        raise ValueError(f"{out} holds a page other than the viewer's; choose another folder with --web")
    files = [out] if single_file else [out / name for name in ("index.html", SCENE_NAME, PHOTOGRAPHS_NAME)]
    for file in files:
        check_new(file, "--web", overwrite=overwrite)
    return files


def export_web(
    source: Source, out: Path, *, single_file: bool = False, photographs: bool = False, overwrite: bool = False
) -> str:
    """Write a page that shows a model: a folder for any web server, or one file that opens from the disk. Return a
    summary of the files, their size and the loss of the scene file.

    Args:
      source: the model.
      out: the folder, which is made; or the file. A name that ends in .html is a file's, unless there is such a folder.
      single_file: one file, whatever its name.
      photographs: into the folder go the cameras' photographs too.
      overwrite: whether existing files are replaced. Photographs of an earlier page that this one lacks are deleted.

    Raises:
      FileExistsError: if a folder is where a file is to be written, or a file where a folder is, or a file exists.
      ValueError: if browsers cannot show the model, or photographs are requested but missing, or requested in one file.
    """
    page, *others = check_page(out, single_file=single_file, photographs=photographs, overwrite=overwrite)
    data, old = source.encoded, set()
    if not others:
        files = {page: viewer_html_with(data).encode()}
    else:
        files = _files_of(source, out, photographs)
        for path in files:
            check_new(path, "--web", overwrite=overwrite)
        with contextlib.suppress(OSError, ValueError, TypeError):  # There may be no page.
            old = {out / photograph_name(int(index)) for index in read_json(out / PHOTOGRAPHS_NAME)}
    for path, content in files.items():
        with replacing(path) as temporary:
            temporary.write_bytes(content)
    for path in old - set(files):
        path.unlink(missing_ok=True)
        remove_if_empty(path.parent, out)
    model, size, total = source.model, len(data), sum(map(len, files.values()))
    ratio = f"1/{model.num_bytes / max(size, 1):.1f} of the model's {in_bytes(model.num_bytes)}"
    lines = [f"{model.num:,} Gaussians, whose scene takes {in_bytes(size)}, {ratio}"]
    lines += [f"{loss_text(loss)}, {measure}" for measure, loss in losses_of(source).items()]
    others_text = f" with {counted(len(files) - 1, 'file')} beside it" if others else ""
    return "\n".join([*lines, f"{page}: {in_bytes(total)}{others_text}"])


def _files_of(source: Source, out: Path, photographs: bool) -> dict[Path, bytes]:
    """Return the content of the files of a folder, the page last, so that it never shows what is not there yet."""
    files = {out / SCENE_NAME: source.encoded}
    views: list[int] = []
    if photographs:
        found = ServedPhotographs(source.model.origin, source.load_scene, source.model.background)
        if not found.views:
            raise ValueError("there are no photographs of the model's cameras: leave out --photographs")
        files |= {out / photograph_name(index): found.jpeg(index) or b"" for index in found.views}
        views = sorted(found.views)
    return {**files, out / PHOTOGRAPHS_NAME: json.dumps(views).encode(), out / "index.html": viewer_html().encode()}


def loss_text(loss: float) -> str:
    """Return a loss of PSNR in dB as "0.067 dB of PSNR lost", and a negative one as gained."""
    return f"{abs(loss):.3f} dB of PSNR {'gained' if loss < 0 else 'lost'}"


def losses_of(source: Source) -> dict[str, float]:
    """Return the loss of a scene file in dB of PSNR: on photographs, or else on renders; empty without cameras."""
    if not source.model.num:
        return {}
    settings = dataclasses.replace(source.settings, near_plane=source.near_plane)
    again = decode_web_scene(source.encoded).model
    scene = source.load_scene_or_warn()
    if scene is not None:
        views = {"training views": scene.train, "test views": scene.test}
        chosen = {name: found[:: -(-len(found) // MOST_VIEWS)] for name, found in views.items() if found}
        model = source.model
        return {name: loss_on_views(model, found, settings=settings)(again) for name, found in chosen.items()}
    cameras = [] if source.model.origin is None else source.model.origin.cameras
    if not cameras:
        return {}
    cameras = cameras[:: -(-len(cameras) // MOST_VIEWS)]
    loss = loss_beside_renders(source.model, cameras, settings=settings)(again)
    return {f"were it a model of {ASSUMED_PSNR:g} dB": loss}


def check_ply(out: Path) -> None:
    """Raise ValueError if `out` is a folder or has another suffix than ply."""
    if out.is_dir() or out.suffix.lower() != ".ply":
        raise ValueError(f"--ply must be the path of a file that ends in .ply; got {out}")


def export_ply(source: Source, out: Path, *, float64: bool = False) -> str:
    """Write the Gaussians of a model as programs for 3DGS read them, and return a summary, with what PLY does not keep.

    `float64` is as in `save_ply`.
    """
    out.parent.mkdir(parents=True, exist_ok=True)
    save_ply(out, source.model, float64=float64)
    lines = [f"file: {out}: {source.model.num:,} Gaussians"]
    if lost := lost_by(source.model, ".ply"):  # --bake is an option of another command.
        lines.append(f"not kept by this format: {', '.join(lost).replace('--bake', 'a2tg convert --bake')}")
    return "\n".join(lines)
