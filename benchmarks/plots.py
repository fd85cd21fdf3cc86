"""Plot of docs/performance.md, from the JSON that `python -m benchmarks` wrote.

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
    plot_growth(report["render"], pathlib.Path(sys.argv[2]) / "performance-growth.png")


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


if __name__ == "__main__":
    main()
