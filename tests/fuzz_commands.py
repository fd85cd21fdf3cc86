"""Whole commands on run folders of which one file is changed: `info`, `eval`, `render`, `train --config`, `--resume`.

They go as far as all that is read has been read and checked: nothing is trained, measured or drawn.
"""

import contextlib
import functools
import io
import shutil
import warnings
from pathlib import Path

SYSTEMS = ("a2tg", "bytewise", "gaussians-2d", "supergaussians", "bbsplat", "textured-gaussians")
LONGEST_LINE = 1500
REACHED = "all was read"


def write_runs(folder: Path) -> None:
    """A finished run of every system, each with its record, history, metrics and models."""
    from run_folders import create_run
    from small_models import some_model, with_row

    from a2tg_jax import History, find_system, save_model
    from a2tg_jax.results.folder import write_json
    from a2tg_jax.results.history import write_history
    from a2tg_jax.results.record import RunRecord, SceneSource, write_record

    history = History.empty()
    for iteration in range(1, 6):
        history = with_row(history, 1, iteration, 0.5 / iteration, 20.0, 12, 0.1, float(iteration))
    for name in SYSTEMS:
        run = create_run(folder / name)
        system = type(find_system(name)).preset("smoke")
        record = RunRecord(SceneSource("synthetic"), name, system, ("gaussians-2d-mcmc",), "smoke")
        write_record(run, record)
        for planned in record.plan.stages:
            model = some_model()
            save_model(run.own(run.model(planned.name)), model)
            write_history(run.own(run.history(planned.name)), history)
        quality = {split: {"psnr": 30.0, "ssim": 0.9} for split in ("test", "train")}
        write_json(run.own(run.metrics), {"scene": "x", "models": dict.fromkeys(record.plan.names, quality)})


def run_commands(run: Path) -> None:
    """Goes through the commands. ValueError: all refused the run; AssertionError: one did not end as it must."""
    _stub()
    new = run.parent / "new-run"
    commands = (
        ["info", str(run)],
        ["eval", str(run)],
        ["render", str(run)],
        ["train", "--config", str(run / "run.toml"), "--out", str(new)],
        ["train", "--out", str(run), "--resume"],
    )
    try:
        printed = [_command(command) for command in commands]
    finally:
        shutil.rmtree(new, ignore_errors=True)
    if all(printed):
        raise ValueError(printed[0])


def _command(arguments: list[str]) -> str:
    """The error that a command ends with; empty where it reads all."""
    from a2tg_jax.cli import main as cli

    out = io.StringIO()
    err = io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err), warnings.catch_warnings():
        code = cli.main(arguments)
    lines = [line for line in err.getvalue().splitlines() if not line.startswith("a2tg: warning: ")]
    assert code in (0, 2), f"{arguments[0]} ended with {code}"
    assert len(lines) == (1 if code else 0), f"{arguments[0]} printed {lines[:3]}"
    assert all(len(line) <= LONGEST_LINE for line in lines), f"{arguments[0]} printed {len(lines[0])} letters"
    return "" if code == 0 or REACHED in lines[0] else lines[0]


@functools.cache
def _stub() -> None:
    """Has commands end where work would begin."""
    from a2tg_jax.cli import main as cli
    from a2tg_jax.data import load
    from a2tg_jax.results import frames, run_evaluation, run_training

    def reached(*arguments, **options):
        raise ValueError(REACHED)

    cli.configure_cpu = lambda: None
    run_training.train_run = reached
    run_evaluation._evaluations = reached
    frames.Renderer = reached
    made = {name: functools.cache(functools.partial(make, num_points=100)) for name, make in load.BUILT_IN.items()}
    load.BUILT_IN = made
