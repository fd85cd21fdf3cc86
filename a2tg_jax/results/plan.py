"""Plan of a run: the stages of its systems in the order in which they are trained, each common stage once."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import numpy as np

from a2tg_jax import Stage, System

LONGEST_WITHOUT_CHECKPOINT = 500
"""Largest number of iterations between checkpoints."""
STAGE_OPTIONS = ("loss", "rates", "memory_budget", "exposure", "refine_poses", "corrections", "more")
"""Options of every system that affect training only through its stages."""


@dataclasses.dataclass(frozen=True)
class PlannedStage:
    """Stage of a system, shared by all systems with the same beginning."""

    name: str
    """Name of its files, columns and captions, unique in the run."""
    system: System
    """First system that has the stage."""
    index: int
    """Index of the stage in its system, from 0."""
    start: "PlannedStage | None"
    """The stage whose model it starts from; None for a first stage."""
    stage: Stage = dataclasses.field(repr=False, compare=False)

    @property
    def first_iteration(self) -> int:
        """Number of iterations in the stages before it."""
        return 0 if self.start is None else self.start.first_iteration + self.start.stage.iterations

    @property
    def checkpoint_every(self) -> int:
        """Number of iterations between its checkpoints."""
        # At least ten in a stage, so that a killed short one loses a tenth at most.
        return max(1, min(LONGEST_WITHOUT_CHECKPOINT, self.stage.iterations // 10))


@dataclasses.dataclass(frozen=True)
class RunPlan:
    """The stages of a run in the order in which they are trained."""

    stages: tuple[PlannedStage, ...]
    chains: Mapping[str, tuple[str, ...]]
    """The stages of each system, by its label; the main system's first."""

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(planned.name for planned in self.stages)

    @property
    def main(self) -> tuple[str, ...]:
        """The stages of the main system."""
        return next(iter(self.chains.values()))

    @property
    def kept_states(self) -> tuple[str, ...]:
        """The stages whose state at the end is kept: each system's last, and those that another one continues."""
        kept = {chain[-1] for chain in self.chains.values()}
        for planned in self.stages:
            if planned.stage.continues and planned.start is not None:
                kept.add(planned.start.name)
        return tuple(name for name in self.names if name in kept)

    def __getitem__(self, name: str) -> PlannedStage:
        """Return the stage of this name. Raises ValueError if there is none."""
        for planned in self.stages:
            if planned.name == name:
                return planned
        raise ValueError(f"the run has the models {', '.join(self.names)}; got {name!r}")


def plan_run(systems: Mapping[str, System]) -> RunPlan:
    """Return the stages of systems by label, the main one first. Two systems share their stages up to the first that
    differs. Raises ValueError if two stages would have the same name."""
    stages: list[PlannedStage] = []
    chains: dict[str, tuple[str, ...]] = {}
    for label, system in systems.items():
        chain: list[str] = []
        start = None
        for index, stage in enumerate(system.all_stages()):
            planned = _equal_stage(stages, system, index, start, stage)
            if planned is None:
                planned = PlannedStage(f"{label}-{stage.name}", _system_at(system, index), index, start, stage)
                if any(other.name == planned.name for other in stages):
                    raise ValueError(f"two stages of the run are called {planned.name!r}")
                stages.append(planned)
            chain.append(planned.name)
            start = planned
        chains[label] = tuple(chain)
    return RunPlan(tuple(stages), chains)


def _equal_stage(
    stages: Sequence[PlannedStage], system: System, index: int, start: PlannedStage | None, stage: Stage
) -> PlannedStage | None:
    """Return the planned stage whose training would give the same model, bit for bit; None if there is none."""
    for planned in stages:
        is_alike = (
            planned.index == index
            and planned.start is start
            and common_options(planned.system) == common_options(system)
            and is_equal(planned.stage, stage)
        )
        if is_alike:
            return planned
    return None


def _system_at(system: System, index: int) -> System:
    """Return a system as it was when the stage was its last one: `more` grows by a stage each time."""
    num_first = len(system.all_stages()) - len(system.more)
    return dataclasses.replace(system, more=system.more[: max(0, index + 1 - num_first)])


def common_options(system: System) -> list[Any]:
    """Return the options that training reads from the system directly."""
    names = [field.name for field in dataclasses.fields(System)]
    return [getattr(system, name) for name in names if name not in STAGE_OPTIONS]


def is_same_so_far(a: System, b: System, index: int) -> bool:
    """Return whether two systems train their stages up to an index alike, whatever follows."""
    if common_options(a) != common_options(b):
        return False
    pairs = zip(a.all_stages()[: index + 1], b.all_stages()[: index + 1], strict=True)
    return all(is_equal(first, second) for first, second in pairs)


def is_equal(a: Stage, b: Stage) -> bool:
    """Return whether two stages are equal in everything, arrays and classes included."""
    outside = [field.name for field in dataclasses.fields(Stage) if field.metadata.get("beside")]
    if any(getattr(a, name) != getattr(b, name) for name in outside):
        return False
    # jax.tree compares classes and static fields; arrays are leaves, which == does not reduce to one bool.
    if jax.tree.structure(a) != jax.tree.structure(b):  # type: ignore[operator]
        return False
    pairs = zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True)
    return all(np.array_equal(np.asarray(x), np.asarray(y)) for x, y in pairs)
