"""Memory of a device, bytes sent and time of a training step on several devices of this CPU.

    python -m benchmarks.scaling --out benchmarks/results/scaling.json
    python -m benchmarks.scaling --gaussians 20000 --steps 20 --out FILE     # also times steps

Bytes are those of the compiled program: `memory_analysis` for the memory, shapes of its collectives for what travels. A
device draws one view of plain Gaussians of degree 3. Images are small, because pixels stay on the devices. Events that
move rows, such as those of MCMC every hundred iterations, send further rows, which are not counted.
"""

import argparse
import json
import re
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import numpy as np

import a2tg_jax as a2tg
from a2tg_jax.base.config_json import changed_config
from a2tg_jax.systems.baselines import Gaussians2d
from a2tg_jax.training.loop import StageRun
from a2tg_jax.training.start import initial_model
from a2tg_jax.training.step import jitted_step
from experiments.lab.markdown import table as markdown

WIDTH, HEIGHT = 64, 48
BYTES = {"f64": 8, "f32": 4, "s64": 8, "s32": 4, "u32": 4, "u8": 1, "pred": 1}
"""Bytes of a number, by XLA's name of its type."""
COLLECTIVE = re.compile(r"= (.*?) (all-gather|all-reduce|reduce-scatter|all-to-all|collective-permute)(?:-start)?\(")


def array_bytes(shapes: str) -> int:
    """Return the bytes of arrays as XLA writes them, such as (f32[8,3], s32[8])."""
    found = re.findall(r"(\w+)\[([\d,]*)\]", shapes)
    return sum(BYTES[kind] * int(np.prod([int(side) for side in sides.split(",") if side])) for kind, sides in found)


def lines_of_each_step(program: str) -> Iterator[str]:
    """Yield the lines of a program's text that run in each step: not the branches of events."""
    computations: dict[str, list[str]] = {}
    for block in re.split(r"\n{2,}", program.strip()):
        head, *lines = block.splitlines()
        name = re.match(r"(?:ENTRY )?%?([\w.\-]+)", head)
        if name is not None:
            computations["ENTRY" if head.startswith("ENTRY") else name[1]] = lines
    ahead = ["ENTRY"]
    while ahead:
        for line in computations.get(ahead.pop(), ()):
            yield line
            ahead += re.findall(r"(?:to_apply|calls|body)=%?([\w.\-]+)", line)


def bytes_sent(program: str, num_devices: int) -> dict[str, int]:
    """Return the bytes that each device sends in a step, by kind of collective, along a ring of devices."""
    others = num_devices - 1
    per_byte = {
        "all-gather": others / num_devices,
        "all-reduce": 2 * others / num_devices,
        "reduce-scatter": others,  # The result is one part.
        "all-to-all": others / num_devices,
        "collective-permute": 1,
    }
    sent: dict[str, int] = {}
    for line in lines_of_each_step(program):
        found = COLLECTIVE.search(line)
        if found is not None:
            shapes, kind = found.groups()
            sent[kind] = sent.get(kind, 0) + round(per_byte[kind] * array_bytes(shapes))
    return sent


def measured(num_devices: int, num: int, steps: int) -> dict[str, Any]:
    """Return the figures of a step on some devices."""
    scene = a2tg.synthetic_scene(num_views=9, width=WIDTH, height=HEIGHT, num_points=num)
    changes = {"batch_size": num_devices, "initial_gaussians": num, "densify": {"cap": num}}
    system = changed_config(Gaussians2d.preset("smoke"), changes, "here")
    devices = jax.devices()[:num_devices]
    session = a2tg.Session(devices=devices if num_devices > 1 else None)
    run = StageRun(scene, system, 0, initial_model(scene, system), session=session)
    settings, state, inputs = run.arguments(1)
    compiled = jitted_step().lower(settings, state, inputs).compile()
    memory = compiled.memory_analysis()
    photographs = sum(leaf.nbytes for leaf in jax.tree.leaves(inputs.photographs))
    found: dict[str, Any] = {
        "devices": num_devices,
        "gaussians": run.state.model.gaussians.num,
        "model_bytes": run.state.model.num_bytes,
        "state_bytes": memory.argument_size_in_bytes - photographs,
        "step_bytes": memory.temp_size_in_bytes,
        "sent_bytes": bytes_sent(compiled.as_text(), num_devices),
    }
    if steps:
        run.steps(1, 3)
        began = time.perf_counter()
        run.steps(4, 3 + steps)
        found["seconds_a_step"] = (time.perf_counter() - began) / steps
    run.photographs.close()
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--gaussians", type=int, default=1_000_000)
    parser.add_argument("--devices", type=int, nargs="+", default=[1, 2, 4, 8])
    parser.add_argument("--steps", type=int, default=0, help="number of steps that are timed")
    args = parser.parse_args()
    if max(args.devices) > 1:
        jax.config.update("jax_num_cpu_devices", max(args.devices))
    found = [measured(devices, args.gaussians, args.steps) for devices in args.devices]
    args.out.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
    rows = []
    for own in found:
        sent = sum(own["sent_bytes"].values())
        megabytes = (f"{size / 1e6:,.0f} MB" for size in (own["state_bytes"], own["step_bytes"], sent))
        pace = f"{own['seconds_a_step']:.3f} s" if args.steps else ""
        rows.append([str(own["devices"]), *megabytes, pace])
    print(markdown(["devices", "state on a device", "step on a device", "sent by a device", "a step"], rows))


if __name__ == "__main__":
    main()
