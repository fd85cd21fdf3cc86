"""Export of a model's Gaussians as a PLY file for other programs."""

from pathlib import Path

from a2tg_jax.io.formats import lost_by
from a2tg_jax.io.ply import save_ply
from a2tg_jax.results.viewing import Source

SUFFIX = ".ply"


def check_ply(out: Path) -> None:
    """Raise ValueError if `out` is a folder or has another suffix than ply."""
    if out.is_dir() or out.suffix.lower() != SUFFIX:
        raise ValueError(f"--ply must be the path of a file that ends in {SUFFIX}; got {out}")


def export_ply(source: Source, out: Path, *, float64: bool = False) -> str:
    """Write the Gaussians of a model as programs for 3DGS read them, and return a summary, with what PLY does not keep.

    `float64` is as in `save_ply`.

    Raises:
      ValueError: if `out` is a folder or has another suffix than ply.
    """
    check_ply(out)
    out.parent.mkdir(parents=True, exist_ok=True)
    save_ply(out, source.model, float64=float64)
    lines = [f"file: {out}: {source.model.num:,} Gaussians"]
    if lost := lost_by(source.model, SUFFIX):  # --bake is an option of another command.
        lines.append(f"not kept by this format: {', '.join(lost).replace('--bake', 'a2tg convert --bake')}")
    return "\n".join(lines)
