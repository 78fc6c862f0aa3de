"""Pure geometry: rigid transforms, projection, voxel traversal, interpolation."""
