"""Output folders of other programs that train splats: their newest model, and the scene it was trained on."""

import re
from pathlib import Path
from typing import NamedTuple

from a2tg_jax.base.regular_files import is_regular, read_regular

MODELS = (
    ("3DGS", "point_cloud/iteration_*/point_cloud.ply"), ("3DGS", "iteration_*/point_cloud.ply"),
    ("gsplat", "ply/point_cloud_*.ply"), ("gsplat", "ckpts/ckpt_*.pt"),
    ("nerfstudio", "nerfstudio_models/step-*.ckpt"),
)  # fmt: skip
"""Programs, with the pattern of the files of their models below the output folder."""
ARGUMENTS = "cfg_args"
"""File of 3DGS with the options of a training, printed by Python's argparse."""
CHECKPOINTS = (".pt", ".pth", ".ckpt")
HOW_TO_EXPORT = (
    "write a PLY: gsplat does with --save_ply, nerfstudio with `ns-export gaussian-splat`, 3DGS and 2DGS as "
    "point_cloud.ply"
)
"""Advice to users who have a checkpoint, which is not read."""
SOURCE_PATH = re.compile(r"source_path='([^']+)'")
MOST_BYTES = 1 << 20


class OtherRun(NamedTuple):
    """Model that another program trained."""

    program: str
    model: Path
    """File of the newest model."""
    scene: str | None
    """Path of the scene, on the machine that trained; None if it is unknown."""


def other_run(folder: Path) -> OtherRun | None:
    """Return the newest model that another program wrote into a folder, or None."""
    for program, pattern in MODELS:
        models = sorted(folder.glob(pattern), key=lambda path: (_iteration_of(path.relative_to(folder)), str(path)))
        if models:
            scene = None
            if is_regular(folder / ARGUMENTS):
                text = read_regular(folder / ARGUMENTS, MOST_BYTES).decode(errors="replace")
                match = SOURCE_PATH.search(text)
                scene = match[1] if match else None
            return OtherRun(program, models[-1], scene)
    return None


def model_hint(folder: Path) -> str:
    """Return the hint at the model of another program in a folder, to append to an error; "" if there is none."""
    run = other_run(folder)
    if run is None:
        return ""
    if run.model.suffix in CHECKPOINTS:
        instead = f"its checkpoint {run.model} is not read; {HOW_TO_EXPORT}"
    else:
        instead = f"give its model {run.model}"
    return f": it is an output folder of {run.program}; {instead}"


def _iteration_of(path: Path) -> int:
    return max(map(int, re.findall(r"\d+", str(path))), default=0)
