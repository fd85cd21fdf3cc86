"""The commands for first steps: `a2tg demo` trains a built-in scene, `a2tg doctor` tests the machine."""

import dataclasses
from pathlib import Path


@dataclasses.dataclass(frozen=True)
class Demo:
    """Train the built-in synthetic scene with and without textures.

    Takes one to two minutes on two cores. Open runs/demo/report.html for the results.
    """

    out: Path = Path("runs/demo")
    """Run folder."""
    resume: bool = False
    """Continue from the newest checkpoint in the run folder."""
    overwrite: bool = False
    """Replace an earlier run in that folder; it is kept until the new one has its report."""
    quiet: bool = False
    """Hide the progress of training, but not forecasts, warnings and results."""

    def run(self) -> None:
        from a2tg_jax.cli.training import train_demo

        train_demo(self.out, resumes=self.resume, overwrite=self.overwrite, quiet=self.quiet)


@dataclasses.dataclass(frozen=True)
class Doctor:
    """Print what this machine computes with, and compare images and gradients of all compositors.

    Include the output when you report a problem.
    """

    def run(self) -> None:
        from a2tg_jax.cli.doctor import diagnose

        diagnose()
