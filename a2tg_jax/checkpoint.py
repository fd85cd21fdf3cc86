"""Checkpoints: the whole state of a training run, on disk and back, bit for bit."""

import dataclasses
import os
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from a2tg_jax.adapt import GradientStatistics
from a2tg_jax.config import TrainConfig
from a2tg_jax.gaussians import Gaussians
from a2tg_jax.io.archive import read_archive, write_archive
from a2tg_jax.io.config_json import config_from_dict, config_to_dict
from a2tg_jax.optim import adam_init
from a2tg_jax.step import TrainState
from a2tg_jax.texture import AtlasLayout, Textures


@dataclasses.dataclass(frozen=True, eq=False)
class History:
    """What was logged every so many iterations; arrays of one length."""

    stage: np.ndarray
    iteration: np.ndarray
    """Within its stage, from 1."""
    loss: np.ndarray
    psnr: np.ndarray
    """Of the training views of that iteration, in dB."""
    num_gaussians: np.ndarray
    """Live Gaussians."""
    megabytes: np.ndarray
    """Reported memory in 10⁶ bytes."""
    seconds: np.ndarray
    """Training time of the stage so far."""

    @staticmethod
    def empty() -> "History":
        counts, values = np.zeros(0, np.int64), np.zeros(0)
        return History(counts, counts, values, values, counts, values, values)

    @property
    def last_seconds(self) -> float:
        return float(self.seconds[-1]) if len(self.seconds) else 0.0

    def with_point(self, *point: float) -> "History":
        """One more row, its values in the order of the fields."""
        fields = dataclasses.fields(self)
        return History(*(np.append(getattr(self, f.name), value) for f, value in zip(fields, point, strict=True)))

    def followed_by(self, other: "History") -> "History":
        """This history and then another."""
        names = [field.name for field in dataclasses.fields(self)]
        return History(*(np.concatenate([getattr(self, name), getattr(other, name)]) for name in names))


@dataclasses.dataclass(frozen=True, eq=False)
class Checkpoint:
    """A training run stopped between two iterations."""

    config: TrainConfig
    stage: int
    """1 or 2."""
    state: TrainState
    layout: AtlasLayout | None
    history: History
    """Of this stage."""

    @property
    def iteration(self) -> int:
        """Iterations of the stage done so far."""
        return int(self.state.iteration)

    @property
    def live_gaussians(self) -> Gaussians:
        """The Gaussians that exist."""
        return self.state.gaussians[: int(self.state.num_live)]


def save_checkpoint(path: str | os.PathLike, checkpoint: Checkpoint) -> None:
    """Writes a checkpoint; an older file of that name is replaced once the new one is whole."""
    state, layout = checkpoint.state, checkpoint.layout
    header = {
        "config": config_to_dict(checkpoint.config),
        "stage": checkpoint.stage,
        "num_rows": state.gaussians.num,
        "resolutions": None if layout is None else [list(resolution) for resolution in layout.resolutions],
        "capacities": None if state.textures is None else [bucket.shape[0] for bucket in state.textures.buckets],
        "has_statistics": state.statistics is not None,
    }
    write_archive(path, header, _named_arrays((state, layout, dataclasses.asdict(checkpoint.history))))


def load_checkpoint(path: str | os.PathLike) -> Checkpoint:
    """Reads what `save_checkpoint` wrote.

    Raises:
      FileNotFoundError: if there is no such file.
      ValueError: if it is no checkpoint, is damaged, or is of another version.
    """
    header, arrays = read_archive(path)
    try:
        template = _template(header)
        names = _named_arrays(template, only_names=True)
        leaves = [arrays[name] for name in names]
        state, layout, history = jax.tree.unflatten(jax.tree.structure(template), leaves)
        config = config_from_dict(TrainConfig, header["config"])
        state, layout = jax.tree.map(jnp.asarray, (state, layout))
        return Checkpoint(config, header["stage"], state, layout, History(**history))
    except KeyError as error:
        raise ValueError(f"{path}: the checkpoint lacks {error}; it is damaged or of another version") from error


def _named_arrays(tree, *, only_names: bool = False) -> dict[str, Any]:
    """The leaves of a pytree under the names of their paths, in the order of the tree."""
    paths = jax.tree_util.tree_flatten_with_path(tree)[0]
    return {jax.tree_util.keystr(path): None if only_names else np.asarray(leaf) for path, leaf in paths}


def _template(header: dict[str, Any]):
    """A tree of the structure that was saved; its values mean nothing."""
    num = header["num_rows"]
    row: Any = np.zeros(0)
    gaussians, textures, layout = Gaussians(row, row, row, row, row), None, None
    if header["resolutions"] is not None:
        textures = Textures(tuple(row for _ in header["capacities"]))
        layout = AtlasLayout(row, row, tuple((int(v), int(u)) for v, u in header["resolutions"]))
    state = TrainState(
        gaussians=gaussians,
        moments=adam_init(gaussians),
        textures=textures,
        texture_moments=None if textures is None else adam_init(textures),
        statistics=GradientStatistics.init(num) if header["has_statistics"] else None,
        num_live=row,
        iteration=row,
    )
    return state, layout, {field.name: row for field in dataclasses.fields(History)}
