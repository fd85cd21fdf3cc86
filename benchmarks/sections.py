"""Cases of each section of the report."""

import argparse
import functools
import os
import subprocess
import sys
import tempfile

from benchmarks.runner import measure, measure_all

SIZES = ((320, 240), (640, 480))
NUMBERS = (2_000, 10_000, 50_000, 200_000)
LARGEST = 1_000_000
FULL_SIZE = (1600, 1060)
PIXELS = ((160, 120), (320, 240), (640, 480), (1280, 960))
TYPICAL = ((10_000, SIZES[0]), (50_000, SIZES[1]))
ALL = os.cpu_count() or 1
THREADS = (1, ALL)
MULTIPLY_ADDS = {"forward": 20, "both": 80}
"""Multiply-adds of a splat at a pixel: nine for the ray's plane, four for (u, v) and ρ, the rest for falloff, colour
and transmittance; the backward pass does this again and about twice as much for the derivatives."""


def render_section(args: argparse.Namespace) -> list[dict]:
    """Measure the random workload at two sizes, untextured and textured, with one thread and with all."""
    cases = [
        random_case(num, size, textures=kind, threads=threads)
        for size in SIZES
        for num in NUMBERS
        for kind in ("none", "mixed", "4x4")
        for threads in THREADS
    ]
    cases += [random_case(LARGEST, size, textures="none", threads=ALL) for size in SIZES]
    return measure_all(cases, args.largest)


def pixels_section(args: argparse.Namespace) -> list[dict]:
    """Measure the same Gaussians at growing image sizes."""
    cases = [random_case(10_000, size, textures="none", threads=threads) for size in PIXELS for threads in THREADS]
    return measure_all(cases, args.largest)


def full_size_section(args: argparse.Namespace) -> list[dict]:
    """Measure large scenes and large textures."""
    cases = [
        random_case(300_000, FULL_SIZE, textures="none", threads=ALL),
        random_case(LARGEST, FULL_SIZE, textures="none", threads=ALL),
        random_case(20_000, SIZES[1], textures="16x16", threads=ALL),
    ]
    return measure_all(cases, args.largest)


def stages_section(args: argparse.Namespace) -> list[dict]:
    """Measure the stages of a training step."""
    cases = [
        {**random_case(num, size, textures=kind, threads=threads), "case": "stages"}
        for num, size in TYPICAL
        for kind in ("none", "mixed")
        for threads in THREADS
    ]
    return measure_all(cases, args.largest)


def compositors_section(args: argparse.Namespace) -> list[dict]:
    """Measure native loops beside XLA, and tile sizes."""
    choices = ({"compositor": "xla"}, {"tile_size": 4}, {"tile_size": 8}, {"tile_size": 16}, {"tile_size": 32})
    cases = [random_case(10_000, SIZES[0], textures=kind, **choice) for kind in ("none", "mixed") for choice in choices]
    return measure_all(cases, args.largest)


def limit_section(args: argparse.Namespace) -> dict[str, list[dict]]:
    """Measure the multiply-adds of ten million pairs of a splat and a pixel, the best possible time."""
    return {
        name: [
            measure({"case": "limit", "multiply_adds": number, "pairs": 1e7, "threads": threads}) for threads in THREADS
        ]
        for name, number in MULTIPLY_ADDS.items()
    }


def training_section(args: argparse.Namespace) -> list[dict]:
    """Measure training steps on a real scene, first without compiled programs on disk and then with them."""
    if args.scene is None:
        return []
    found = []
    for downscale, num in ((4, 10_000), (2, 10_000), (2, 19_179), (1, 19_179)):
        case = {"case": "training", "scene": str(args.scene.resolve()), "downscale": downscale, "num": num}
        with tempfile.TemporaryDirectory() as folder:
            environment = {"XDG_CACHE_HOME": folder}
            for cache in ("cold", "warm"):
                one = {**case, "iterations": [200, 200], "cache": cache}
                found.append(measure(one, environment=environment))
    return found


def others_section(args: argparse.Namespace) -> list[dict]:
    """Measure other programs on the same workload, one thread, beside this library."""
    if not args.other:
        return []
    found = []
    for case in (random_case(num, size, threads=1) for num, size in TYPICAL if num <= args.largest):
        found.append(measure(case))
        found += [measure({**case, "case": name}, command) for name, command in args.other]
    return found


def gpu_section(args: argparse.Namespace) -> list[dict]:
    """Measure large scenes on a GPU, beside gsplat; nothing if JAX has no GPU."""
    if not device().startswith("gpu"):
        return []
    found = []
    for num in (100_000, 500_000, LARGEST):
        cases = [
            {**random_case(num, FULL_SIZE, textures=kind, tile_size=16), "case": case}
            for case in ("render", "step")
            for kind in ("none", "mixed")
        ]
        found += measure_all(cases, args.largest)
        if args.gsplat is not None and num <= args.largest:
            command = [args.gsplat, "-m", "benchmarks.gsplat"]
            found.append(measure({**random_case(num, FULL_SIZE), "case": "gsplat"}, command))
    return found


def random_case(num: int, size: tuple[int, int], **more: str | int) -> dict:
    """Return a case of the random workload."""
    return {"case": "render", "num": num, "width": size[0], "height": size[1], **more}


@functools.cache
def device() -> str:
    """Return JAX's default device, asked by another process: this one must leave a GPU's memory to the cases."""
    program = "import jax; device = jax.devices()[0]; print(device.platform, device.device_kind)"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    return done.stdout.strip()


SECTIONS = {
    "render": render_section,
    "pixels": pixels_section,
    "stages": stages_section,
    "limit": limit_section,
    "compositors": compositors_section,
    "full_size": full_size_section,
    "training": training_section,
    "others": others_section,
    "gpu": gpu_section,
}
