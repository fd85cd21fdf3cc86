"""Training: stages and events, the step, the loop. It knows no system."""

from a2tg_jax.training.checkpoint import Checkpoint as Checkpoint
from a2tg_jax.training.checkpoint import History as History
from a2tg_jax.training.checkpoint import Interrupted as Interrupted
from a2tg_jax.training.checkpoint import load_checkpoint as load_checkpoint
from a2tg_jax.training.checkpoint import save_checkpoint as save_checkpoint
from a2tg_jax.training.divergence import DivergedError as DivergedError
from a2tg_jax.training.fitting import FitResult as FitResult
from a2tg_jax.training.fitting import StageResult as StageResult
from a2tg_jax.training.fitting import fit as fit
from a2tg_jax.training.fitting import fit_stage as fit_stage
from a2tg_jax.training.options import LossConfig as LossConfig
from a2tg_jax.training.options import System as System
from a2tg_jax.training.options import like as like
from a2tg_jax.training.registry import SYSTEMS as SYSTEMS
from a2tg_jax.training.registry import find_system as find_system
from a2tg_jax.training.session import Session as Session
from a2tg_jax.training.stage import LearningRates as LearningRates
from a2tg_jax.training.stage import Stage as Stage
from a2tg_jax.training.terms import Target as Target
from a2tg_jax.training.terms import Term as Term
