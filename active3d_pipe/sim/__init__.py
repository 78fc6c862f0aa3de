"""Scenes, renderers, sensor noise. Ground truth lives here and nowhere else."""
