"""Plots of docs/performance.md, from the JSON that `python -m benchmarks` wrote.

python -m benchmarks.plots benchmarks/results/cpu.json docs/images
"""

import json
import pathlib
import sys

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt

STYLES = {"none": ("untextured", "C0"), "mixed": ("mixed sizes", "C1"), "4x4": ("all 4×4", "C2")}


def main() -> None:
    report = json.loads(pathlib.Path(sys.argv[1]).read_text())
    folder = pathlib.Path(sys.argv[2])
    plot_growth(report["render"], folder / "performance-growth.png")
    plot_stages(report["stages"], folder / "performance-stages.png")


def plot_growth(cases: list[dict], path: pathlib.Path) -> None:
    """Plot forward + backward against the number of Gaussians, one panel per image size, all threads."""
    cases = [case for case in cases if "failed" not in case]
    threads = max(case["threads"] for case in cases)
    sizes = sorted({(case["width"], case["height"]) for case in cases})
    figure, panels = plt.subplots(1, len(sizes), figsize=(9, 3.6), sharey=True, layout="constrained")
    for panel, size in zip(panels, sizes, strict=True):
        for kind, (label, color) in STYLES.items():
            chosen = [c for c in cases if (c["width"], c["height"]) == size and c["textures"] == kind]
            chosen = sorted((c for c in chosen if c["threads"] == threads), key=lambda c: c["num"])
            numbers = [case["num"] for case in chosen]
            panel.loglog(numbers, [case["both"]["ms"] for case in chosen], "o-", color=color, label=label)
            panel.loglog(numbers, [case["forward"]["ms"] for case in chosen], "o:", color=color, mfc="none")
        panel.set(title=f"{size[0]}×{size[1]}, {threads} threads", xlabel="Gaussians")
        panel.grid(alpha=0.3)
    panels[0].set(ylabel="ms (solid: with backward, dotted: forward)")
    panels[0].legend()
    figure.savefig(path, dpi=110)


def plot_stages(cases: list[dict], path: pathlib.Path) -> None:
    """Plot the time of each stage, per case, as stacked bars."""
    stages = {
        "tile lists": lambda case: case["tile lists"]["ms"],
        "compositing": lambda case: case["compositing, forward and backward"]["ms"],
        "projection": lambda case: case["projection, forward and backward"]["ms"],
        "loss": lambda case: case["loss, value and gradient"]["ms"],
        "Adam": lambda case: case["Adam"]["ms"],
    }
    cases = [case for case in cases if "failed" not in case]
    figure, panel = plt.subplots(figsize=(9, 3.4), layout="constrained")
    names = [f"{c['num'] // 1000}k, {STYLES[c['textures']][0]}\n{c['threads']} thread(s)" for c in cases]
    start = [0.0] * len(cases)
    for stage, of in stages.items():
        widths = [of(case) for case in cases]
        panel.barh(names, widths, left=start, label=stage)
        start = [a + b for a, b in zip(start, widths, strict=True)]
    panel.invert_yaxis()
    panel.set(xlabel="ms, forward and backward")
    panel.set_xscale("linear")
    panel.legend(loc="upper right")
    figure.savefig(path, dpi=110)


if __name__ == "__main__":
    main()
