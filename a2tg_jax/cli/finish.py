"""The command `a2tg finish`."""

import dataclasses
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from a2tg_jax.results.checks import check_apart, check_output, check_weights
from a2tg_jax.results.finish_options import FinishOptions
from a2tg_jax.results.finishing import finish_run
from a2tg_jax.results.folder import RunFolder, open_run


@dataclasses.dataclass(frozen=True)
class Finish:
    """Shrink and polish the model of a finished run, in a new run folder.

    Textures become smaller where that loses next to nothing on the training views. Then colours and texels move to the
    least squared error on them. The new run is evaluated; the old one stays as it is.

    Example:
      a2tg finish runs/fox --out runs/fox-finished
    """

    folder: Annotated[Positional[Path], arg(metavar="RUN")]
    """Run folder."""
    out: Path
    """New run folder."""
    max_loss: float = FinishOptions.max_loss
    """Largest loss of PSNR in dB by smaller textures, on training views; 0 leaves textures as they are."""
    polish_steps: int = FinishOptions.polish_steps
    """Steps of least squares, each of which draws every training view; many fit these views too closely, and 0 leaves
    colours as they are."""
    lpips_weights: Annotated[Path | None, arg(metavar="FILE")] = None
    """Weights file (.npz) for LPIPS with AlexNet or SqueezeNet. Without it, LPIPS is not computed."""

    def run(self) -> None:
        check_weights(self.lpips_weights)
        check_apart(self.out, self.folder)
        check_output(self.out)
        options = FinishOptions(self.max_loss, self.polish_steps)
        table = finish_run(open_run(self.folder), self.out, options, lpips_weights=self.lpips_weights)
        print(table)
        print(f"report: {RunFolder(self.out).report}")
