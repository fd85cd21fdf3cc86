"""The claim over the number of Gaussians, the length of training and the size of the photographs.

python experiments/where_textures_pay.py --scenes SCENES --scale small --lpips-weights lpips_alex.npz
"""

from lab.cli import main
from lab.standard import gains_experiment

EXPERIMENT = gains_experiment("where_textures_pay")

if __name__ == "__main__":
    main([EXPERIMENT], __doc__)
