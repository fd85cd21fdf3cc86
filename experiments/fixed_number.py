"""Every method with the same number of Gaussians: Table 2 of the paper, and the table of its appendix.

python experiments/fixed_number.py --scenes SCENES --scale small --lpips-weights lpips_alex.npz
"""

from lab.cli import main
from lab.standard import quality_experiment

EXPERIMENT = quality_experiment("fixed_number", "gaussians")

if __name__ == "__main__":
    main([EXPERIMENT], __doc__)
