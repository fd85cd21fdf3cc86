"""Rows and bytes that travel between devices in one rendering and its gradient, counted on one device.

    python -m benchmarks.scaling --out benchmarks/results/scaling.json

The random scene of the other benchmarks at 1600×1060 pixels, spread over 1 to 64 devices, which draw one view together,
or as many views at once as there are devices. A device sends a fixed number of rows to each other one, the largest that
any pair needs; the least that must travel are the rows that reach a band which another device owns. Gradients come back
in the same rows. Pixels of bands travel to the devices of an even cut, and their gradients back, in as many rows of
pixels as the largest move of a border needs.

The second scene is the same with a sky: of the Gaussians in the upper 30 % of the image six in seven are left out. For
both the pairs of the fullest band, divided by the mean, are counted for bands with moved borders and for equally high
ones.

    python -m benchmarks.scaling --train 2000000 --memory-gb 12 --out benchmarks/results/scaling_training.json

This trains so many Gaussians for some steps on several devices of this CPU, and fails if that takes more memory.
"""

import argparse
import json
import math
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import a2tg_jax as a2tg
from a2tg_jax.core.budget import BYTES_PER_FLOAT
from a2tg_jax.core.gaussians import floats_per_gaussian
from a2tg_jax.core.geometry import NEAR_PLANE, screen_bounds
from a2tg_jax.io.config_json import changed_config
from a2tg_jax.parallel.exchange import BorderRoom, ImageBands
from a2tg_jax.rasterize.splats import drawn_splats
from a2tg_jax.rasterize.tiles import Rectangles, TileGrid, tile_rectangles
from a2tg_jax.systems.baselines import Gaussians2dMcmc
from benchmarks.timing import memory_peak
from benchmarks.workload import random_scene
from experiments.lab.markdown import table as markdown

NUMS = (100_000, 1_000_000, 4_000_000)
DEVICES = (1, 2, 4, 8, 16, 64)
WIDTH = 1600
HEIGHT = 1060
SPLAT, PROBE, CUTOFF = 9 + 1 + 3 + 3, 4, 1
"""Numbers of a travelling row: homography, opacity, colour and normal of a splat; its statistic, and its cutoff."""
CHANNELS = 4
"""Numbers of a pixel that travel: its colour and its transmittance."""
SKY, KEPT_IN_SKY = 0.3, 7
"""Share of the image that is sky; of so many Gaussians in it one is kept."""
STATES = 4
"""Parameters, their gradients, and the two moments of Adam."""


def row_bytes() -> tuple[int, int]:
    """Return the bytes of a travelling row, and of its gradient."""
    splat = SPLAT + PROBE
    return BYTES_PER_FLOAT * (splat + CUTOFF), BYTES_PER_FLOAT * splat


def boxes_of(num: int, grid: TileGrid, has_sky: bool) -> Rectangles:
    """Return the tiles that the Gaussians of a scene cover; those left out of a sky cover none."""
    gaussians, camera = random_scene(num, WIDTH, HEIGHT)

    def covered(gaussians: a2tg.Gaussians, camera: a2tg.Camera) -> Rectangles:
        M, cutoff = drawn_splats(gaussians, camera, a2tg.Appearance(), None)
        return tile_rectangles(screen_bounds(M, cutoff, NEAR_PLANE), grid)

    boxes = jax.jit(covered)(gaussians, camera)
    if not has_sky:
        return boxes
    is_shown = (jnp.arange(num) % KEPT_IN_SKY == 0) | (boxes.y0 >= math.ceil(SKY * grid.rows))
    return boxes._replace(counts=jnp.where(is_shown, boxes.counts, 0))


def fullest(bands: ImageBands, pairs: jax.Array, borders: jax.Array) -> float:
    """Return the pairs of the fullest band, divided by the mean."""
    own = np.asarray(bands.sums(pairs, borders))
    return float(own.max() / own.mean())


def pixel_bytes(bands: ImageBands) -> int:
    """Return the bytes of the pixels that devices send to each other for a view, and of their gradients."""
    rows = sum(hop.rows * (bands.num - abs(hop.bands)) for hop in bands.hops() if hop.bands)
    return 2 * BYTES_PER_FLOAT * CHANNELS * WIDTH * rows


def rows_between(bands: ImageBands, boxes: Rectangles, borders: jax.Array, devices: int) -> np.ndarray:
    """Return [bands, devices] the rows that each device sends to each band."""
    return np.asarray(bands.reached(boxes, borders)).reshape(bands.num, devices, -1).sum(axis=2)


def counted(num: int, devices: int, views: int, has_sky: bool) -> dict[str, float | str]:
    """Return the counts of one rendering of `num` Gaussians, beside those of `views` − 1 others that are alike."""
    num = num // devices * devices
    bands = ImageBands.of(TileGrid(WIDTH, HEIGHT, 8), devices // views)
    boxes = boxes_of(num, bands.whole, has_sky)
    pairs = bands.pairs_of_rows(boxes)
    borders = bands.borders(pairs)
    bands = ImageBands.of(bands.whole, bands.num, BorderRoom(*bands.room_for(borders).tolist()))
    height = -(-bands.whole.rows // bands.num)
    even = jnp.minimum(jnp.arange(bands.num + 1, dtype=jnp.int32) * height, bands.whole.rows)
    per_pair, of_even_bands = (rows_between(bands, boxes, own, devices) for own in (borders, even))
    least = per_pair.sum() - np.trace(per_pair)
    forward, back = row_bytes()
    row = bands.num * (devices - 1) * (forward + back)
    return {
        "scene": "random, with a sky" if has_sky else "random",
        "gaussians": num,
        "devices": devices,
        "views_at_once": views,
        "state_bytes_per_device": BYTES_PER_FLOAT * STATES * floats_per_gaussian(3) * num / devices,
        "rows_received": float(per_pair.sum(axis=1).max()),
        "least_bytes": float(least * (forward + back)),
        "row_bytes": float(per_pair.max() * row),
        "row_bytes_of_even_bands": float(of_even_bands.max() * row),
        "pixel_bytes": float(pixel_bytes(bands)),
        "copies_per_splat": float(per_pair.sum() / max(1, (boxes.counts > 0).sum())),
        "fullest_band": fullest(bands, pairs, borders),
        "fullest_of_even_bands": fullest(bands, pairs, even),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--largest", type=int, default=NUMS[-1], help="largest number of Gaussians")
    parser.add_argument("--train", type=int, metavar="N", help="train N Gaussians")
    parser.add_argument("--devices", type=int, default=4, help="devices of the CPU that train them")
    parser.add_argument("--steps", type=int, default=50)
    parser.add_argument("--memory-gb", type=float, default=12.0, help="memory that the training may take")
    args = parser.parse_args()
    if args.train:
        jax.config.update("jax_num_cpu_devices", args.devices)
        trained = training(args.train, args.steps)
        args.out.write_text(json.dumps(trained, indent=1) + "\n", encoding="utf-8")
        print(trained)
        if trained["peak_gb"] > args.memory_gb:
            sys.exit(f"the training took {trained['peak_gb']:.1f} GB, more than {args.memory_gb:g} GB")
        return
    found = [
        counted(num, devices, views, has_sky)
        for has_sky in (False, True)
        for num in NUMS
        if num <= args.largest
        for devices in DEVICES
        for views in sorted({1, devices})
    ]
    args.out.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
    print(table(found))


def training(num: int, steps: int) -> dict[str, float]:
    """Return the time and the memory of a training of `num` Gaussians on all devices, at 128×96 pixels."""
    scene = a2tg.synthetic_scene(num_views=9, width=128, height=96, num_points=num)
    changes = {"initial_gaussians": num, "densify": {"cap": num}, "stage1_iterations": steps}
    own = changed_config(Gaussians2dMcmc.preset("smoke"), changes, "here")
    result = a2tg.fit(scene, own, session=a2tg.Session(devices=jax.devices()))
    paces = np.diff(result.history.seconds) / np.diff(result.history.iteration)
    return {
        "gaussians": result.model.num,
        "devices": len(jax.devices()),
        "steps": steps,
        "first_loss": float(result.history.loss[0]),
        "last_loss": float(result.history.loss[-1]),
        "seconds_a_step": float(np.median(paces)),
        "state_gb": BYTES_PER_FLOAT * STATES * floats_per_gaussian(own.initial_sh_degree) * num / 1e9,
        "peak_gb": memory_peak() / 1e9,
    }


def table(found: Sequence[Mapping[str, Any]]) -> str:
    """Return a row for each case; bytes are of one view."""
    rows = []
    for row in found:
        names = "state_bytes_per_device", "row_bytes", "least_bytes", "pixel_bytes"
        state, *travelling = (f"{row[name] / 1e6:,.0f} MB" for name in names)
        counts = (f"{row[name]:,.0f}" for name in ("gaussians", "devices", "views_at_once"))
        balance = (f"{row[name]:.2f}" for name in ("fullest_of_even_bands", "fullest_band"))
        rows.append([row["scene"], *counts, state, *balance, f"{row['rows_received']:,.0f}", *travelling])
    header = [
        "scene", "Gaussians", "devices", "views at once", "state on a device", "fullest, equally high", "fullest",
        "rows received", "rows sent by all", "least", "pixels sent by all",
    ]  # fmt: skip
    return markdown(header, rows)


if __name__ == "__main__":
    main()
