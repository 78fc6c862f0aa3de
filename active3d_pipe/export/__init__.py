"""Mesh and Gaussians out of the map."""
