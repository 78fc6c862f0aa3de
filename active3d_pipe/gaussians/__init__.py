"""The explicit branch: Gaussian parameters, rasteriser, losses, seeding, pruning."""
