"""A made-up run with data for every section of the report: an L-shaped flat of 6 m x 4 m."""

from dataclasses import replace
from functools import cache

import numpy as np
import trimesh

from active3d_pipe.geometry import se3
from active3d_pipe.report import data as d
from active3d_pipe.report.mesh_pictures import default_views, render_mesh
from active3d_pipe.structures import TriangleMesh

ROUNDS, STEPS = 12, 240


@cache
def room_mesh(seed: int = 0) -> TriangleMesh:
    """A box seen from inside with some furniture, faces towards the room, coloured by position."""
    move = trimesh.transformations.translation_matrix
    parts = [trimesh.creation.box(extents=(6, 4, 2.6), transform=move((3, 2, 1.3)))]
    parts[0].invert()
    for x, y, sx, sy, sz in ((1.2, 1.0, 1.6, 0.8, 0.75), (4.8, 3.3, 0.6, 1.0, 1.9), (4.5, 0.8, 2.0, 1.2, 0.5)):
        parts.append(trimesh.creation.box(extents=(sx, sy, sz), transform=move((x, y, sz / 2))))
    mesh = trimesh.util.concatenate(parts)
    for _ in range(3):
        mesh = mesh.subdivide()
    rng = np.random.default_rng(seed)
    v = mesh.vertices
    stripes = 0.5 + 0.5 * np.sign(np.sin(5 * v[:, 0]) * np.sin(5 * v[:, 1]))
    wall = np.stack([0.75 + 0.1 * stripes, 0.70 + 0.02 * v[:, 2], 0.60 + 0.05 * v[:, 0] / 6], axis=1)
    colors = np.clip(wall * 255 + rng.normal(0, 4, v.shape), 0, 255).astype(np.uint8)
    return TriangleMesh(v.astype(np.float32), mesh.faces.astype(np.int32), colors)


def trajectory() -> np.ndarray:
    s = np.linspace(0, 2 * np.pi, STEPS)
    xyz = np.stack([3 + 1.9 * np.cos(s), 2.1 + 0.9 * np.sin(s) + 0.25 * np.sin(3 * s), np.full(STEPS, 1.4)], axis=1)
    return np.array([se3.pose_from_yaw_pitch(p, 2.2 * a, -0.1 * np.sin(a)) for p, a in zip(xyz, s)])


def floor_plan() -> d.FloorPlan:
    occupancy = np.full((70, 50), 0.5, np.float32)
    occupancy[5:65, 5:45] = 0.05
    occupancy[4, 4:46] = occupancy[65, 4:46] = occupancy[4:66, 4] = occupancy[4:66, 45] = 0.95
    occupancy[30:45, 22:30] = 0.95
    return d.FloorPlan(occupancy, np.array([-0.5, -0.5]), 0.1, 1.4)


def slices(rng: np.random.Generator) -> list[d.SliceSeries]:
    x, y = np.meshgrid(np.linspace(0, 1, 70), np.linspace(0, 1, 50), indexing="ij")
    out = []
    for name, unit, text in (
        ("u_imp", "1", "global structure uncertainty of the field"),
        ("u_exp", "1", "view-dependent local uncertainty of the Gaussians"),
        ("u_time", "1", "temporal variation uncertainty"),
        ("u_final", "1", "fused hierarchical uncertainty"),
        ("entropy", "bit", "entropy of both branches"),
    ):
        rounds = []
        for r in range(ROUNDS):
            known = (x - 0.5) ** 2 + (y - 0.5) ** 2 < (0.1 + 0.06 * r) ** 2
            a = np.where(known, 0.1 + 0.05 * rng.random(x.shape), 0.9).astype(np.float32)
            rounds.append((r, a * (2 if name == "entropy" else 1)))
        out.append(d.SliceSeries(name, unit, text, rounds))
    return out


def views(rng: np.random.Generator) -> list[d.HeldOutView]:
    out = []
    for i in range(6):
        yy, xx = np.mgrid[0:170, 0:300] / 50
        base = 0.5 + 0.3 * np.sin(xx * (1 + 0.3 * i)) * np.cos(2 * yy)
        truth = (np.clip(np.stack([base, base * 0.9, base * 0.7], -1), 0, 1) * 255).astype(np.uint8)
        noise = rng.normal(0, 30 - 4 * i, truth.shape)
        render = np.clip(truth + noise, 0, 255).astype(np.uint8)
        depth = (2 + xx / 4 + 0.2 * np.sin(yy)).astype(np.float32)
        depth[:20, :40] = 0
        shown = (depth + rng.normal(0, 0.03, depth.shape)).astype(np.float32)
        out.append(d.HeldOutView(f"View {7 * i}: PSNR {20 + 2.1 * i:.1f} dB, SSIM {0.7 + 0.04 * i:.3f}", truth, render,
                                 depth, shown))
    return out


def metrics() -> dict[str, d.Metric]:
    out: dict[str, d.Metric] = {}
    values = {
        "accuracy_cm": 0.62, "accuracy_median_cm": 0.31, "completion_cm": 1.31, "completion_median_cm": 0.42,
        "completion_ratio": 0.962, "precision": 0.981, "fscore": 0.9714,
    }
    for base, value in values.items():
        unit = "cm" if base.endswith("cm") else "%"
        better = "lower" if unit == "cm" else "higher"
        for suffix, scale in (("_surface", 1), ("_p2p", 1.6), ("_p2p_floor", 1.2), ("_surface_unculled", 1.1)):
            v = value * scale if unit == "cm" else 1 - (1 - value) * scale
            out[base + suffix] = d.Metric(v, unit, f"{base} in the form {suffix[1:]}", better)
    for base in ("completion_cm", "completion_ratio", "fscore"):
        m = out[f"{base}_surface"]
        value = m.value * (1.01 if m.unit == "%" else 0.8)
        text = "against surface that a reachable pose can see"
        out[f"{base}_surface_observable"] = d.Metric(value, m.unit, text, m.better)
    for suffix, offset in (("", 0.0), ("_circle", 1.1), ("_train", 3.4)):
        out[f"psnr{suffix}"] = d.Metric(25.31 + offset, "dB", "peak signal-to-noise ratio", "higher")
        out[f"psnr{suffix}_p10"] = d.Metric(21.2 + offset, "dB", "a tenth of the views are worse", "higher")
        out[f"ssim{suffix}"] = d.Metric(0.861 + offset / 50, "", "structural similarity, plain", "higher")
        out[f"lpips{suffix}"] = d.Metric(None, "", "learned perceptual distance", "lower", "no weights on this machine")
        out[f"num_views{suffix}"] = d.Metric(100.0, "", "number of views")
    out |= {
        "path_m": d.Metric(15.4, "m", "length of the walked path", "lower"),
        "collisions": d.Metric(0.0, "", "steps that touched a true surface", "lower"),
        "steps": d.Metric(float(STEPS), "", "exploration steps"),
        "seconds_per_step": d.Metric(0.71, "s", "mean wall time of a step", "lower"),
    }
    return out


def sample(pictures: bool = True) -> d.ReportData:
    rng = np.random.default_rng(3)
    poses = trajectory()
    steps = list(range(0, STEPS, STEPS // ROUNDS))
    t = np.arange(ROUNDS)
    mesh = room_mesh()
    goals = poses[::20, :3, 3] + rng.normal(0, 0.1, (len(poses[::20]), 3))
    curve = [
        d.Curve("Completion ratio", "surface", "%", steps, (0.98 * (1 - np.exp(-(t + 1) / 3))).tolist()),
        d.Curve("Completion ratio", "surface, observable", "%", steps, (1 - np.exp(-(t + 1) / 3)).tolist()),
        d.Curve("Mean entropy", "hybrid", "bit", steps, (0.9 * np.exp(-t / 5)).tolist()),
        d.Curve("Mean uncertainty", "u_final", "", steps, (0.6 * np.exp(-t / 4) + 0.1).tolist()),
        d.Curve("Known free and occupied space", "known", "%", steps, (1 - np.exp(-(t + 1) / 4)).tolist()),
        d.Curve("PSNR of captured views", "train", "dB", steps, [None, *(22 + 6 * (1 - np.exp(-t[1:] / 4))).tolist()]),
        d.Curve("Gaussians", "count", "", steps, (180_000 * (1 - np.exp(-(t + 1) / 3))).tolist()),
    ]
    reasons = ["start", *["best_gain"] * (ROUNDS - 2), "stop_gain"]
    decisions = [
        d.DecisionRow(
            r, reason, 900 * np.exp(-r / 4), 500 * np.exp(-r / 3), 1200 * np.exp(-r / 4) if r < ROUNDS - 1 else None,
            1.2 + 0.1 * r, 0.02 * r, 20, 4000 - 100 * r,
        )
        for r, reason in enumerate(reasons)
    ]
    times = [
        d.Timing("capture", "render", 22.4, STEPS), d.Timing("capture", "encode", 4.1, STEPS),
        d.Timing("mapping", "gaussians", 61.5, ROUNDS), d.Timing("mapping", "field", 38.2, ROUNDS),
        d.Timing("mapping", "keyframes", 1.2, ROUNDS), d.Timing("uncertainty", "uncertainty", 9.9, ROUNDS),
        d.Timing("planning", "candidates", 3.9, ROUNDS), d.Timing("planning", "reward", 12.3, ROUNDS),
        d.Timing("planning", "rrt_star", 4.5, ROUNDS), d.Timing("export", "export", 6.5, 1),
        d.Timing("evaluation", "geometry", 11.0, 1), d.Timing("evaluation", "views", 19.0, 1),
    ]
    alphas = np.stack([0.5 + 0.02 * t, 0.3 - 0.01 * t, 0.2 + 0 * t], axis=1)
    return d.ReportData(
        title="Exploration of <flat_01> & co", subtitle="preset demo, seed 7, 240 steps in 12 rounds",
        config_text='[run]\nseed = 7\nscene = "flat_01.glb"\n\n[mapping]\niterations = 30  # a < b & c\n',
        metrics=metrics(),
        headline=("completion_ratio_surface_observable", "accuracy_cm_surface", "psnr", "ssim", "path_m",
                  "seconds_per_step"),
        floor_plan=floor_plan(), trajectory=poses, keyframes=poses[::16, :3, 3], goals=goals, curves=curve,
        views=views(rng), slices=slices(rng), decisions=decisions, timings=times,
        mesh_pictures=render_mesh(mesh, default_views(mesh, poses, 240)) if pictures else [],
        fusion=d.FusionHistory(list(t), alphas, (-200 + 8.0 * t).tolist(), (0.3 * np.exp(-t / 6) + 0.05).tolist()),
        reproducibility={"active3d": "0.1.0", "seed": 7, "threads": 2, "torch": "2.13.0", "scene SHA-256": "ab" * 32},
    )


def bare() -> d.ReportData:
    return replace(d.ReportData(title="Run without data"), missing={"views": "evaluation.num_views is 0"})
