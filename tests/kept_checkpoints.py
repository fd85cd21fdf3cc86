"""Training whose checkpoints are kept."""

import dataclasses

import jax
import numpy as np

from a2tg_jax import fit


def fit_keeping_checkpoints(scene, system, every: int = 8):
    """The result, and copies of the checkpoints: the loop donates the state's buffers to the next step."""
    kept = []

    def keep(checkpoint):
        kept.append(dataclasses.replace(checkpoint, state=jax.tree.map(np.array, checkpoint.state)))

    return fit(scene, system, on_checkpoint=keep, checkpoint_every=every), kept
