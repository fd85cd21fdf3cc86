"""Share of Gaussians with textures of each resolution, and their places: square ones blue, others red."""

from collections.abc import Sequence

from lab import pictures, tables
from lab.cli import Experiment, Lab
from lab.grid import Grid

import a2tg_jax as a2tg
from a2tg_jax.results.images import save_picture, side_by_side, to_uint8


def present(lab: Lab, grids: Sequence[Grid]) -> None:
    """Write a table of the shares, and a picture of each scene with a model."""
    results = [result for grid in grids for result in tables.results_of(grid, lab.records)]
    label = grids[0].reference.label
    results = [result for result in results if result.label == label and not result.run.cell.seed]
    shares = {_place(result): _shares(result) for result in results}
    sizes = sorted({size for own in shares.values() for size in own}, key=lambda size: tuple(map(int, size.split("x"))))
    rows = [[place, *(tables.percent(own.get(size, 0.0)) for size in sizes)] for place, own in shares.items()]
    (paper,) = tables.PAPER["resolution_shares"]
    text = tables.markdown(["scene", *(size.replace("x", "×") for size in sizes)], rows)
    wording = f"In the paper, on {paper['scene']}, {tables.percent(paper['1x1'])} keep 1×1 texels.\n"
    lab.write(EXPERIMENT.name, f"# Shares of texture resolutions (rows × columns)\n\n{text}\n{wording}")
    for result in tables.results_of(grids[-1], lab.records):
        if result.label == label:
            _picture(lab, result)


def _place(result: tables.Result) -> str:
    cell = result.run.cell
    return f"{cell.scene.label}, {cell.gaussians:,}"


def _shares(result: tables.Result) -> dict[str, float]:
    """Return the share of Gaussians by resolution."""
    counts = result.record["sizes"]
    return {size: count / sum(counts.values()) for size, count in counts.items()}


def _picture(lab: Lab, result: tables.Result) -> None:
    """Save the view of the first camera, as it is and coloured by the shape of the textures."""
    model = lab.model(result)
    if model is None:
        return
    camera = model.origin.cameras[0]
    shown = [to_uint8(a2tg.Renderer(one)(camera).color) for one in (model, pictures.colored_by_shape(model))]
    sheet = side_by_side(shown, ["full", "blue: 2×2, 4×4; red: not square"])
    save_picture(lab.pages / f"{EXPERIMENT.name}-{result.run.cell.scene.label.replace('/', '-')}.png", sheet)


EXPERIMENT = Experiment("resolution_shares", ("ablation", "pictures"), present, __doc__)
