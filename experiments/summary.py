"""Gains at equal bytes with 95 % intervals over scenes: the two tables of docs/results.md."""

import dataclasses
import re
from collections.abc import Collection, Mapping, Sequence

from equal_bytes import GRIDS, at_budget, gain_text, on_scene, unique
from lab import tables
from lab.cli import Experiment, Lab
from lab.grid import Grid
from lab.versions import is_from_before

BYTEWISE, TEXTURED, PLAIN = "Bytewise", "A²TG, as quick has it", "2DGS*-MCMC"
GAUSSIAN, LONG = f"{BYTEWISE}, Gaussian kernels", f"{BYTEWISE}, long tails"
MCMC_0 = f"{PLAIN}, degree 0"
UNPRUNED_METHODS = (MCMC_0, "2DGS*, degree 0")
PLAIN_METHODS = (*UNPRUNED_METHODS, *(f"{label}, pruned" for label in UNPRUNED_METHODS))
"""Plain methods of which a cell must have all before its best one is named."""
BEST, BEST_UNPRUNED = "the best plain method", "the best plain method without pruning"
OTHERS = {
    f"{BYTEWISE} less {BEST}": (BYTEWISE, BEST),
    f"{GAUSSIAN}, less {BEST}": (GAUSSIAN, BEST),
    f"{BYTEWISE} less {BEST_UNPRUNED}": (BYTEWISE, BEST_UNPRUNED),
    f"{BYTEWISE} less the same with Gaussian kernels": (BYTEWISE, GAUSSIAN),
    f"{BYTEWISE} less the same with long tails": (BYTEWISE, LONG),
    f"{BYTEWISE} less MCMC of degree 0": (BYTEWISE, MCMC_0),
    f"{BYTEWISE} less MCMC of degree 3": (BYTEWISE, PLAIN),
}
"""Differences of means: what they are called, and the two methods."""
BRACKETS = "\nA number in brackets is the number of scenes, where not all were run.\n"


def present(lab: Lab, grids: Sequence[Grid]) -> None:
    """Write the table of bytes and the table of textures, without runs from before."""
    *budgets, claim = grids
    found = unique(result for grid in budgets for result in tables.results_of(grid, lab.records))
    results = [result for result in found if not is_from_before(result.record)]
    claimed = tables.results_of(claim, lab.records)
    tables_of_pages = {
        "summary-bytes": f"# Bytewise at equal bytes\n\n{bytes_table(results)}",
        "summary-textures": f"# Textures at equal bytes\n\n{textures_table(results, claimed)}",
    }
    for name, text in tables_of_pages.items():
        lab.write(name, text + (BRACKETS if re.search(r" \(\d+\)", text) else ""), has_old_rows=False)


def bytes_table(results: Sequence[tables.Result]) -> str:
    """Return the gains of `bytewise`: by scene over the best plain method, on average over others."""
    best = [*best_plain(results, PLAIN_METHODS, BEST), *best_plain(results, UNPRUNED_METHODS, BEST_UNPRUNED)]
    results = [*results, *best]
    budgets = sorted({result.run.cell.budget or 0.0 for result in results})
    found = [at_budget(results, budget) for budget in budgets]
    scenes, rows = sorted({result.run.cell.scene.label for result in results}), []
    for scene in scenes:
        rows.append([f"{BYTEWISE} less {BEST}: {scene}", *(on_scene(own, scene, BYTEWISE, BEST) for own in found)])
    for wording, (label, other) in OTHERS.items():
        means = [gain_text(own, label, other).removesuffix(f" ({len(scenes)})") for own in found]
        rows.append([f"**{wording}: mean**", *means])
    return tables.markdown(["", *(f"{budget:g} MB: dB · LPIPS" for budget in budgets)], rows)


def best_plain(results: Sequence[tables.Result], methods: Collection[str], label: str) -> list[tables.Result]:
    """Return the result of the highest PSNR of each cell that has all of some methods, as one method of that label."""
    best = []
    for _, block in tables.grouped(results, lambda result: result.run.cell):
        plain = [result for result in block if result.label in methods]
        if {result.label for result in plain} == set(methods):
            highest = max(plain, key=lambda result: result["psnr"])
            method = dataclasses.replace(highest.run.method, label=label)
            best.append(dataclasses.replace(highest, run=dataclasses.replace(highest.run, method=method)))
    return best


def textures_table(budgets: Sequence[tables.Result], claim: Sequence[tables.Result]) -> str:
    """Return what textures gain over more Gaussians without them, in both settings."""
    equal = tables.EQUAL_BYTES
    rows = [
        _row("`a2tg` of `quick` less MCMC, bytes of `a2tg`", claim, TEXTURED, PLAIN + equal),
        _row("`a2tg` of `quick` less MCMC, given budgets", budgets, TEXTURED, PLAIN),
        _row("`a2tg` of `quick` less MCMC of degree 0, given budgets", budgets, TEXTURED, MCMC_0),
        _row("`a2tg` of the paper less MCMC, bytes of `a2tg`", claim, "A²TG", PLAIN + equal),
        _row("`a2tg` of `quick` less textures of one size, its bytes", claim, TEXTURED, "Textured Gaussians*" + equal),
    ]
    return tables.markdown(["compared", "cells", "dB", "p", "LPIPS", "p"], rows)


def _row(wording: str, results: Sequence[tables.Result], label: str, other: str) -> list[str]:
    """Return one comparison: number of cells, means with intervals, p-values."""
    cells = {(cell.scene, cell.gaussians, cell.budget) for cell in _shared_cells(results, label, other)}
    psnr, lpips = (_estimate(tables.gains_by_scene(results, label, other, figure)) for figure in ("psnr", "lpips"))
    return [wording, str(len(cells)), psnr.as_text(3), _p_value(psnr), lpips.as_text(4), _p_value(lpips)]


def _shared_cells(results: Sequence[tables.Result], label: str, other: str) -> set:
    own, others = ({r.run.cell for r in results if r.label == name} for name in (label, other))
    return own & others


def _estimate(gains: Mapping[str, float]) -> tables.SceneMean:
    return tables.over_scenes(gains.values())


def _p_value(estimate: tables.SceneMean) -> str:
    return "<.001" if estimate.p_value < 0.001 else tables.number(estimate.p_value, 3)


EXPERIMENT = Experiment("summary", (*GRIDS, "claim"), present, __doc__)
