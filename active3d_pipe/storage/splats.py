"""Gaussians as the INRIA `.ply` that splat viewers read (degree-0 colour).

The format says nothing of the screen-space filter that the numbers were made for, so what a viewer shows depends on
its own: `export.viewer_model` makes the copy that suits them.
"""

from pathlib import Path

import numpy as np

from active3d_pipe.errors import ArtifactError
from active3d_pipe.storage.files import reading, write_bytes
from active3d_pipe.structures import GaussianModel

SH_C0 = 0.28209479177387814  # value of the constant spherical harmonic
FIELDS = (
    "x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", "opacity",
    "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3",
)  # fmt: skip


def write_splats(path: Path, model: GaussianModel, comment: str = "") -> None:
    """Write binary little-endian PLY: log scales, logit opacities, quaternion (w, x, y, z), world frame (Z up, m)."""
    n = len(model)
    table = np.zeros((n, len(FIELDS)), "<f4")
    table[:, 0:3] = model.means
    table[:, 6:9] = (model.colors - 0.5) / SH_C0
    table[:, 9] = model.opacity_logits
    table[:, 10:13] = model.log_scales
    norm = np.linalg.norm(model.quats, axis=1, keepdims=True)
    table[:, 13:17] = model.quats / np.maximum(norm, 1e-12)
    header = ["ply", "format binary_little_endian 1.0", "comment world frame: metres, Z up, right-handed"]
    if comment:
        header.append(f"comment {comment}")
    header += [f"element vertex {n}", *(f"property float {f}" for f in FIELDS), "end_header"]
    write_bytes(path, ("\n".join(header) + "\n").encode("ascii"), table.tobytes())


def read_splats(path: Path) -> GaussianModel:
    """Read what `write_splats` wrote."""
    with reading(path, "a 3D Gaussian splatting .ply"):
        blob = path.read_bytes()
        head, separator, body = blob.partition(b"end_header\n")
        lines = head.decode("ascii").splitlines()
        names = [line.split()[2] for line in lines if line.startswith("property float ")]
        count = next(int(line.split()[2]) for line in lines if line.startswith("element vertex "))
        if not separator or tuple(names) != FIELDS or len(body) != 4 * count * len(FIELDS):
            raise ArtifactError(f"{path}: not a .ply written by active3d ({count} vertices, fields {names})")
        table = np.frombuffer(body, "<f4").reshape(count, len(FIELDS)).astype(np.float32)
    return GaussianModel(
        table[:, 0:3].copy(), table[:, 10:13].copy(), table[:, 13:17].copy(), table[:, 9].copy(),
        table[:, 6:9] * np.float32(SH_C0) + np.float32(0.5),
    )
