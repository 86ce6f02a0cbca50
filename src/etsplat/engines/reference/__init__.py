"""Plain PyTorch that reads like the paper: the oracle of the others."""
