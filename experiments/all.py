"""Every table and figure of the paper, and what was asked beyond it, in one go. The paper's claim comes first.

    python experiments/all.py --scenes SCENES --scale small --lpips-weights lpips_alex.npz

Stopped and called again, it goes on where it was. `--plan` tells what is left to do, and about how long it takes.
"""

import importlib

from lab.cli import EXPERIMENTS, main
from lab.pages import refresh

NAMES = (
    "claim", "texel_rate", "defaults", "ablation", "where_textures_pay", "fixed_memory", "texture_resolution",
    "fixed_number", "quick_preset", "memory_charts", "resolution_shares", "decomposition", "comparison_pictures",
    "equal_bytes", "upscale_gains", "polish", "shrink", "on_disk",
    "efficiency", "equal_bytes_speed",
)  # fmt: skip

PAGE = EXPERIMENTS.parent / "docs" / "results.md"
"""Shows tables of this folder's results."""

if __name__ == "__main__":
    lab = main([importlib.import_module(name).EXPERIMENT for name in NAMES], __doc__)
    if lab is not None and lab.out.resolve().parent == EXPERIMENTS / "results" and not lab.is_partial:
        refresh(PAGE, EXPERIMENTS)
