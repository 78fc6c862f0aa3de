"""File formats of the artifacts: MCAP, Zarr, safetensors, JSON, PLY, GLB. Nothing else reads or writes them."""
