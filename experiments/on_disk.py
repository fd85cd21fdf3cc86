"""Sizes of model files: each choice of bits, the smallest file within a loss, PSNR against bytes on disk.

Figures are kept in on_disk.json. Choices are made by PSNR on training views and reported on test views.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from lab import plots, tables
from lab.cli import Experiment, Lab
from lab.grid import Grid
from lab.jobs import MOST_TRAIN_VIEWS, background_of
from lab.measured import Figures, measured_once

import a2tg_jax as a2tg
from a2tg_jax.finish.compaction import LADDER, Trial, loss_on_views, measure_choices, smallest_within
from a2tg_jax.io.columns import CODERS
from a2tg_jax.io.compact import GROUPS, bytes_by_part, decode_model, encode_model
from a2tg_jax.results.figures import save_figure

MAX_LOSSES = (0.02, 0.05, 0.1, 0.3, 1.0)
"""Largest losses in dB on training views, a point of a curve each."""
REPORTED = "0.05"
CODER_CHOICES = ("smallest", *CODERS)
TRIED = {**LADDER, "sh_rest": (*LADDER["sh_rest"], "float16"), "texels": (*LADDER["texels"], "float16")}
SMOKE_TRIED = {group: (steps[0], steps[-1]) for group, steps in LADDER.items()}
PARTS = {"sh": ("sh_",), "texels": ("texel_", "sizes"), "cameras": ("origin_",)}
"""Parts of a file that are counted together, with the first letters of their names."""
PUBLISHED = (
    "Published figures are of other scenes, and photographs of full size: HAC has 27.77 dB in 21.9 MB and 27.53 dB in "
    "15.3 MB as means over Mip-NeRF 360."
)


def present(lab: Lab, grids: Sequence[Grid]) -> None:
    """Write tables and curves of the available models, each measured once."""
    (grid,) = grids
    found = measured_once(lab, EXPERIMENT.name, grid, _measure)
    parts = [
        f"# {grid.title}\n\nThe smallest files that lose {REPORTED} dB at most on training views; PSNR and LPIPS are "
        f"those of test views, of the model and of its file. 1 kB is 1000 bytes.\n\n{_files(found)}",
        f"## Where the bytes are\n\n{_parts(found)}",
        f"## Coders\n\nThe same numbers, in kB.\n\n{_coders(found)}",
        f"## Each choice\n\nAll other groups at their finest; means over the models.\n\n{_choices(found)}",
        PUBLISHED,
    ]
    lab.write(EXPERIMENT.name, "\n".join(parts) + "\n")
    if found:
        save_figure(lab.pages / f"{EXPERIMENT.name}.png", plots.charts(_panels(found)))


def _measure(lab: Lab, result: tables.Result, model: a2tg.Model) -> dict[str, Any]:
    """Return all figures of a model."""
    scene = lab.folders.load_scene(result.run.job)
    background = background_of(scene)
    train = scene.train[:: -(-len(scene.train) // MOST_TRAIN_VIEWS)]
    losses = [loss_on_views(model, views, background=background) for views in (train, scene.test)]
    trials = measure_choices(model, losses, SMOKE_TRIED if lab.is_smoke else TRIED)
    max_losses = (float(REPORTED),) if lab.is_smoke else MAX_LOSSES
    best = {str(most): smallest_within(model, losses, most, trials) for most in max_losses}
    reported = encode_model(model, best[REPORTED].choices)
    weights = lab.folders.lpips_weights
    before, after = (
        a2tg.evaluate(scene.test, one, background=background, lpips_weights=weights)
        for one in (model, decode_model(reported))
    )
    return {
        "num_bytes": model.num_bytes,
        "psnr": [before.psnr, after.psnr],
        "lpips": [before.lpips, after.lpips],
        "best": {most: _as_text(trial) for most, trial in best.items()},
        "parts": bytes_by_part(reported),
        "coders": {coder: _size(model, best[REPORTED], coder) for coder in CODER_CHOICES},
        "trials": [_as_text(trial) for trial in trials],
    }


def _as_text(trial: Trial) -> dict[str, Any]:
    kept = {group: getattr(trial.choices, group) for group in ([trial.group] if trial.group else GROUPS)}
    return {"kept": kept, "bytes": trial.num_bytes, "train_loss": trial.losses[0], "test_loss": trial.losses[1]}


def _size(model: a2tg.Model, trial: Trial, coder: str) -> int:
    return len(encode_model(model, trial.choices.keeping({"coder": coder})))


def _files(found: Sequence[tuple[tables.Result, Figures]]) -> str:
    header = ["scene", "method", "Gaussians", "kB of numbers", "kB on disk", "ratio", "PSNR", "LPIPS", "kept as"]
    rows = []
    for result, figures in found:
        best = figures["best"][REPORTED]
        rows.append(
            [
                *_named(result), tables.number(figures["num_bytes"] / 1e3, 1), tables.number(best["bytes"] / 1e3, 1),
                tables.number(figures["num_bytes"] / best["bytes"], 1), _change(figures["psnr"], 2),
                _change(figures["lpips"], 3), _kept(figures, best),
            ]
        )  # fmt: skip
    return tables.markdown(header, rows)


def _kept(figures: Mapping[str, Any], best: Mapping[str, Any]) -> str:
    """Return the choices for the groups that the model has."""
    groups = dict.fromkeys(group for trial in figures["trials"] for group in trial["kept"])
    return ", ".join(f"{group} {best['kept'][group]}" for group in groups)


def _named(result: tables.Result) -> list[str]:
    return [result.run.cell.scene.label, result.label, f"{result.record['num']:,}"]


def _change(pair: Sequence[float | None], digits: int) -> str:
    return " → ".join(tables.number(float("nan") if value is None else value, digits) for value in pair)


def _parts(found: Sequence[tuple[tables.Result, Figures]]) -> str:
    shares = [(result, _shares(figures["parts"])) for result, figures in found]
    names = list(dict.fromkeys(name for _, own in shares for name in own))
    rows = [[*_named(result), *(tables.percent(own.get(name, 0.0)) for name in names)] for result, own in shares]
    return tables.markdown(["scene", "method", "Gaussians", *names], rows)


def _shares(parts: Mapping[str, int]) -> dict[str, float]:
    """Return the share of a file's bytes by part."""
    shares: dict[str, float] = {}
    for name, size in parts.items():
        together = next((label for label, starts in PARTS.items() if name.startswith(starts)), name)
        shares[together] = shares.get(together, 0.0) + size / sum(parts.values())
    return shares


def _coders(found: Sequence[tuple[tables.Result, Figures]]) -> str:
    rows = [
        [*_named(result), *(tables.number(figures["coders"][coder] / 1e3, 1) for coder in CODER_CHOICES)]
        for result, figures in found
    ]
    return tables.markdown(["scene", "method", "Gaussians", *CODER_CHOICES], rows)


def _choices(found: Sequence[tuple[tables.Result, Figures]]) -> str:
    """Return sizes relative to the finest choice, and losses."""
    points: dict[tuple[str, str], list[tuple[float, float, float]]] = {}
    for _, figures in found:
        finest = max(trial["bytes"] for trial in figures["trials"])
        for trial in figures["trials"]:
            ((group, bits),) = trial["kept"].items()
            own = (trial["bytes"] / finest, trial["train_loss"], trial["test_loss"])
            points.setdefault((group, str(bits)), []).append(own)
    rows = []
    for (group, bits), own in points.items():
        size, train, test = np.mean(own, axis=0)
        rows.append(
            [group, bits, f"{100 * size:.1f} %", tables.signed(train, 3), tables.signed(test, 3), str(len(own))]
        )
    return tables.markdown(["group", "kept as", "size", "dB lost, training", "dB lost, test", "models"], rows)


def _panels(found: Sequence[tuple[tables.Result, Figures]]) -> list[tuple[str, dict[str, list[plots.Point]], str, str]]:
    """Return PSNR on test views against kB on disk, a chart for each scene and a curve for each model."""
    panels: dict[str, dict[str, list[plots.Point]]] = {}
    for result, figures in found:
        curve = [
            (best["bytes"] / 1e3, figures["psnr"][0] - best["test_loss"])
            for best in {best["bytes"]: best for best in figures["best"].values()}.values()
        ]
        cell = result.run.cell
        label = f"{result.label}, " + (f"{cell.gaussians:,}" if cell.budget is None else f"{cell.budget:g} MB")
        panels.setdefault(result.run.cell.scene.label, {})[label] = curve
    return [(scene, curves, "kB on disk", "test PSNR, dB") for scene, curves in panels.items()]


EXPERIMENT = Experiment("on_disk", ("on_disk",), present, __doc__)
