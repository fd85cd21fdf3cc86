"""Figures of trained models, each measured once and kept."""

from collections.abc import Callable, Mapping
from typing import Any

import a2tg_jax as a2tg
from a2tg_jax.results.folder import write_json
from lab import tables
from lab.cli import Lab
from lab.grid import Grid
from lab.kept import read_kept

Figures = Mapping[str, Any]
"""Figures of a model, in JSON."""


def measured_once(
    lab: Lab,
    name: str,
    grid: Grid,
    measure: Callable[[Lab, tables.Result, a2tg.Model], Figures],
    *,
    first_stage: bool = False,
) -> list[tuple[tables.Result, Figures]]:
    """Return the finished runs of a grid with their figures, which NAME.json keeps; runs without figures are left out.

    Args:
      measure: function of a run's model whose result is kept at once.
      first_stage: whether to measure the model of the first stage.
    """
    path = lab.out / f"{name}.json"
    kept: dict[str, Figures] = read_kept(path)
    found: list[tuple[tables.Result, Figures]] = []
    for result in tables.results_of(grid, lab.records):
        key = result.run.job.key
        if key not in kept and not lab.args.tables_only:
            model = lab.model(result, first_stage=first_stage)
            if model is not None:
                kept[key] = measure(lab, result, model)
                lab.out.mkdir(parents=True, exist_ok=True)
                write_json(path, kept)
        if key in kept:
            found.append((result, kept[key]))
    return found
