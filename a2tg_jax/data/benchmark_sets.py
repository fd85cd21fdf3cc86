"""Benchmark data sets: what they hold, and where their authors, or mirrors, offer them."""

from typing import NamedTuple

from a2tg_jax.data.download import Archive

GRESEARCH = "https://storage.googleapis.com/gresearch/refraw360"


class BenchmarkSet(NamedTuple):
    """A data set for `a2tg download`."""

    content: str
    """Content in a few words."""
    archive: Archive


BENCHMARK_SETS = {
    "mipnerf360": BenchmarkSet(
        "Mip-NeRF 360: bicycle, bonsai, counter, garden, kitchen, room, stump",
        Archive(f"{GRESEARCH}/360_v2.zip", "360_v2", 12_500_000_000),
    ),
    "mipnerf360-extra": BenchmarkSet(
        "Mip-NeRF 360: flowers, treehill", Archive(f"{GRESEARCH}/360_extra_scenes.zip", "360_v2")
    ),
    "tandt-db": BenchmarkSet(
        "3DGS's Tanks and Temples (train, truck) and Deep Blending (drjohnson, playroom)",
        Archive(
            "https://repo-sam.inria.fr/fungraph/3d-gaussian-splatting/datasets/input/tandt_db.zip", ".", 690_000_000
        ),
    ),
    "nerf-synthetic": BenchmarkSet(
        "NeRF's eight synthetic objects: chair, drums, ficus, hotdog, lego, materials, mic, ship",
        Archive(
            "https://github.com/yxlao/nerfmirror/releases/download/20220618/nerf_synthetic.zip",
            ".",
            sha256="f01fd1b4ab045b0d453917346f26f898657bb5bec4834b95fdad1f361826e45e",
        ),
    ),
    "dtu": BenchmarkSet(
        "15 scans of DTU, prepared for 2DGS, without the measured points",
        Archive("https://huggingface.co/datasets/dylanebert/2DGS/resolve/main/dtu.tar.gz", "dtu"),
    ),
}
"""Data sets by the name that is typed."""
