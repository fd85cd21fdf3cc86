"""Files of `a2tg convert`, read by other programs and compared with the model.

    npm install --prefix OTHERS @playcanvas/splat-transform @mkkellogg/gaussian-splats-3d playcanvas \
        @sparkjsdev/spark three babylonjs babylonjs-loaders
    python -m benchmarks.readers scene.npz --others OTHERS --chromium chromium

Writes every format, reads each by splat-transform and some by GaussianSplats3D, and prints how far 99 % of the numbers
are off; has splat-transform write the formats that it can, and reads those; draws the view of a camera by PlayCanvas,
by Spark and, from glTF, by Babylon.js in a headless Chromium and prints the PSNR of their pictures beside ours.
"""

import argparse
import json
import subprocess
import tempfile
import warnings
from pathlib import Path

import numpy as np
from PIL import Image
from scipy.spatial import cKDTree

from a2tg_jax import Gaussians, Origin, Similarity, load_splats, save_splats
from a2tg_jax.core.sh import SH_C0
from a2tg_jax.finish.baking import pictures
from a2tg_jax.io.other_programs import upright
from benchmarks.readers.browser import Camera, draw

SUFFIXES = (".ply", ".compressed.ply", ".spz", ".sog", ".splat", ".ksplat")
BY_PLAYCANVAS = (".ply", ".compressed.ply", ".sog")
BY_GAUSSIAN_SPLATS_3D = (".ply", ".splat", ".ksplat")
WRITTEN_BY_SPLAT_TRANSFORM = (".compressed.ply", ".spz", ".sog")
CLI = "node_modules/@playcanvas/splat-transform/bin/cli.mjs"


def by_splat_transform(file: Path, others: Path) -> Gaussians:
    """Return the Gaussians of a file after splat-transform has written it as a PLY."""
    out = file.with_name(f"{file.name}.read.ply")
    transform(file, out, others)
    return load_splats(out).gaussians


def transform(file: Path, out: Path, others: Path) -> None:
    """Have splat-transform write a file in another format."""
    subprocess.run(["node", str(others / CLI), "-w", "-q", "-g", "cpu", str(file), str(out)], check=True)


def by_gaussian_splats_3d(file: Path, others: Path, degree: int) -> Gaussians:
    """Return the Gaussians that GaussianSplats3D reads, with colours and opacities as bytes and degrees up to 2."""
    script = Path(__file__).with_name("gaussian_splats_3d.mjs")
    command = ["node", "--no-deprecation", str(script), str(others), str(file), str(degree)]
    rows = np.array(json.loads(subprocess.run(command, check=True, capture_output=True).stdout))
    opacities = np.clip(rows[:, 13] / 255, 1e-6, 1 - 1e-6)
    sh = np.concatenate([(rows[:, 10:13] / 255 - 0.5) / SH_C0, rows[:, 14:]], axis=1).reshape(len(rows), -1, 3)
    return Gaussians(rows[:, :3], rows[:, 6:10], np.log(rows[:, 3:5]), np.log(opacities / (1 - opacities)), sh)


def differences(found: Gaussians, wanted: Gaussians) -> str:
    """Return how far 99 % of the numbers are off; rows are matched by the nearest means."""
    apart, rows = cKDTree(np.asarray(found.means)).query(np.asarray(wanted.means))
    found = found[rows]
    units = [x.quats / np.linalg.norm(x.quats, axis=1, keepdims=True) for x in (found, wanted)]
    degrees = 2 * np.degrees(np.arccos(np.clip(np.abs(np.sum(units[0] * units[1], axis=1)), 0, 1)))
    num = min(found.sh.shape[1], wanted.sh.shape[1])
    pairs = {
        "means": apart,
        "degrees": degrees,
        "log_scales": found.log_scales - wanted.log_scales,
        "opacities": found.opacities - wanted.opacities,
        "sh_0": found.sh[:, 0] - wanted.sh[:, 0],
        "sh_rest": found.sh[:, 1:num] - wanted.sh[:, 1:num],
    }
    told = [f"{name} {np.quantile(np.abs(x), 0.99):.1g}" if np.size(x) else f"{name} none" for name, x in pairs.items()]
    return f"{found.num:,} splats; {', '.join(told)}"


def psnr(image: np.ndarray, wanted: np.ndarray) -> float:
    return float(-10 * np.log10(np.mean((image / 255 - wanted) ** 2)))


def camera_in(world: Similarity, origin: Origin, index: int) -> Camera:
    """Return a camera of a model in another world, as browsers place it: y up, z backward."""
    viewmat = world.apply_to_viewmat(origin.viewmats[index])
    width, height = map(int, origin.sizes[index])
    return Camera(width, height, origin.Ks[index].tolist(), (np.linalg.inv(viewmat) @ np.diag([1, -1, -1, 1])).tolist())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("model", type=Path, help="plain model, with cameras (*.npz) for pictures")
    parser.add_argument("--others", type=Path, required=True, help="folder with node_modules of the programs")
    parser.add_argument("--chromium", help="command of Chromium; without it no pictures are drawn")
    parser.add_argument("--camera", type=int, default=0, help="index of the camera")
    parser.add_argument("--out", type=Path, help="folder of the files and pictures")
    chosen = parser.parse_args()
    warnings.simplefilter("ignore")
    model = load_splats(chosen.model)
    out = (chosen.out or Path(tempfile.mkdtemp())).resolve()
    out.mkdir(parents=True, exist_ok=True)
    for suffix in SUFFIXES:
        save_splats(out / f"scene{suffix}", model)
    wanted = load_splats(out / "scene.ply").gaussians
    for suffix in SUFFIXES:
        file = out / f"scene{suffix}"
        read = differences(by_splat_transform(file, chosen.others), wanted)
        print(f"{suffix}: {file.stat().st_size:,} bytes; splat-transform: {read}", flush=True)
        if suffix in BY_GAUSSIAN_SPLATS_3D:
            degree = 0 if suffix == ".splat" else min(wanted.sh_degree, 2)
            found = by_gaussian_splats_3d(file, chosen.others, degree)
            print(f"{suffix}: GaussianSplats3D: {differences(found, wanted)}", flush=True)
    for suffix in WRITTEN_BY_SPLAT_TRANSFORM:
        file = out / f"theirs{suffix}"
        transform(out / "scene.ply", file, chosen.others)
        found = load_splats(file).gaussians
        theirs = by_splat_transform(file, chosen.others)
        print(f"{suffix} by splat-transform, against the model: {differences(found, wanted)}")
        print(f"{suffix} by splat-transform, against its own reader: {differences(found, theirs)}", flush=True)
    if chosen.chromium is None or model.origin is None:
        return
    (ours,) = pictures(model, [model.origin.cameras[chosen.camera]])
    save_splats(out / "scene.glb", model)
    original = model.origin.transform.inverse()
    standing = upright(model.origin, "y")
    drawn = [("playcanvas", BY_PLAYCANVAS, original), ("spark", SUFFIXES, original), ("babylon", (".glb",), standing)]
    for page, suffixes, world in drawn:
        camera = camera_in(world, model.origin, chosen.camera)
        for suffix in suffixes:
            image = draw(page, out / f"scene{suffix}", camera, chosen.others, chosen.chromium)
            Image.fromarray(image).save(out / f"{page}{suffix}.png")
            print(f"{suffix}: {page} {psnr(image, ours):.1f} dB beside a2tg", flush=True)


if __name__ == "__main__":
    main()
