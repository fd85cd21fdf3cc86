"""Training: stages and events, the step, the loop. It does not depend on any system."""

from a2tg_jax.training.checkpoint import (
    Checkpoint as Checkpoint,
    Interrupted as Interrupted,
    load_checkpoint as load_checkpoint,
    save_checkpoint as save_checkpoint,
)
from a2tg_jax.training.divergence import DivergedError as DivergedError
from a2tg_jax.training.fitting import (
    FitResult as FitResult,
    StageResult as StageResult,
    fit as fit,
    fit_stage as fit_stage,
)
from a2tg_jax.training.history import History as History
from a2tg_jax.training.loop import Session as Session
from a2tg_jax.training.options import LossConfig as LossConfig, System as System, like as like
from a2tg_jax.training.registry import SYSTEMS as SYSTEMS, find_system as find_system
from a2tg_jax.training.stage import LearningRates as LearningRates, Stage as Stage
from a2tg_jax.training.terms import Target as Target, Term as Term
