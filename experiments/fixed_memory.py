"""Every method in the bytes that A²TG ends with: Table 1 of the paper.

python experiments/fixed_memory.py --scenes SCENES --scale small --lpips-weights lpips_alex.npz
"""

from lab.cli import main
from lab.standard import quality_experiment

EXPERIMENT = quality_experiment("fixed_memory", "budget_mb")

if __name__ == "__main__":
    main([EXPERIMENT], __doc__)
