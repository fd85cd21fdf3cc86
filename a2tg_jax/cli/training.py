"""Shared by `a2tg train` and `a2tg demo`: questions, devices, a page in the browser, results."""

import sys
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from pathlib import Path

import jax

from a2tg_jax import A2tg, Gaussians2dMcmc, Mcmc, Scene, Session, Upscale
from a2tg_jax.base.memory import tidy_memory
from a2tg_jax.base.text import counted
from a2tg_jax.cli.arguments import RESUMES_OR_REPLACES, open_browser, print_now
from a2tg_jax.data.load import SceneSource
from a2tg_jax.results.folder import RunFolder, opened
from a2tg_jax.results.record import RunRecord
from a2tg_jax.results.report import RunResult, sizes_line, summary_text
from a2tg_jax.results.run_training import RunOptions, begin_run, resume_run, warn_of_doubts
from a2tg_jax.results.viewing import LiveView, shown_live

DEMO_SYSTEM = A2tg(
    stage1_iterations=400,
    stage2_iterations=250,
    densify=Mcmc(cap=1_500),
    texture=Upscale(fraction=0.5, at=(0.1, 0.2)),
    texel_rate=1e-2,
)
"""With few iterations, textures must grow early and learn fast."""


def train_demo(out: Path, *, resumes: bool, overwrite: bool, quiet: bool) -> None:
    """Train the built-in scene with and without textures, and print the results; `resumes` continues."""
    options = RunOptions(
        overwrite=overwrite,
        session=Session(after_compiling=tidy_memory),
        progress=not quiet,
        on_note=print_now,
    )
    if resumes:
        resume(out, options)
        return
    record = RunRecord(SceneSource("synthetic"), A2tg.name, DEMO_SYSTEM, (Gaussians2dMcmc.name,))
    print_result(begin_run(record, out, options), out)


def resume(folder: Path, options: RunOptions, check: Callable[[RunFolder], object] = lambda run: None) -> None:
    """Continue a run, once `check` has accepted it, and print its results.

    Raises:
      ValueError: if the run is to be replaced as well.
    """
    if options.overwrite:
        raise ValueError(RESUMES_OR_REPLACES)
    with opened(folder) as run:
        check(run)
        print_result(resume_run(run, options), folder)


def ask(doubts: Sequence[str]) -> None:
    """Ask on the terminal whether to train in spite of `doubts`. Raises ValueError if there is none, or the answer is
    not yes."""
    if not (sys.stdin.isatty() and sys.stderr.isatty()):
        raise ValueError(f"{'; '.join(doubts)}; to train all the same, add `yes`")
    warn_of_doubts(doubts)
    print("Train all the same? [y/N] ", end="", file=sys.stderr, flush=True)
    if sys.stdin.readline().strip().lower() not in ("y", "yes"):
        raise ValueError("nothing was trained, as you answered")


def with_view_for_each(record: RunRecord, num_devices: int) -> RunRecord:
    """Return the record with as many views a step as there are devices, unless it has another number than one."""
    if num_devices == 1 or record.options.batch_size > 1:
        return record
    return record.with_options(batch_size=num_devices)


def devices_named(text: str) -> list[jax.Device] | None:
    """Return the first N devices of each process, or all; None for one device of one process.

    Raises:
      ValueError: if the text is neither "all" nor a number from 1 to the number of devices.
    """
    devices: list[jax.Device] = jax.local_devices()
    if text == "all":
        text = str(len(devices))
    if not text.isdecimal() or not 1 <= int(text) <= len(devices):
        kind = devices[0].platform.upper()
        raise ValueError(
            f"--devices must be all, or a number from 1 to {len(devices)}; got {text!r}: this machine has "
            f"{counted(len(devices), f'{kind} device')}"
        )
    # By process, so that all have the same list.
    chosen: list[jax.Device] = []
    for index in range(jax.process_count()):
        chosen += jax.local_devices(process_index=index)[: int(text)]
    return chosen if len(chosen) > 1 else None


def print_result(result: RunResult, folder: Path) -> None:
    """Print the metrics, the sizes and the path of the report."""
    run = RunFolder(folder)
    print(f"{summary_text(result)}\n{sizes_line(run, result)}\nreport: {run.report}")


def in_browser(scene: Scene) -> AbstractContextManager[LiveView]:
    """Show the training of a scene in a browser."""

    def started(address: str) -> None:
        print(f"{address} shows the training", flush=True)
        open_browser(address)

    return shown_live(scene, scene.name, started)
