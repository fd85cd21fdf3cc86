"""Each open choice of the method, one at a time, on all scenes but those held out.

python experiments/defaults.py --scenes SCENES --scale small --lpips-weights lpips_alex.npz
"""

from lab.cli import main
from lab.standard import choices_experiment

EXPERIMENT = choices_experiment("defaults")

if __name__ == "__main__":
    main([EXPERIMENT], __doc__)
