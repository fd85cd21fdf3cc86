"""Pages that show models in a browser, written as files: a folder for a web server, or one file."""

import contextlib
import dataclasses
import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from a2tg_jax import Origin
from a2tg_jax.base.atomic import is_left_over, left_over, write_whole
from a2tg_jax.base.json_text import read_json
from a2tg_jax.base.text import counted, in_bytes
from a2tg_jax.io.compact import decode_model
from a2tg_jax.io.other_programs import matrix_of
from a2tg_jax.results.compression import loss_measures
from a2tg_jax.results.folder import remove_if_empty
from a2tg_jax.results.model_source import Source
from a2tg_jax.results.output_paths import check_new
from a2tg_jax.results.report import loss_text
from a2tg_jax.results.viewing import CameraPhotographs
from a2tg_jax.web.page import (
    PHOTOGRAPHS_NAME,
    SCENE_NAME,
    comparison_html,
    photograph_name,
    viewer_html,
    viewer_html_with,
)


def check_page(out: Path, *, single_file: bool, photographs: bool, overwrite: bool) -> list[Path]:
    """Return the files of a page except photographs: one, or several in a folder. Arguments and errors as in
    `export_web`."""
    if single_file or (out.suffix.lower() == ".html" and not out.is_dir()):
        if photographs:
            raise ValueError("`photographs` needs a folder: leave out `single_file`, and .html at the end of `web`")
        if out.is_dir():
            raise FileExistsError(f"{out} is a folder; with `single_file`, `web` must be the path of a file")
        files = [out]
    else:
        if out.is_file():
            raise FileExistsError(
                f"{out} is a file; choose a folder with `web`, or a name that ends in .html for one file"
            )
        # An index.html without a scene next to it is not this program's.
        if (out / "index.html").exists() and not (out / SCENE_NAME).exists():
            raise ValueError(f"{out} holds a page other than the viewer's; choose another folder with `web`")
        files = [out / name for name in ("index.html", SCENE_NAME, PHOTOGRAPHS_NAME)]
    for file in files:
        check_new(file, "`web`", overwrite=overwrite)
    return files


def export_web(
    source: Source, out: Path, *, single_file: bool = False, photographs: bool = False, overwrite: bool = False
) -> str:
    """Write a page that shows a model, and return a summary of its files, their size and the loss of the scene file.

    The page is a folder for any web server, or one file that opens from the disk: with `single_file`, or if its name
    ends in .html and no such folder exists. `photographs` adds the cameras' photographs to the folder; with
    `overwrite`, photographs of an earlier page that this one lacks are deleted.

    Raises:
      FileExistsError: if a file exists, or is in the place of a folder or the reverse.
      ValueError: if browsers cannot show the model, or photographs are missing or requested in one file.
    """
    page, *others = check_page(out, single_file=single_file, photographs=photographs, overwrite=overwrite)
    if not others:
        html = viewer_html_with(source.encoded).encode()
        write_whole(page, html)
        return "\n".join([*_scene_lines(source), f"{page}: {in_bytes(len(html))}"])
    pictures = _jpegs(source) if photographs else {}
    files = {out / photograph_name(index): jpeg for index, jpeg in pictures.items()}
    files[out / SCENE_NAME] = source.encoded
    files[out / PHOTOGRAPHS_NAME] = json.dumps(list(pictures)).encode()
    files[page] = viewer_html(is_exported=True).encode()  # Last, so that the page never refers to missing files.
    for path in files:
        check_new(path, "`web`", overwrite=overwrite)
    old: set[Path] = set()
    with contextlib.suppress(OSError, ValueError, TypeError):  # There may be no page.
        old = {out / photograph_name(int(index)) for index in read_json(out / PHOTOGRAPHS_NAME)}
    # Photographs that a killed export left half written: the folder may be uploaded as a whole.
    for partial, whole in left_over((out / photograph_name(0)).parent).items():
        if whole.suffix == ".jpg" and is_left_over(partial):
            old.add(partial)
    # Nothing is written until all files are checked and all contents made.
    for path, content in files.items():
        write_whole(path, content)
    for path in old - set(files):
        path.unlink(missing_ok=True)
        remove_if_empty(path.parent, out)
    size = in_bytes(sum(map(len, files.values())))
    return "\n".join([*_scene_lines(source), f"{page}: {size} with {counted(len(files) - 1, 'file')} next to it"])


def _jpegs(source: Source) -> dict[int, bytes]:
    """Return the photographs of a model's cameras by index. Raises ValueError if there are none."""
    photographs = CameraPhotographs(source.model.origin, source.load_scene, source.model.background)
    if not photographs.views:
        raise ValueError("there are no photographs of the model's cameras: leave out `photographs`")
    return {index: photographs.jpeg(index) or b"" for index in sorted(photographs.views)}


def _scene_lines(source: Source) -> list[str]:
    """Return lines about the scene file of a page: its size and its loss."""
    model = source.model
    size = len(source.encoded)
    ratio = f"1/{model.num_bytes / max(size, 1):.1f} of the model's {in_bytes(model.num_bytes)}"
    lines = [f"{counted(model.num, 'Gaussian')}, whose scene takes {in_bytes(size)}, {ratio}"]
    if model.num:
        # The page's near plane.
        settings = dataclasses.replace(source.settings, near_plane=source.near_plane)
        decoded = decode_model(source.encoded)
        for measure, loss_of in loss_measures(model, source.load_scene_or_warn(), settings).items():
            lines.append(f"{loss_text(loss_of(decoded))}, {measure}")
    return lines


def export_comparison(sources: Sequence[Source], out: Path, *, overwrite: bool = False) -> str:
    """Write a page that shows two models with one camera and a divider, and return a summary.

    Raises:
      FileExistsError: if the file exists.
      ValueError: if it does not end in .html, or the models are not in one world.
    """
    if out.suffix.lower() != ".html":
        raise ValueError(f"`out` must be the path of a file that ends in .html; got {out}")
    check_new(out, "`out`", overwrite=overwrite)
    first, second = sources
    if not np.allclose(_world(first), _world(second), rtol=1e-6, atol=1e-4):
        raise ValueError(f"{first.path} and {second.path} are in different worlds: give models of one scene")
    titles = [_place_of(source.path) for source in sources]
    if titles[0] == titles[1]:
        titles = [str(source.path) for source in sources]
    scenes = [(title, source.encoded) for title, source in zip(titles, sources, strict=True)]
    page = comparison_html(*scenes).encode()
    write_whole(out, page)
    return f"{out}: {in_bytes(len(page))}, {' against '.join(titles)}"


def _world(source: Source) -> np.ndarray:
    """Return the way of a model's world to the original one [4, 4]."""
    origin = source.model.origin or Origin.of_cameras([])
    return matrix_of(origin.transform)


def _place_of(path: Path) -> str:
    """Return the run and the model of a run's file, or the name of another file."""
    path = path.absolute()
    return f"{path.parent.parent.name} · {path.stem}" if path.parent.name == "models" else path.name
