"""Plan of a run: the stages of its systems, shared stages once, each with a unique name."""

import dataclasses
from collections.abc import Mapping
from typing import Any

import jax
import numpy as np

from a2tg_jax.training import Stage, System

LONGEST_WITHOUT_CHECKPOINT = 500
"""Largest number of iterations between checkpoints."""
STAGE_OPTIONS = ("loss", "rates", "memory_budget", "exposure", "refine_poses", "corrections")
"""Options of every system that reach training only through its stages."""


@dataclasses.dataclass(frozen=True)
class PlannedStage:
    """Stage of a system, shared by all systems that begin in the same way."""

    name: str
    """Name of its files, columns and captions, unique in the run."""
    system: System
    """First system that has the stage."""
    index: int
    """Index of the stage in its system, from 0."""
    start: str | None
    """Name of the stage whose model it starts from; None for a first stage."""
    stage: Stage = dataclasses.field(repr=False, compare=False)
    """The stage itself."""

    @property
    def checkpoint_every(self) -> int:
        """Number of iterations between its checkpoints."""
        return max(1, min(LONGEST_WITHOUT_CHECKPOINT, self.stage.iterations // 10))


@dataclasses.dataclass(frozen=True)
class RunPlan:
    """The stages of a run in the order in which they are trained."""

    stages: tuple[PlannedStage, ...]
    chains: Mapping[str, tuple[str, ...]]
    """The stages of each system, by its label; the main system's first."""

    @property
    def names(self) -> tuple[str, ...]:
        """The names of the stages."""
        return tuple(planned.name for planned in self.stages)

    @property
    def main(self) -> tuple[str, ...]:
        """The stages of the main system."""
        return next(iter(self.chains.values()))

    def __getitem__(self, name: str) -> PlannedStage:
        """Return the stage of a name. Raises ValueError if the run has none."""
        for planned in self.stages:
            if planned.name == name:
                return planned
        raise ValueError(f"the run has the models {', '.join(self.names)}; got {name!r}")

    def first_iteration(self, name: str) -> int:
        """Return the number of iterations before a stage, in the stages that it follows."""
        start = self[name].start
        return 0 if start is None else self.first_iteration(start) + self[start].stage.iterations


def plan_run(systems: Mapping[str, System]) -> RunPlan:
    """Return the stages of systems by label, the main one first. Two systems share their stages up to the first one
    that differs. Raises ValueError if two stages would have one name."""
    planned: list[PlannedStage] = []
    chains: dict[str, tuple[str, ...]] = {}
    for label, system in systems.items():
        chain: list[str] = []
        for index, stage in enumerate(system.stages()):
            wanted = PlannedStage(f"{label}-{stage.name}", system, index, chain[-1] if chain else None, stage)
            shared = next((known for known in planned if _is_same(known, wanted)), None)
            if shared is None:
                if wanted.name in {known.name for known in planned}:
                    raise ValueError(f"two stages of the run are called {wanted.name!r}")
                planned.append(wanted)
            chain.append((shared or wanted).name)
        chains[label] = tuple(chain)
    return RunPlan(tuple(planned), chains)


def _is_same(known: PlannedStage, wanted: PlannedStage) -> bool:
    """Return whether training both would give the same model, bit for bit."""
    same_place = (known.index, known.start) == (wanted.index, wanted.start)
    same_options = common_options(known.system) == common_options(wanted.system)
    return same_place and same_options and is_equal(known.stage, wanted.stage)


def common_options(system: System) -> list[Any]:
    """Return the options that training reads from the system itself."""
    names = [field.name for field in dataclasses.fields(System)]
    return [getattr(system, name) for name in names if name not in STAGE_OPTIONS]


def is_equal(a: Stage, b: Stage) -> bool:
    """Return whether two stages are equal in everything, arrays and classes included."""
    (leaves, structure), (others, other) = jax.tree.flatten(a), jax.tree.flatten(b)
    if structure != other:  # type: ignore[operator]
        return False
    return all(np.array_equal(np.asarray(x), np.asarray(y)) for x, y in zip(leaves, others, strict=True))
