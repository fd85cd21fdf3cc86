"""The methods that the paper compares; `training.registry` has their names."""
