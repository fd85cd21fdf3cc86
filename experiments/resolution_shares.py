"""Share of Gaussians with textures of each resolution."""

from collections.abc import Sequence

from lab import tables
from lab.cli import Experiment, Lab
from lab.grid import Grid


def present(lab: Lab, grids: Sequence[Grid]) -> None:
    """Write a table of the shares."""
    (grid,) = grids
    results = tables.results_of(grid, lab.records)
    results = [result for result in results if result.label == grid.reference.label and not result.run.cell.seed]
    shares = {_place(result): _shares(result) for result in results}
    sizes = sorted({size for own in shares.values() for size in own}, key=lambda size: tuple(map(int, size.split("x"))))
    rows = [[place, *(tables.percent(own.get(size, 0.0)) for size in sizes)] for place, own in shares.items()]
    (paper,) = tables.PAPER["resolution_shares"]
    text = tables.markdown(["scene", *(size.replace("x", "×") for size in sizes)], rows)
    wording = f"In the paper, on {paper['scene']}, {tables.percent(paper['1x1'])} keep 1×1 texels.\n"
    lab.write(EXPERIMENT.name, f"# Shares of texture resolutions (rows × columns)\n\n{text}\n{wording}")


def _place(result: tables.Result) -> str:
    cell = result.run.cell
    return f"{cell.scene.label}, {cell.gaussians:,}"


def _shares(result: tables.Result) -> dict[str, float]:
    """Return the share of Gaussians by resolution."""
    counts = result.record["sizes"]
    return {size: count / sum(counts.values()) for size, count in counts.items()}


EXPERIMENT = Experiment("resolution_shares", ("ablation",), present, __doc__)
