"""Code that the experiments share: grids of runs, a queue that trains each once, tables beside the paper's."""
