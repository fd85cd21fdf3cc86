"""The paper's claim: at equal bytes A²TG is above more plain Gaussians, and above textures of one size.

python experiments/claim.py --scenes SCENES --scale small --lpips-weights lpips_alex.npz
"""

from lab.cli import main
from lab.standard import gains_experiment

EXPERIMENT = gains_experiment("claim")

if __name__ == "__main__":
    main([EXPERIMENT], __doc__)
