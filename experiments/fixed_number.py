"""x"""
from lab.cli import main
if __name__ == "__main__":
    main(["fixed_number"], "x", lambda lab, grids: None)
