"""What the viewer's own tests read: a small scene with its numbers, and scenes with pictures of the JAX renderer.

    python tests/viewer_cases.py small web/test        # small.a2tgz, small.json and plain.a2tgz, which are committed

`write_case` writes a folder that web/browser/compare.test.ts compares the page with.
"""

import dataclasses
import json
import sys
from collections.abc import Sequence
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from small_files import model_in
from small_models import with_bands

from a2tg_jax import (
    Appearance,
    Camera,
    Exponents,
    Gaussians,
    Model,
    Origin,
    Renderer,
    RenderOutput,
    Texture,
    TextureOptions,
    textures_from_arrays,
)
from a2tg_jax.io.web_scene import encode_web_scene
from a2tg_jax.results.model_source import Source

NUM = 300
"""More than a chunk."""


def small_model(options: TextureOptions = TextureOptions()) -> Model:  # noqa: B008 - frozen
    """Random Gaussians of all degrees and many texture sizes, none among them."""
    rng = np.random.default_rng(7)
    draw = lambda *shape, scale=1.0: np.asarray(scale * rng.normal(size=shape), np.float32)  # noqa: E731
    sizes = [(0, 0), (1, 1), (2, 3), (4, 1), (5, 5)]
    textures = textures_from_arrays([draw(*sizes[i % 5], 4, scale=0.3) for i in range(NUM)])
    above = draw(NUM, 16, 3, scale=0.4)[:, 1:]
    degrees = rng.integers(0, 4, NUM)
    gaussians = Gaussians(
        draw(NUM, 3), draw(NUM, 4), draw(NUM, 2, scale=0.5) - np.float32(2), draw(NUM), draw(NUM, 1, 3)
    )  # type: ignore[arg-type]
    viewmat = np.eye(4)
    viewmat[2, 3] = 4.0
    camera = Camera(viewmat, np.array([[60.0, 0, 32], [0, 60, 24], [0, 0, 1]]), 64, 48)  # type: ignore[arg-type]
    origin = Origin.of_cameras([camera], ["<b>a</b>.png"])
    appearance = Appearance(texture=Texture(textures, options=options))
    return with_bands(Model(gaussians, appearance, background=(0.25, 0.5, 0.75), origin=origin), above, degrees)


def shaped_model() -> Model:
    """The same Gaussians with kernels of every exponent from 1/e, with long tails, to e, with a sharp edge."""
    model = small_model()
    shapes = np.arctanh(np.linspace(-1, 1, NUM) * (1 - 1e-6))
    exponents = Exponents(jnp.asarray(np.random.default_rng(8).permutation(shapes), jnp.float32))
    return dataclasses.replace(model, appearance=dataclasses.replace(model.appearance, exponents=exponents))


def plain_model() -> Model:
    """Forty of these Gaussians without textures, before three cameras."""
    model = small_model()
    cameras = []
    for distance in (4.0, 5.0, 6.0):
        viewmat = np.eye(4)
        viewmat[2, 3] = distance
        cameras.append(dataclasses.replace(model.origin.cameras[0], viewmat=viewmat))
    origin = Origin.of_cameras(cameras, ["a.png", "b.png", "c.png"])
    return Model(jax.tree.map(lambda x: x[:40], model.gaussians), origin=origin)


def write_small(folder: Path) -> None:
    """A scene's file, and what is in it."""
    source = Source(small_model(), "small", "a note")
    (folder / "small.a2tgz").write_bytes(source.encoded)
    (folder / "small.json").write_text(json.dumps(small_numbers(source.model)) + "\n")
    (folder / "plain.a2tgz").write_bytes(Source(plain_model(), "plain").encoded)


def small_numbers(model: Model) -> dict[str, list]:
    """What a reader must find in the file, rounded, by row."""
    model = model_in(encode_web_scene(model))
    found = {
        "means": model.gaussians.means,
        "log_scales": model.gaussians.log_scales,
        "quats": model.gaussians.quats,
        "opacities": model.gaussians.opacities,
        "degrees": model.degrees,
        "sizes": model.textures.sizes,
        "sh": model.sh[:40],
        "texels": model.textures.flat()[:400],
    }
    return {name: np.round(np.asarray(array, np.float64), 5).ravel().tolist() for name, array in found.items()}


def write_case(
    folder: Path,
    source: Source,
    cameras: Sequence[Camera],
    modes: Sequence[str] = ("full",),
    of: Sequence[str] = ("the model", "the file"),
) -> None:
    """A scene, its views, and of each the colours that the JAX renderer gives the model itself, from which the file is
    made, and those of what the file holds."""
    folder.mkdir(parents=True)
    (folder / "scene.a2tgz").write_bytes(source.encoded)
    settings = dataclasses.replace(source.settings, near_plane=source.near_plane)
    models = {"the model": source.model, "the file": model_in(source.encoded)}
    views = []
    for name in of:
        for mode in modes:
            model = models[name]
            shown = without_textures(model) if mode == "plain" else model
            renderer = Renderer(shown, cameras=cameras, settings=settings, has_geometry=mode in ("depth", "normals"))
            for camera in cameras:
                _picture(renderer(camera), mode).tofile(folder / f"{len(views)}.f32")
                views.append(_view(camera, mode, name))
    described = {"background": list(source.model.background), "views": views}
    (folder / "views.json").write_text(json.dumps(described))


def _picture(output: RenderOutput, mode: str) -> np.ndarray:
    """[H, W, 3] float32: what the page draws in a mode, before it is put on the screen."""
    shown = output.color
    if mode == "depth":
        shown = np.repeat(np.asarray(output.depth)[..., None], 3, axis=2)
    elif mode == "normals":
        shown = 0.5 * (np.asarray(output.alpha)[..., None] + np.asarray(output.normal))
    return np.asarray(shown, "<f4")


def without_textures(model: Model) -> Model:
    """The Gaussians alone."""
    return dataclasses.replace(model, appearance=Appearance(max_alpha=model.appearance.alpha_limit))


def _view(camera: Camera, mode: str, of: str) -> dict:
    return {
        "viewmat": np.asarray(camera.viewmat, np.float64).ravel().tolist(),
        "K": np.asarray(camera.K, np.float64).ravel().tolist(),
        "size": [camera.width, camera.height],
        "mode": mode,
        "of": of,
    }


if __name__ == "__main__":
    write_small(Path(sys.argv[2]))
