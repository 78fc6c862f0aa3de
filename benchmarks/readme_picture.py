"""The picture at the top of the README, from a finished run: mesh, path, and a held-out view beside the truth.

    python benchmarks/readme_picture.py data/runs/demo docs/images/demo.png
"""

import json
import sys
from pathlib import Path

import numpy as np
from PIL import Image

from active3d_pipe.report.mesh_pictures import default_views, render_mesh
from active3d_pipe.storage import meshes
from active3d_pipe.storage.files import read_tensors

HEIGHT, GAP = 380, 8


def fit(image: np.ndarray) -> np.ndarray:
    """Scale to the common height."""
    width = round(image.shape[1] * HEIGHT / image.shape[0])
    return np.asarray(Image.fromarray(image).resize((width, HEIGHT), Image.Resampling.LANCZOS))


def main(run: Path, target: Path) -> None:
    logs = sorted(run.glob("capture/*/capture.json"))
    poses = np.concatenate([np.array(json.loads(p.read_text())["poses"]) for p in logs])
    mesh = meshes.read_mesh(run / "export" / "mesh.ply")
    pictures = render_mesh(mesh, default_views(mesh, poses, 720))
    examples = [read_tensors(p) for p in sorted(run.glob("evaluation/examples/*.safetensors"))]
    examples.sort(key=lambda pair: pair[1]["psnr"])
    tensors, about = examples[len(examples) // 2]  # the middle one: neither the best nor the worst
    pair = np.concatenate([tensors["truth_rgb"], tensors["render_rgb"]], axis=0)
    tiles = [fit(pictures[0].image), fit(pictures[1].image), fit(pair)]
    gap = np.full((HEIGHT, GAP, 3), 255, np.uint8)
    row = np.concatenate([part for tile in tiles for part in (tile, gap)][:-1], axis=1)
    target.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(row).save(target, optimize=True)
    print(f"{target}: held-out view at {about['psnr']:.1f} dB, {row.shape[1]}x{row.shape[0]} px")


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
