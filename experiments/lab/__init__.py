"""What the experiments share: grids of runs from files, a queue that trains each once, tables beside the paper's."""
