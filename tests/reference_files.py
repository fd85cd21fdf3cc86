"""The files that the reference readers are tried on: `python tests/reference_files.py tests/data`.

One small model in each published format, its numbers as text, and the checksums of all. Files of earlier versions are
kept as they were written.
"""

import dataclasses
import hashlib
import json
import sys
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from small_models import with_bands

from a2tg_jax import (
    Appearance,
    Camera,
    Exponents,
    Gaussians,
    Model,
    Origin,
    Similarity,
    Texture,
    load_compact,
    load_gltf,
    load_model,
    save_compact,
    textures_from_arrays,
)
from a2tg_jax.io.web_scene import encode_web_scene

NUM = 10
BACKGROUND = 0.25, 0.5, 0.75
SUMS = "SHA256SUMS"
SIZES = [(0, 0), (1, 1), (2, 3), (4, 1)]
SHAPED = "shaped-web.a2tgz"
OLD = ("model.npz", "lzma.a2tgz", "zstd.a2tgz", "webp.a2tgz", "floats.a2tgz", "shaped.a2tgz", "model.glb", "bytes.glb")
"""Files that versions up to 0.2 wrote."""
FILES = (*OLD, "smallest.a2tgz", "web.a2tgz", SHAPED)


def reference_model(has_alpha: bool = True) -> Model:
    """Splats of all degrees, with textures of several sizes, in a world of its own."""
    rng = np.random.default_rng(11)
    draw = lambda *shape, scale=1.0: np.asarray(scale * rng.normal(size=shape), np.float32)  # noqa: E731
    arrays = [draw(*SIZES[i % len(SIZES)], 4, scale=0.3) for i in range(NUM)]
    if not has_alpha:
        for array in arrays:
            array[..., 3] = 1.0
    textures = textures_from_arrays(arrays)
    sh = draw(NUM, 16, 3, scale=0.4)
    gaussians = Gaussians(
        draw(NUM, 3), draw(NUM, 4), draw(NUM, 2, scale=0.5) - np.float32(2), draw(NUM), draw(NUM, 1, 3)
    )  # type: ignore[arg-type]
    viewmat = np.eye(4)
    viewmat[2, 3] = 4.0
    camera = Camera(viewmat, np.array([[60.0, 0, 32], [0, 60, 24], [0, 0, 1]]), 64, 48)  # type: ignore[arg-type]
    world = Similarity(0.5, np.eye(3)[[1, 2, 0]], np.array([1.0, 2.0, 3.0]))
    origin = Origin.of_cameras([camera], ["a.png"], transform=world)
    model = Model(gaussians, Appearance(texture=Texture(textures)), background=BACKGROUND, origin=origin)
    return with_bands(model, sh[:, 1:], np.arange(NUM) % 4)


def shaped_model() -> Model:
    """The same splats with kernels from long tails to sharp edges, and textures of equal alpha factors."""
    model = reference_model(has_alpha=False)
    appearance = dataclasses.replace(model.appearance, exponents=Exponents(jnp.linspace(-3.0, 3.0, NUM)))
    return dataclasses.replace(model, appearance=appearance)


def load(path: Path) -> Model:
    return {".npz": load_model, ".a2tgz": load_compact, ".glb": load_gltf}[path.suffix](path)


def numbers(model: Model) -> dict[str, np.ndarray]:
    """Numbers that a reader must find, in the order of the file."""
    textures = model.textures
    shapes = model.appearance.shapes
    fields = {name: getattr(model.gaussians, name) for name in ("means", "quats", "log_scales", "opacities")}
    found = fields | {"degrees": model.degrees, "sh": model.sh, "sizes": textures.sizes, "texels": textures.flat()}
    if shapes is not None:
        found["exponents"] = np.exp(np.tanh(np.asarray(shapes, np.float64)))
    return {name: np.asarray(values, np.float64) for name, values in found.items()}


def write(folder: Path) -> None:
    """Write what today's program writes, into the folder of the old files."""
    model = reference_model()
    save_compact(folder / "smallest.a2tgz", model)
    (folder / "web.a2tgz").write_bytes(encode_web_scene(model, title="reference"))
    (folder / SHAPED).write_bytes(encode_web_scene(shaped_model(), title="shaped"))
    found = {name: numbers(load(folder / name)) for name in FILES}
    text = {name: {key: np.round(x, 6).ravel().tolist() for key, x in held.items()} for name, held in found.items()}
    kept = {name: held for name, held in text.items() if name in ("model.npz", "web.a2tgz")}
    kept[SHAPED] = {name: text[SHAPED][name] for name in ("exponents", "texels")}
    (folder / "numbers.json").write_text(json.dumps(kept) + "\n")
    (folder / SUMS).write_text("".join(f"{checksum(folder / name)}  {name}\n" for name in (*FILES, "numbers.json")))


def checksum(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


if __name__ == "__main__":
    write(Path(sys.argv[1]))
