"""Trains a little of A²TG and prints a hash of the model's bits: the same number is the same training.

python tests/bits.py [SCENE DOWNSCALE]
"""

import hashlib
import sys

import jax
import numpy as np

import a2tg_jax as a2tg

SYSTEM = a2tg.A2tg(
    stage1_iterations=120,
    stage2_iterations=80,
    densify=a2tg.Mcmc(cap=20_000),
    texture=a2tg.Upscale(at=(0.3, 0.6)),
)


def bits_of(model: a2tg.Model) -> str:
    """A hash of everything that was trained."""
    leaves = [np.asarray(leaf).tobytes() for leaf in jax.tree.leaves(model)]
    return hashlib.sha256(b"".join(leaves)).hexdigest()[:16]


if __name__ == "__main__":
    a2tg.configure_cpu()
    name, downscale = sys.argv[1:] or ("", "1")
    scene = a2tg.load_scene(name, downscale=int(downscale)) if name else a2tg.synthetic_scene(width=208, height=156)
    print(bits_of(a2tg.fit(scene, SYSTEM).model))
