"""Tables of docs/performance.md and the notebook, from the JSON that `python -m benchmarks` wrote.

    python -m benchmarks.tables benchmarks/results/cpu.json docs/performance.md experiments/NOTEBOOK.md

replaces the text between `<!-- NAME -->` and `<!-- end -->` in the documents by the table of that name.
"""

import json
import pathlib
import re
import sys
from collections.abc import Callable, Iterable

from benchmarks.sections import TYPICAL
from experiments.lab.markdown import table

TEXTURES = {"none": "none", "mixed": "mixed", "4x4": "all 4×4"}
STAGES = (
    "tile lists",
    "projection, forward and backward",
    "compositing",
    "compositing, forward and backward",
    "loss, value and gradient",
    "Adam",
)


def main() -> None:
    report = json.loads(pathlib.Path(sys.argv[1]).read_text())
    documents = [pathlib.Path(name) for name in sys.argv[2:]]
    texts = [document.read_text() for document in documents]
    for name, (make, sections) in TABLES.items():
        missing = [section for section in sections if not report.get(section)]
        if missing:
            print(f"the table {name!r} stays as it is: {sys.argv[1]} has no {' and no '.join(missing)}")
            continue
        place = re.compile(rf"(<!-- {name} -->\n).*?(<!-- end -->)", re.DOTALL)
        if not any(place.search(text) for text in texts):
            wanted = f"<!-- {name} --> and, below, <!-- end -->"
            sys.exit(f"no place for the table {name!r} in {', '.join(sys.argv[2:])}: {wanted}")
        new = make(report)
        texts = [place.sub(lambda found, new=new: found[1] + new + found[2], text) for text in texts]
    for document, text in zip(documents, texts, strict=True):
        document.write_text(text)


def ms(figure: dict) -> str:
    """Return a time in milliseconds with two or three digits."""
    value = figure["ms"]
    return f"{value:.1f}" if value < 10 else f"{value:.0f}"


def size(case: dict) -> str:
    return f"{case['width']}×{case['height']}"


def measured(cases: Iterable[dict]) -> list[dict]:
    return [case for case in cases if "failed" not in case]


def machine(report: dict) -> str:
    found = report["machine"]
    versions = ", ".join(f"{name} {version}" for name, version in found["versions"].items())
    return (
        f"Figures of {found['date']}, commit {found['commit']}: {found['processor']}, {found['cores']} cores; "
        f"Python {found['python']}, {versions}.\n"
    )


def render(report: dict) -> str:
    """Return the cases without textures on all threads; the smallest ones are shorter than their disturbances."""
    cases: dict[tuple[int, int], dict] = {}
    for case in measured([*report["render"], *report["pixels"], *report["full_size"]]):
        is_long = case["num"] >= 10_000 and case["width"] >= 320
        if is_long and case["textures"] == "none" and case["threads"] == report["machine"]["cores"]:
            cases.setdefault((case["width"], case["num"]), case)
    rows = (
        [f"{case['num']:,}", size(case), ms(case["forward"]), ms(case["both"]), f"{case['peak_mb']:.0f}"]
        for _, case in sorted(cases.items())
    )
    return table(["Gaussians", "image", "render", "render + gradients", "peak memory, MB"], rows)


def ratios(report: dict) -> str:
    """Return the cost of textures on all threads."""
    cases = [
        case for case in measured(report["render"])
        if (case["num"], (case["width"], case["height"])) in TYPICAL and case["threads"] == report["machine"]["cores"]
    ]  # fmt: skip
    plain = {case["num"]: case for case in cases if case["textures"] == "none"}
    rows = []
    for case in cases:
        row = [f"{case['num']:,}", size(case), TEXTURES[case["textures"]]]
        for which in ("forward", "both"):
            row += [ms(case[which]), f"{case[which]['ms'] / plain[case['num']][which]['ms']:.2f}"]
        rows.append(row)
    return table(["N", "image", "textures", "forward", "ratio", "forward + backward", "ratio"], rows)


def stages(report: dict) -> str:
    cases = measured(report["stages"])
    head = [f"{c['num'] // 1000}k, {TEXTURES[c['textures']]}, {c['threads']} thr." for c in cases]
    return table(["stage", *head], ([name, *(ms(case[name]) for case in cases)] for name in STAGES))


def limit(report: dict) -> str:
    head = ["N", "image", "threads", "evaluated", "limit forward", "ratio", "limit forward + backward", "ratio"]
    least = {
        (which, case["threads"]): case["limit"]["ms"] / case["pairs"]
        for which, cases in report["limit"].items()
        for case in cases
    }
    evaluated = {(c["num"], c["width"]): c["evaluated_pairs"] for c in measured(report["stages"])}
    rows = []
    for case in measured(report["render"]):
        pairs = evaluated.get((case["num"], case["width"]))
        if pairs is None or case["textures"] != "none":
            continue
        row = [f"{case['num']:,}", size(case), str(case["threads"]), f"{pairs / 1e6:.1f}"]
        for which in ("forward", "both"):
            best = least[which, case["threads"]] * pairs
            row += [ms({"ms": best}), f"{case[which]['ms'] / best:.1f}"]
        rows.append(row)
    return table(head, rows)


def others(report: dict) -> str:
    names = {"render": "this library", "mitsuba": "Mitsuba 3 `volprim_rf_basic`"}
    rows = (
        [names.get(c["case"], c["case"]), f"{c['num']:,}", size(c), ms(c["forward"]), ms(c["both"])]
        for c in measured(report["others"])
    )
    return table(["program", "N", "image", "forward", "forward + backward"], rows)


def compositors(report: dict) -> str:
    rows = []
    for case in measured(report["compositors"]):
        name = "XLA" if case.get("compositor") == "xla" else f"native, tiles of {case['tile_size']}"
        rows.append([TEXTURES[case["textures"]], name, ms(case["forward"]), ms(case["both"])])
    return table(["textures", "compositor", "forward", "forward + backward"], rows)


def training(report: dict) -> str:
    head = ["image", "Gaussians", "stage 1", "stage 2, untextured", "stage 2, textured", "peak memory, MB", "again"]
    cases = measured(report["training"])
    warm = {(c["downscale"], c["num"]): c for c in cases if c["cache"] == "warm"}
    rows = []
    for case in cases:
        again = warm.get((case["downscale"], case["num"]))
        if case["cache"] == "cold" and again:
            # Both starts time the same steps; other programs slow one of them.
            names = ("stage1_ms", "untextured_ms", "textured_ms")
            steps = [ms({"ms": min(case[name], again[name])}) for name in names]
            width, height = case["image"]
            peaks = [f"{one['peak_mb']:.0f}" for one in (case, again)]
            rows.append([f"{width}×{height}", f"{case['num_live']:,}", *steps, *peaks])
    return table(head, rows)


def gpu(report: dict) -> str:
    cases = measured(report["gpu"])
    head = ["N", "program", "textures", "forward", "forward + backward", "training step", "memory of the step, MB"]
    names = {"render": "this library", "gsplat": "gsplat, 2D Gaussians"}
    rows = []
    steps = {(case["num"], case["textures"]): case for case in cases if case["case"] == "step"}
    for case in cases:
        if case["case"] in names:
            step = steps.get((case["num"], case.get("textures")))
            of_step = [ms(step["step"]), f"{step['device_peak_mb']:.0f}"] if step else ["–", "–"]
            passes = [ms(case["forward"]), ms(case["both"])]
            textures = TEXTURES[case.get("textures", "none")]
            rows.append([f"{case['num']:,}", names[case["case"]], textures, *passes, *of_step])
    return table(head, rows)


TABLES: dict[str, tuple[Callable[[dict], str], tuple[str, ...]]] = {
    "machine": (machine, ("machine", "render")),
    "render": (render, ("machine", "render", "pixels", "full_size")),
    "ratios": (ratios, ("machine", "render")),
    "stages": (stages, ("stages",)),
    "limit": (limit, ("limit", "render", "stages")),
    "others": (others, ("others",)),
    "compositors": (compositors, ("compositors",)),
    "training": (training, ("training",)),
    "gpu": (gpu, ("gpu",)),
}
"""Function of each table, with the sections of the report that it needs."""

if __name__ == "__main__":
    main()
