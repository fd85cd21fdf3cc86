"""Export of the viewer with a scene, for a web server or as one file, and the loss of its scene file."""

import dataclasses
import json
from collections.abc import Mapping
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from a2tg_jax.core.cameras import Camera
from a2tg_jax.finish.compaction import ASSUMED_PSNR, loss_beside_renders, loss_on_views
from a2tg_jax.host.atomic import replacing
from a2tg_jax.host.text import counted, in_bytes
from a2tg_jax.io.web_scene import decode_web_scene
from a2tg_jax.model import Model
from a2tg_jax.results.checks import check_new
from a2tg_jax.results.folder import read_json, remove_if_empty
from a2tg_jax.results.viewing import ServedPhotographs, Source, middle_of, scene_or_warning
from a2tg_jax.web.page import PHOTOGRAPHS_NAME, SCENE_NAME, photograph_name, viewer_html, viewer_html_with

MOST_VIEWS = 8
"""Largest number of views measured, evenly chosen."""
RING_SIZE = (320, 240)


@dataclasses.dataclass(frozen=True)
class Exported:
    """Files of an export."""

    path: Path
    """Path of the page."""
    num_bytes: int
    """Bytes of the scene alone."""
    num_files: int
    total_bytes: int
    """Bytes of all files."""
    model: Model
    losses: Mapping[str, float]
    """Loss of the scene file in dB of PSNR, by what it is measured on."""


def export_web(
    source: Source, out: Path, *, single_file: bool = False, photographs: bool = False, overwrite: bool = False
) -> Exported:
    """Write a page that shows a model: a folder for any web server, or one file that opens from the disk.

    Args:
      source: the model.
      out: the folder, which is made; or the file. A name that ends in .html is a file's, unless a folder lies there.
      single_file: one file, whatever its name.
      photographs: into the folder go the cameras' photographs too.
      overwrite: whether existing files are replaced. Photographs of an earlier page that this one lacks are deleted.

    Raises:
      FileExistsError: if a folder is wanted where a file lies, or a file where a folder lies, or a file exists.
      ValueError: if browsers cannot show the model, or photographs are requested but missing, or requested in one file.
    """
    single_file = check_page(out, single_file=single_file, photographs=photographs)
    data = source.encoded
    files = {out: viewer_html_with(data).encode()} if single_file else _files_of(source, out, photographs)
    for path in files:
        check_new(path, "--web", overwrite=overwrite)
    old = set() if single_file else set(_photographs_in(out))
    for path, content in files.items():
        with replacing(path) as temporary:
            temporary.write_bytes(content)
    for path in old - set(files):
        path.unlink(missing_ok=True)
        remove_if_empty(path.parent, out)
    page, total = out if single_file else out / "index.html", sum(map(len, files.values()))
    return Exported(page, len(data), len(files), total, source.model, _losses_of(source))


def check_page(out: Path, *, single_file: bool, photographs: bool) -> bool:
    """Return whether the page is to be one file. Arguments and errors are those of `export_web`."""
    single_file = single_file or (out.suffix.lower() == ".html" and not out.is_dir())
    if single_file and photographs:
        raise ValueError("--photographs needs a folder: leave out --single-file, and .html at the end of --web")
    if single_file and out.is_dir():
        raise FileExistsError(f"{out} is a folder; with --single-file, --web must be the path of a file")
    if not single_file and out.is_file():
        raise FileExistsError(f"{out} is a file; choose a folder with --web, or a name that ends in .html for one file")
    if not single_file and (out / "index.html").exists() and not (out / SCENE_NAME).exists():
        raise ValueError(f"{out} holds a page other than the viewer's; choose another folder with --web")
    return single_file


def page_files(out: Path, *, single_file: bool) -> list[Path]:
    """Return the files of a page, photographs left out."""
    return [out] if single_file else [out / name for name in ("index.html", SCENE_NAME, PHOTOGRAPHS_NAME)]


def _photographs_in(folder: Path) -> list[Path]:
    """Return the photographs that the page in a folder lists; none without a page."""
    try:
        return [folder / photograph_name(int(index)) for index in read_json(folder / PHOTOGRAPHS_NAME)]
    except (OSError, ValueError, TypeError):
        return []


def _files_of(source: Source, out: Path, photographs: bool) -> dict[Path, bytes]:
    files = {out / SCENE_NAME: source.encoded}
    views: list[int] = []
    if photographs:
        found = ServedPhotographs(source.model.origin, source.load_scene, source.model.background)
        if not found.views:
            raise ValueError("there are no photographs of the model's cameras: leave out --photographs")
        files |= {out / photograph_name(index): found.jpeg(index) or b"" for index in found.views}
        views = sorted(found.views)
    files[out / PHOTOGRAPHS_NAME] = json.dumps(views).encode()
    return files | {out / "index.html": viewer_html().encode()}


def exported_text(result: Exported) -> str:
    """Return a summary of the files written, their size and their loss."""
    model, size = result.model, result.num_bytes
    ratio = f"1/{model.num_bytes / max(size, 1):.1f} of the model's {in_bytes(model.num_bytes)}"
    lines = [f"{model.num:,} Gaussians, whose scene takes {in_bytes(size)}, {ratio}"]
    lines += [f"{loss_told(loss)}, {measure}" for measure, loss in result.losses.items()]
    beside = "" if result.num_files == 1 else f" with {counted(result.num_files - 1, 'file')} beside it"
    lines.append(f"{result.path}: {in_bytes(result.total_bytes)}{beside}")
    return "\n".join(lines)


def loss_told(loss: float) -> str:
    """Return a loss of PSNR in dB as "0.067 dB of PSNR lost", and a negative one as gained."""
    return f"{abs(loss):.3f} dB of PSNR {'gained' if loss < 0 else 'lost'}"


def _losses_of(source: Source) -> dict[str, float]:
    """Return the loss of the file: on photographs if there are any, otherwise beside renders."""
    if not source.model.num:
        return {}
    settings = dataclasses.replace(source.settings, near_plane=source.near_plane)
    again = decode_web_scene(source.encoded).model
    scene = scene_or_warning(source.load_scene)
    if scene is not None:
        views = {"training views": scene.train, "test views": scene.test}
        chosen = {name: found[:: -(-len(found) // MOST_VIEWS)] for name, found in views.items() if found}
        model = source.model
        return {name: loss_on_views(model, found, settings=settings)(again) for name, found in chosen.items()}
    cameras = ([] if source.model.origin is None else source.model.origin.cameras) or _ring(source.model)
    cameras = cameras[:: -(-len(cameras) // MOST_VIEWS)]
    loss = loss_beside_renders(source.model, cameras, settings=settings)(again)
    return {f"were it a model of {ASSUMED_PSNR:g} dB": loss}


def _ring(model: Model) -> list[Camera]:
    """Return cameras around the middle of a model that has none."""
    centre, radius = middle_of(model)
    width, height = RING_SIZE
    K = np.array([[width, 0, width / 2], [0, width, height / 2], [0, 0, 1]])
    cameras = []
    for angle in np.arange(MOST_VIEWS) * (2 * np.pi / MOST_VIEWS):
        forward = np.array([np.sin(angle), 0.0, np.cos(angle)])
        right = np.array([np.cos(angle), 0.0, -np.sin(angle)])
        viewmat = np.eye(4)
        viewmat[:3, :3] = np.stack([right, [0.0, 1.0, 0.0], forward])
        viewmat[:3, 3] = viewmat[:3, :3] @ (2.5 * radius * forward - centre)
        cameras.append(Camera(jnp.asarray(viewmat, jnp.float32), jnp.asarray(K, jnp.float32), width, height))
    return cameras
