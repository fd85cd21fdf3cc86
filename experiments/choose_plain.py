"""Choose the strongest plain method of each scene on validation views: --scale claims --validation (PROTOCOL.md)."""

from collections.abc import Sequence

import numpy as np
from lab import tables
from lab.cli import Experiment, Lab
from lab.grid import Grid
from lab.grid_file import GRIDS

from a2tg_jax.results.folder import write_json

CHOICES = GRIDS / "strongest_plain.json"
"""The choices by scene, which grids read (`chosen_in`)."""


def best_methods(results: Sequence[tables.Result], num_methods: int) -> dict[str, str]:
    """Return the method of highest PSNR of each scene, means over its folds; scenes that lack a method are left out."""
    best = {}
    for scene, own in tables.grouped(results, lambda result: result.run.cell.scene.label):
        by_label = tables.grouped(own, lambda result: result.label)
        psnr = {label: np.mean([each["psnr"] for each in found]) for label, found in by_label}
        if len(psnr) == num_methods:
            best[scene] = max(psnr, key=lambda label: psnr[label])
    return best


def present(lab: Lab, grids: Sequence[Grid]) -> None:
    """Write the table of all methods, and the choices of the protocol."""
    (grid,) = grids
    results = tables.results_of(grid, lab.records)
    best = best_methods(results, 1 + len(grid.methods))
    chosen = tables.markdown(["scene", "chosen"], [[scene, label] for scene, label in best.items()])
    lab.write(EXPERIMENT.name, f"# {grid.title}\n\n{chosen}\n{tables.choices_table(results, grid.reference.label)}")
    if lab.scale == "claims" and lab.args.validation and not lab.is_partial:
        write_json(CHOICES, best)


EXPERIMENT = Experiment("choose_plain", ("choose_plain",), present, __doc__)
