"""The methods that the paper compares; `training.registry` knows them by name."""
