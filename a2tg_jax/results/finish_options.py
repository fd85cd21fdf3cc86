"""Options of `a2tg finish`, as finish.json of a finished run keeps them."""

import dataclasses
import math

from a2tg_jax.io.config_json import config_from_dict, config_to_dict
from a2tg_jax.results.folder import RunFolder, read_json


@dataclasses.dataclass(frozen=True)
class FinishOptions:
    """Options of finishing a run."""

    max_loss: float = 0.02
    """Largest loss of PSNR in dB by smaller textures, on training views; 0: textures stay."""
    polish_steps: int = 5
    """Steps of conjugate gradients; 0: colours stay."""

    def check(self) -> None:
        """Raise ValueError if a number is out of range."""
        if not 0 <= self.max_loss < math.inf:
            raise ValueError(f"max_loss must be at least 0 dB; got {self.max_loss}")
        if self.polish_steps < 0:
            raise ValueError(f"polish_steps must be at least 0; got {self.polish_steps}")

    @property
    def flags(self) -> list[str]:
        """Options as flags of the command line."""
        return [f"--{name.replace('_', '-')}={value}" for name, value in config_to_dict(self).items()]


def read_finish(run: RunFolder) -> FinishOptions:
    """Return the options with which a run was finished.

    Raises:
      ValueError: if finish.json is damaged or of another version.
    """
    data = read_json(run.finish)
    names = [field.name for field in dataclasses.fields(FinishOptions)]
    own = {name: data[name] for name in names if name in data} if isinstance(data, dict) else data
    return config_from_dict(FinishOptions, own, f"{run.finish}:")
