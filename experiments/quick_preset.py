"""What short runs want: the preset `quick` with its numbers put back to the paper's, one at a time.

python experiments/quick_preset.py --scenes SCENES --scale small --lpips-weights lpips_alex.npz
"""

from lab.cli import main
from lab.standard import choices_experiment

EXPERIMENT = choices_experiment("quick_preset")

if __name__ == "__main__":
    main([EXPERIMENT], __doc__)
