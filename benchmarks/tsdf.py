"""Our mesh against Open3D TSDF fusion of the very same posed frames, by the same metrics. Reads finished run folders.

    python benchmarks/tsdf.py RUN [RUN ...]

Both meshes are culled by what the run's cameras saw (the evaluation's rule) and judged on the same samples; colour
is judged on the evaluation's held-out views. Prints Markdown; `--png DIR` writes pictures of the worst view.
"""

import argparse
import time
from pathlib import Path

import numpy as np
from mesh_render import MeshRenderer
from run_folder import FinishedRun

from active3d_pipe.evaluation import image_metrics
from active3d_pipe.evaluation.culling import SeenBy
from active3d_pipe.evaluation.evaluate import evaluate_geometry
from active3d_pipe.geometry.raycasting import import_open3d
from active3d_pipe.structures import Frame, TriangleMesh

VOXEL_M, TRUNCATION_VOXELS = 0.02, 4.0


def fuse(frames: list[Frame]) -> tuple[TriangleMesh, dict[str, float]]:
    """TSDF fusion of all frames and the coloured mesh of it, with its seconds."""
    o3d = import_open3d()
    core, truncation = o3d.core, TRUNCATION_VOXELS
    start = time.perf_counter()
    grid = o3d.t.geometry.VoxelBlockGrid(
        ("tsdf", "weight", "color"), (core.float32, core.float32, core.float32), ((1), (1), (3)), VOXEL_M,
        block_resolution=8, block_count=50_000, device=core.Device("CPU:0"),
    )
    for frame in frames:
        c = frame.camera
        # Open3D puts the centre of pixel 0 at 0, we at 0.5.
        K = core.Tensor(np.array([[c.fx, 0, c.cx - 0.5], [0, c.fy, c.cy - 0.5], [0, 0, 1.0]]))
        pose = core.Tensor(np.linalg.inv(frame.T_world_camera))
        depth = o3d.t.geometry.Image(core.Tensor(np.ascontiguousarray(frame.depth)[..., None]))
        color = o3d.t.geometry.Image(core.Tensor(frame.rgb.astype(np.float32) / 255))
        blocks = grid.compute_unique_block_coordinates(depth, K, pose, 1.0, c.far, truncation)
        grid.integrate(blocks, depth, color, K, K, pose, 1.0, c.far, truncation)
    fused = time.perf_counter()
    # The default threshold of 3 observations would drop what few frames saw: all of it counts, as it does for ours.
    found = grid.extract_triangle_mesh(weight_threshold=0.5)
    seconds = {"fusion": fused - start, "mesh": time.perf_counter() - fused}
    color = np.rint(np.clip(found.vertex.colors.numpy(), 0, 1) * 255).astype(np.uint8)
    mesh = TriangleMesh(found.vertex.positions.numpy(), found.triangle.indices.numpy().astype(np.int32), color)
    return mesh, seconds


def view_psnr(render, views: list[Frame]) -> list[float]:
    """PSNR of every view over pixels with true depth."""
    scores = []
    for view in views:
        rgb = render(view.camera, view.T_world_camera)[0]
        scores.append(image_metrics.psnr(np.asarray(rgb), view.rgb / 255.0, view.depth > 0) or 0.0)
    return scores


def gaussian_render(run: FinishedRun):
    def render(camera, T):
        view = run.map.render(camera, T)
        return view.rgb, view.depth, view.alpha
    return render


def extract(run: FinishedRun) -> tuple[TriangleMesh, float]:
    """Our mesh, made anew from the run's final map as the export stage does, with its seconds."""
    from active3d_pipe.export.final_mesh import final_mesh

    run.map.field.query_sdf(np.zeros((8, 3), np.float32))  # kernels compile or load
    frames = run.frames
    start = time.perf_counter()
    mesh = final_mesh(run.map.field, frames, run.config.export.mesh)
    return mesh, time.perf_counter() - start


COLUMNS = (
    ("accuracy_cm_surface", 1, 2), ("accuracy_median_cm_surface", 1, 2), ("completion_cm_surface_observable", 1, 2),
    ("completion_median_cm_surface_observable", 1, 2), ("completion_ratio_surface_observable", 100, 2),
    ("completion_ratio_surface", 100, 2), ("precision_surface", 100, 2),
)
HEAD = (
    "run", "method", "fusion s", "mesh s", "faces", "accuracy cm", "median", "completion (observable) cm", "median",
    "C.R. observable %", "C.R. whole %", "precision %", "PSNR of the mesh dB", "PSNR of the Gaussians dB",
)


def compare(run: FinishedRun, reextract: bool, png: Path | None) -> list[list[str]]:
    frames, settings = run.frames, run.config.evaluation
    meshes = {"TSDF": fuse(frames)}
    if reextract:
        mesh, seconds = extract(run)
        meshes["ours"] = mesh, {"mesh": seconds}
    else:
        meshes["ours, as exported"] = run.mesh, {}
    truth = run.truth(floors=False)
    seen_by = SeenBy(frames[0].camera, np.stack([f.T_world_camera for f in frames]), [f.depth for f in frames])
    views = run.held_out()
    splats = np.mean(view_psnr(gaussian_render(run), views))
    rows = []
    for name, (mesh, seconds) in meshes.items():
        m = evaluate_geometry(mesh, truth, settings, seen_by=seen_by)
        renderer = MeshRenderer(mesh)
        scores = view_psnr(renderer, views)
        if png:
            save_view(png / f"{run.path.name}_{name}.png", renderer, views[int(np.argsort(scores)[len(scores) // 4])])
        rows.append([
            run.path.name, name, *(f"{seconds[k]:.1f}" if k in seconds else "-" for k in ("fusion", "mesh")),
            f"{len(mesh.faces)}", *(f"{m[key] * factor:.{digits}f}" for key, factor, digits in COLUMNS),
            f"{np.mean(scores):.2f}", f"{splats:.2f}" if name != "TSDF" else "",
        ])
    return rows


def save_view(path: Path, renderer: MeshRenderer, view: Frame) -> None:
    from PIL import Image

    path.parent.mkdir(parents=True, exist_ok=True)
    rgb = (renderer(view.camera, view.T_world_camera)[0].clip(0, 1) * 255 + 0.5).astype(np.uint8)
    Image.fromarray(np.concatenate([view.rgb, rgb])).save(path)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="+", type=Path)
    parser.add_argument("--as-exported", action="store_true", help="judge export/mesh.ply instead of a new extraction")
    parser.add_argument("--png", type=Path, help="folder for a picture of one held-out view")
    given = parser.parse_args()
    lines = [row for path in given.runs for row in compare(FinishedRun(path), not given.as_exported, given.png)]
    for line in (HEAD, ["---"] * len(HEAD), *lines):
        print("| " + " | ".join(line) + " |")


if __name__ == "__main__":
    main()
