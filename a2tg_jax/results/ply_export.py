"""Export of a model's Gaussians as a PLY file for other programs."""

from pathlib import Path

from a2tg_jax.io.formats import beside_gaussians
from a2tg_jax.io.ply import save_ply
from a2tg_jax.results.viewing import Source

SUFFIX = ".ply"


def check_ply(out: Path) -> None:
    """Raise ValueError if `out` is a folder or has another suffix than ply."""
    if out.is_dir() or out.suffix.lower() != SUFFIX:
        raise ValueError(f"--ply must be the path of a file that ends in {SUFFIX}; got {out}")


def export_ply(source: Source, out: Path) -> str:
    """Write the Gaussians of a model as programs for 3DGS read them, and return a summary of the file.

    Raises:
      ValueError: if `out` is a folder or has another suffix than ply.
    """
    check_ply(out)
    out.parent.mkdir(parents=True, exist_ok=True)
    save_ply(out, source.model)
    lost = beside_gaussians(source.model)
    left_out = f", without their {lost}, which PLY cannot hold" if lost else ""
    return f"file: {out}: {source.model.num:,} Gaussians{left_out}"
