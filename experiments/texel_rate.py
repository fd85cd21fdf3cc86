"""The texels' learning rate at two densities, on all scenes but those held out.

python experiments/texel_rate.py --scenes SCENES --scale small --lpips-weights lpips_alex.npz
"""

from lab.cli import main
from lab.standard import choices_experiment

EXPERIMENT = choices_experiment("texel_rate")

if __name__ == "__main__":
    main([EXPERIMENT], __doc__)
