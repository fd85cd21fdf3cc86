"""Record of a finishing, which a finished run keeps as finish.json."""

import dataclasses

from a2tg_jax.base.config_json import config_from_dict
from a2tg_jax.base.json_text import read_json
from a2tg_jax.results.folder import RunFolder
from a2tg_jax.results.options import FinishOptions


def read_finish(run: RunFolder) -> FinishOptions:
    """Return the options with which a run was finished. Raises ValueError if finish.json is damaged or of another
    version."""
    values = read_json(run.finish)
    if isinstance(values, dict):  # It also names the source.
        names = [field.name for field in dataclasses.fields(FinishOptions)]
        values = {name: values[name] for name in names if name in values}
    return config_from_dict(FinishOptions, values, f"{run.finish}:")
