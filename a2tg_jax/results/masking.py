"""Masks of a run's photographs: where they show its subject, or what an edit keeps."""

import dataclasses
import warnings
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from PIL import Image

from a2tg_jax import Renderer, resize_camera
from a2tg_jax.base.text import counted
from a2tg_jax.data.load import SceneSource, names_below_images
from a2tg_jax.host.progress_bars import progress_over
from a2tg_jax.io.edit_file import Edit, kept_by, load_edit
from a2tg_jax.io.subject import find_subject
from a2tg_jax.render import with_features
from a2tg_jax.results.commands import next_to, training_command
from a2tg_jax.results.folder import RunFolder
from a2tg_jax.results.images import save_picture
from a2tg_jax.results.model_source import open_source
from a2tg_jax.results.output_paths import check_new, check_output
from a2tg_jax.results.record import read_record

LEAST_SHARE = 0.5
"""Smallest share of a pixel's light from what is kept with which the pixel is white."""


def write_masks(
    run: RunFolder, out: Path, edit: Path | None = None, name: str | None = None, *, overwrite: bool = False
) -> str:
    """Write a mask of each photograph of a run, as the folder `masks` of a scene has them, and return a summary.

    A mask is white where at least half of the light comes from the Gaussians that are kept. What hides them is black.
    It has the size and the lens of the photograph, which is drawn at the size of the training.

    Args:
      run: the run, whose photographs are in place.
      out: folder for NAME.jpg.png of NAME.jpg; photographs in subfolders have their masks in subfolders.
      edit: file of an edit that says what is kept; None: the subject.
      name: as in `open_source`.
      overwrite: replace masks that exist.

    Raises:
      ValueError: if the model has no subject, or training reads no masks for the photographs of this scene, such as a
        built-in one, or one whose photographs are not in a folder images.
      OSError: if photographs are missing, or a mask exists.
    """
    chosen = Edit(subject=True) if edit is None else load_edit(edit)
    record = read_record(run)
    if record.scene.is_built_in:
        raise ValueError(f"{record.scene.path} is a built-in scene, which reads no masks")
    check_output(out)
    source = open_source(run.path, name)
    model = source.model.live
    subject = find_subject(model) if chosen.subject else None
    is_kept = kept_by(model, chosen, subject)
    # Photographs as the files are: training undistorts and downscales masks as it does photographs.
    with warnings.catch_warnings():
        # Earlier masks may be missing, or black, which is an error where they are not the background.
        warnings.filterwarnings("ignore", ".*no photograph has a mask", UserWarning)
        photographs = SceneSource(record.scene.path, test_every=0, mask_as="background", lens="keep").load()
    viewmats = {} if model.origin is None else dict(zip(model.origin.names, model.origin.viewmats, strict=True))
    views = [view for view in (*photographs.train, *photographs.test) if view.name in viewmats]
    if not views:
        raise ValueError(f"{record.scene.path}: the model was trained on none of its photographs; give their run")
    names = names_below_images(Path(record.scene.path), [view.name for view in views])
    files = [out / f"{name}.png" for name in names]
    for file in files:
        check_new(file, "`out`", overwrite=overwrite)
    weights = jnp.asarray(is_kept[:, None], model.gaussians.means.dtype)
    appearance = with_features(model.appearance, weights, model.gaussians)
    shown = dataclasses.replace(model, appearance=appearance)
    renderer = Renderer(shown, background=(0.0,), settings=source.settings, has_geometry=False)
    covered = []
    for view, file in progress_over(list(zip(views, files, strict=True)), "masks", "mask"):
        size = view.camera.width, view.camera.height
        camera = dataclasses.replace(view.camera, viewmat=jnp.asarray(viewmats[view.name], jnp.float32))
        shares = renderer(resize_camera(camera, *(max(1, round(side / record.scene.downscale)) for side in size))).color
        full = Image.fromarray(np.asarray(shares[..., 0], np.float32)).resize(size, Image.Resampling.BILINEAR)
        is_white = np.asarray(full) >= LEAST_SHARE
        file.parent.mkdir(parents=True, exist_ok=True)
        save_picture(file, np.uint8(255) * is_white)
        covered.append(100 * is_white.mean())
    what = "what the edit keeps" if subject is None else f"the subject ({subject.words})"
    train = training_command(run, next_to(run, "subject"), "--mask-as", "background")
    return (
        f"wrote {counted(len(files), 'mask')} to {out}/: {what} covers {np.mean(covered):.0f} % of the photographs, "
        f"{min(covered):.0f} to {max(covered):.0f} % of each\n"
        f"train on it alone, with the masks as the folder masks of the scene: {train}"
    )
