"""The readers that files of strangers go through: for each the files of which one is changed, and how."""

import dataclasses
from collections.abc import Callable

import fuzz_mutate as mutate
from fuzz_commands import SYSTEMS

BINARY = (mutate.of_bytes,)
TEXT = (mutate.of_text, mutate.of_text, mutate.of_bytes)
JSON = (mutate.of_json, mutate.of_json, mutate.of_json, mutate.of_text, mutate.of_bytes)
ARCHIVE = (mutate.of_npz, mutate.of_npz, mutate.of_npz, mutate.of_bytes)
COLMAP = ("cameras", "images", "points3D")
OF_RUN = ("metrics.json", ".a2tg-run")
KSPLAT = ("0-degree1", "1-degree2", "2-degree2")
DEPTHS = ("depth", "confidence")
PICTURES = ("png", "jpg", "tif", "webp", "avif", "bmp", "gif", "ppm")


@dataclasses.dataclass(frozen=True)
class Reader:
    """What is changed, and how."""

    name: str
    files: tuple[str, ...]
    changes: tuple[Callable, ...]
    target: str
    """Key of `fuzz_targets.TARGETS`."""

    @property
    def folder(self) -> str:
        """Below that of all sound files; masks are those of a scene that is tried itself."""
        return "nerfstudio" if self.name == "masks" else self.name


READERS = (
    *(Reader("colmap", (f"sparse/0/{kind}.bin",), BINARY, "scene") for kind in COLMAP),
    Reader("colmap-text", tuple(f"sparse/0/{kind}.txt" for kind in COLMAP), TEXT, "scene"),
    Reader("nerfstudio", ("transforms.json",), JSON, "scene"),
    Reader("masks", ("masks/00.png", "masks/01.png", "images/00.png"), (mutate.of_bytes, mutate.of_png), "scene"),
    Reader("blender", ("transforms_train.json", "transforms_test.json"), JSON, "scene"),
    Reader("polycam", tuple(f"keyframes/corrected_cameras/{index}.json" for index in range(4)), JSON, "scene"),
    Reader("polycam", tuple(f"keyframes/{kind}/1.png" for kind in DEPTHS), (mutate.of_bytes, mutate.of_png), "scene"),
    Reader("record3d", ("metadata",), JSON, "scene"),
    Reader("metashape", ("cameras.xml",), TEXT, "scene"),
    Reader("realityscan", tuple(f"{index}.xmp" for index in range(4)), TEXT, "scene"),
    Reader("points", ("ascii.ply",), TEXT, "points"),
    Reader("points", ("little.ply", "big.ply"), BINARY, "points"),
    Reader("pictures", tuple(f"picture.{kind}" for kind in PICTURES), BINARY, "picture"),
    Reader("pictures", ("picture.png",), (mutate.of_png,), "picture"),
    Reader("models", ("a2tg.npz", "bytewise.npz", "supergaussians.npz", "bbsplat.npz"), ARCHIVE, "model"),
    Reader("compact", ("a2tg.a2tgz", "bytewise.a2tgz"), (mutate.of_compact, mutate.of_bytes), "compact"),
    Reader("checkpoints", ("a2tg.npz", "bytewise.npz", "gaussians-2d.npz"), ARCHIVE, "checkpoint"),
    Reader("gaussians", ("gaussians.ply", "third.ply", "big.ply", "packed.ply"), BINARY, "ply"),
    Reader("gaussians", ("ascii.ply",), TEXT, "ply"),
    Reader("ksplat", tuple(f"level{level}.ksplat" for level in KSPLAT), BINARY, "splats"),
    Reader("splats", ("scene.sog", "packed.sog"), (mutate.of_zip,) * 3 + (mutate.of_bytes,), "splats"),
    Reader("splats", ("meta.json",), JSON, "splats"),
    Reader("splats", ("scene.spz", "records.spz", "a.splat"), BINARY, "splats"),
    Reader("splats", ("gzip.spz",), (mutate.of_gzip, mutate.of_gzip, mutate.of_bytes), "splats"),
    Reader("gltf", ("a2tg.glb", "bytewise.glb", "spz.glb"), (mutate.of_glb, mutate.of_glb, mutate.of_bytes), "gltf"),
    Reader("gltf", ("a2tg.gltf",), JSON, "gltf"),
    Reader("lpips", ("squeeze.npz",), ARCHIVE, "lpips"),
    Reader("run", ("metrics.json",), JSON, "info"),
    Reader("run", ("history/a.csv",), TEXT, "history"),
    Reader("run", ("run.toml",), TEXT, "record"),
    Reader("run", (".a2tg-run",), TEXT, "marker"),
    Reader("commands", tuple(f"{name}/run.toml" for name in SYSTEMS), (mutate.of_toml,) * 3 + (mutate.of_text,), "run"),
    Reader("commands", tuple(f"{name}/{file}" for name in SYSTEMS[:2] for file in OF_RUN), (mutate.of_text,), "run"),
)  # fmt: skip
