"""x"""
import sys
from lab.cli import main
if __name__ == "__main__":
    main(["claim","ablation","where_textures_pay","fixed_memory","fixed_number"], "x", lambda lab, grids: None)
