"""Record of a finishing, which a finished run keeps as finish.json."""

import dataclasses
import math

from a2tg_jax.base.config_json import config_from_dict
from a2tg_jax.base.json_text import read_json
from a2tg_jax.results.folder import RunFolder


@dataclasses.dataclass(frozen=True)
class FinishOptions:
    """Options of a finishing."""

    max_loss: float = 0.02
    """Largest loss of PSNR in dB by smaller textures, on training views; 0 leaves textures unchanged."""
    polish_steps: int = 5
    """Steps of least squares, each of which draws every training view; too many overfit these views, and 0 leaves
    colours unchanged."""

    def check(self) -> None:
        """Raise ValueError if a number is out of range."""
        if not 0 <= self.max_loss < math.inf:
            raise ValueError(f"max_loss must be at least 0 dB; got {self.max_loss}")
        if self.polish_steps < 0:
            raise ValueError(f"polish_steps must be at least 0; got {self.polish_steps}")


def read_finish(run: RunFolder) -> FinishOptions:
    """Return the options with which a run was finished. Raises ValueError if finish.json is damaged or of another
    version."""
    values = read_json(run.finish)
    if isinstance(values, dict):  # It also names the source.
        names = [field.name for field in dataclasses.fields(FinishOptions)]
        values = {name: values[name] for name in names if name in values}
    return config_from_dict(FinishOptions, values, f"{run.finish}:")
