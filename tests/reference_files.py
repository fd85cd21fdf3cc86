"""The files that the reference readers are tried on: `python tests/reference_files.py tests/data`.

One small model in each published format, its numbers as text, and the checksums of all. They are kept as they were
written, for coders of later versions may code the same bytes otherwise.
"""

import dataclasses
import hashlib
import json
import sys
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from a2tg_jax import CompactChoices, load_compact, load_gltf, load_model, save_compact, save_gltf, save_model
from a2tg_jax.appearance import Appearance, Bands, Exponents, Texture
from a2tg_jax.appearance.parts import bands_of_dense, log_exponents_of
from a2tg_jax.core.cameras import Camera
from a2tg_jax.core.gaussians import Gaussians
from a2tg_jax.core.origin import Origin
from a2tg_jax.core.similarity import Similarity
from a2tg_jax.io.web_scene import encode_web_scene, rounded_model
from a2tg_jax.model import Model
from a2tg_jax.texture import textures_from_arrays

NUM = 10
BACKGROUND = 0.25, 0.5, 0.75
SUMS = "SHA256SUMS"
SIZES = [(0, 0), (1, 1), (2, 3), (4, 1)]
SHAPED = ("shaped.a2tgz", "shaped.a2tgw")
FILES = (
    "model.npz", "lzma.a2tgz", "zstd.a2tgz", "webp.a2tgz", "floats.a2tgz", "model.a2tgw", "model.glb", "bytes.glb",
    *SHAPED,
)  # fmt: skip
FLOATS = CompactChoices(
    means="float32", log_scales="float16", quats="float32", opacities="float32", sh_0="float16", texels="float32",
    coder="none",
)  # fmt: skip


def reference_model() -> Model:
    """Splats of all degrees, with textures of several sizes, in a world of its own."""
    rng = np.random.default_rng(11)
    draw = lambda *shape, scale=1.0: np.asarray(scale * rng.normal(size=shape), np.float32)  # noqa: E731
    textures = textures_from_arrays([draw(*SIZES[i % len(SIZES)], 4, scale=0.3) for i in range(NUM)])
    sh = draw(NUM, 16, 3, scale=0.4)
    bands = bands_of_dense(sh[:, 1:], np.arange(NUM) % 4, 0)
    gaussians = Gaussians(
        draw(NUM, 3), draw(NUM, 4), draw(NUM, 2, scale=0.5) - np.float32(2), draw(NUM), draw(NUM, 1, 3)
    )  # type: ignore[arg-type]
    viewmat = np.eye(4)
    viewmat[2, 3] = 4.0
    camera = Camera(viewmat, np.array([[60.0, 0, 32], [0, 60, 24], [0, 0, 1]]), 64, 48)  # type: ignore[arg-type]
    world = Similarity(0.5, np.eye(3)[[1, 2, 0]], np.array([1.0, 2.0, 3.0]))
    origin = Origin.of_cameras([camera], ["a.png"], transform=world)
    return Model(
        gaussians, Appearance(texture=Texture(textures), bands=Bands(bands)), background=BACKGROUND, origin=origin
    )


def shaped_model() -> Model:
    """The same splats with kernels from long tails to sharp edges."""
    model = reference_model()
    appearance = dataclasses.replace(model.appearance, exponents=Exponents(jnp.linspace(-3.0, 3.0, NUM)))
    return dataclasses.replace(model, appearance=appearance)


def load(path: Path) -> Model:
    """Read a file with this library, which only writes scenes for browsers."""
    if path.suffix == ".a2tgw":
        return rounded_model(shaped_model() if path.name in SHAPED else reference_model())
    return {".npz": load_model, ".a2tgz": load_compact, ".glb": load_gltf}[path.suffix](path)


def numbers(model: Model) -> dict[str, np.ndarray]:
    """Numbers that a reader must find, in the order of the file."""
    textures, shapes = model.textures, model.appearance.shapes
    fields = {name: getattr(model.gaussians, name) for name in ("means", "quats", "log_scales", "opacities")}
    found = fields | {"degrees": model.degrees, "sh": model.sh, "sizes": textures.sizes, "texels": textures.flat()}
    if shapes is not None:
        found["exponents"] = np.exp(log_exponents_of(shapes))
    return {name: np.asarray(values, np.float64) for name, values in found.items()}


def write(folder: Path) -> None:
    model = reference_model()
    save_model(folder / "model.npz", model)
    for coder in ("lzma", "zstd", "webp"):
        save_compact(folder / f"{coder}.a2tgz", model, choices=CompactChoices(coder=coder))
    save_compact(folder / "floats.a2tgz", model, choices=FLOATS)
    (folder / "model.a2tgw").write_bytes(encode_web_scene(model, title="reference"))
    save_gltf(folder / "model.glb", model)
    save_gltf(folder / "bytes.glb", model, texels="uint8")
    save_compact(folder / SHAPED[0], shaped_model(), choices=CompactChoices(coder="zstd"))
    (folder / SHAPED[1]).write_bytes(encode_web_scene(shaped_model(), title="shaped"))
    found = {name: numbers(load(folder / name)) for name in FILES}
    text = {name: {key: np.round(x, 6).ravel().tolist() for key, x in held.items()} for name, held in found.items()}
    kept = {name: held for name, held in text.items() if name in ("model.npz", "model.a2tgw")}
    kept[SHAPED[1]] = {"exponents": text[SHAPED[1]]["exponents"]}
    (folder / "numbers.json").write_text(json.dumps(kept) + "\n")
    (folder / SUMS).write_text("".join(f"{checksum(folder / name)}  {name}\n" for name in (*FILES, "numbers.json")))


def checksum(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


if __name__ == "__main__":
    write(Path(sys.argv[1]))
