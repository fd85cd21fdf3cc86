"""The methods that the paper compares, one file each; `training.registry` knows them by name."""
