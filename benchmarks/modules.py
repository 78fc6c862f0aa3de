"""Measure the parts, in one interleaved run and as ratios, and write the table of docs/performance.md.

    python benchmarks/modules.py [--run RUN ...] [--no-write]

Without a run folder the parts are measured on a made-up scene; with one, the seconds of its modules and its memory are
tabulated too. A few minutes on two cores. Times are minima over repeats: other work on the machine does less harm.
"""

import argparse
import json
import resource
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import active3d_pipe  # noqa: F401  sets how threads wait, before torch

# isort: split
import numpy as np
import torch
from packed_splats import PackedSplats
from plain_field import PlainField, plain_step

from active3d_pipe.field.config import FieldSettings
from active3d_pipe.field.optimise import FieldOptimiser, field_step
from active3d_pipe.field.rays import sample_rays
from active3d_pipe.field.sdf_field import SdfField
from active3d_pipe.gaussians.raster_pass import RasterPass
from active3d_pipe.gaussians.reference import render_reference
from active3d_pipe.geometry import se3
from active3d_pipe.geometry.lattice import LatticePoints
from active3d_pipe.structures import Camera, Frame

THREADS = 2
PAGE = Path(__file__).resolve().parents[1] / "docs" / "performance.md"
BEGIN, END = "<!-- measured: begin -->", "<!-- measured: end -->"


def room_splats(count: int, rng: np.random.Generator) -> np.ndarray:
    """(count, 14) flat Gaussians of 1 to 2 cm on the walls of a 6 x 5 x 3 m room, four boxes and three balls."""
    room = np.array([6.0, 5.0, 3.0])
    solids = [(np.zeros(3), room)]
    for _ in range(4):
        low = rng.uniform([1, 1, 0], [4.5, 3.5, 0.01])
        solids.append((low, low + rng.uniform(0.4, 1.0, 3)))
    areas = np.array([2 * (s[0] * s[1] + s[1] * s[2] + s[0] * s[2]) for s in (h - low for low, h in solids)])
    balls = [(rng.uniform([1, 1, 0.5], [5, 4, 2]), rng.uniform(0.2, 0.4)) for _ in range(3)]
    areas = np.concatenate([areas, [4 * np.pi * r**2 for _, r in balls]])
    of = rng.choice(len(areas), count, p=areas / areas.sum())
    points, normals = np.empty((count, 3)), np.zeros((count, 3))
    for k in range(len(areas)):
        at = np.flatnonzero(of == k)
        if k < len(solids):
            low, high = solids[k]
            e = high - low
            face = rng.choice(3, len(at), p=np.array([e[1] * e[2], e[0] * e[2], e[0] * e[1]]) / (
                e[1] * e[2] + e[0] * e[2] + e[0] * e[1]))
            points[at] = low + rng.random((len(at), 3)) * e
            side = rng.integers(0, 2, len(at))
            points[at, face] = np.where(side, high[face], low[face])
            normals[at, face] = 1
        else:
            n = rng.normal(size=(len(at), 3))
            n /= np.linalg.norm(n, axis=1, keepdims=True)
            points[at], normals[at] = balls[k - len(solids)][0] + balls[k - len(solids)][1] * n, n
    values = np.zeros((count, 14), np.float32)
    values[:, :3] = points
    values[:, 3:6] = np.log(rng.uniform(0.01, 0.02, (count, 3)))
    values[:, 5] += np.log(0.25)
    # The rotation that turns z onto the normal: halfway between the two.
    half = normals + np.array([0, 0, 1.0])
    half[np.linalg.norm(half, axis=1) < 1e-6] = [1, 0, 0]
    half /= np.linalg.norm(half, axis=1, keepdims=True)
    values[:, 6], values[:, 7:10] = half[:, 2], np.cross([0, 0, 1.0], half)
    opacity = rng.uniform(0.3, 0.99, count)
    values[:, 10] = np.log(opacity / (1 - opacity))
    values[:, 11:] = rng.random((count, 3))
    return values


CORNER = se3.look_at(np.array([0.4, 0.4, 1.5]), np.array([5.0, 4.5, 1.0]))


def interleaved(parts: dict[str, Callable[[], None]], repeats: dict[str, int]) -> dict[str, float]:
    """Least seconds of every part; the parts take turns."""
    least = dict.fromkeys(parts, np.inf)
    for k in range(max(repeats.values())):
        for name, run in parts.items():
            if k < repeats[name]:
                start = time.perf_counter()
                run()
                least[name] = min(least[name], time.perf_counter() - start)
    return least


def measure_rasteriser(count: int = 200_000) -> list[list[str]]:
    """Forward and backward of a view with many Gaussians, against the packed reference."""
    rng = np.random.default_rng(0)
    values, camera = room_splats(count, rng), Camera.from_fov(640, 480, 90)
    grad = rng.normal(size=(5, 480, 640)).astype(np.float32)
    ours, leaf = RasterPass(), torch.from_numpy(values.copy()).requires_grad_()
    packed = PackedSplats(leaf.detach(), camera, CORNER)
    image = {}

    def reference_forward() -> None:
        image["reference"] = packed(leaf)

    def reference_backward() -> None:
        leaf.grad = None
        image["reference"].backward(torch.from_numpy(grad))

    def our_forward() -> None:
        image["ours"] = ours.forward(values, camera, CORNER)

    def our_backward() -> None:
        image["gradient"] = ours.backward_rows(grad)[1]

    parts = {"our forward": our_forward, "our backward": our_backward, "forward": reference_forward,
             "backward": reference_backward}
    s = interleaved(parts, {"our forward": 12, "our backward": 12, "forward": 4, "backward": 4})
    difference = float(np.abs(image["ours"] - image["reference"].detach().numpy()).mean())
    both, other = s["our forward"] + s["our backward"], s["forward"] + s["backward"]
    what = f"rasteriser, {count // 1000}k Gaussians ({ours.num_visible // 1000}k in view), 640x480"
    return [
        [what + ": forward + backward", f"{1000 * s['our forward']:.0f} + {1000 * s['our backward']:.0f} ms",
         f"{1000 * s['forward']:.0f} + {1000 * s['backward']:.0f} ms (packed torch autograd)", f"{other / both:.0f} x"],
        ["pairs of primitive and pixel that count, forward / backward",
         f"{packed.pairs / s['our forward'] / 1e6:.0f} / {packed.pairs / s['our backward'] / 1e6:.0f} M/s",
         f"{packed.pairs / s['forward'] / 1e6:.1f} / {packed.pairs / s['backward'] / 1e6:.1f} M/s",
         f"{packed.pairs / 1e6:.1f} M pairs; mean image difference {difference:.0e}"],
    ]


GROUPS = {"means": slice(0, 3), "log-scales": slice(3, 6), "rotations": slice(6, 10), "opacities": slice(10, 11),
          "colours": slice(11, 14)}


def gradient_errors() -> list[list[str]]:
    """Relative L2 error of the gradients against float64 autograd, pixels next to a discontinuity left out."""
    rng = np.random.default_rng(1)
    values, camera = room_splats(400, rng), Camera.from_fov(83, 61, 90)
    values[:, 3:6] += np.log(12)
    leaf = torch.from_numpy(values).double().requires_grad_()
    image, doubtful = render_reference(leaf, camera, CORNER)
    grad = rng.normal(size=image.shape) * ~doubtful.numpy()
    image.backward(torch.from_numpy(grad))
    ours = RasterPass(t_stop=0.0)
    ours.forward(values, camera, CORNER)
    found, true = ours.backward(grad.astype(np.float32)).astype(np.float64), leaf.grad.numpy()
    errors = {n: np.linalg.norm(found[:, g] - true[:, g]) / np.linalg.norm(true[:, g]) for n, g in GROUPS.items()}
    text = ", ".join(f"{n} {e:.0e}" for n, e in errors.items())
    worst = f"worst {max(errors.values()):.1e}"
    return [["gradients, 400 Gaussians, 83x61: relative error", text, "float64 autograd", worst]]


def made_up_frames(rng: np.random.Generator, count: int = 10) -> list[Frame]:
    """Views of an empty 6 x 5 x 3 m room with a smooth pattern on its walls."""
    camera, size = Camera.from_fov(600, 340, 90), np.array([6.0, 5.0, 3.0])
    v, u = np.meshgrid(np.arange(340) + 0.5, np.arange(600) + 0.5, indexing="ij")
    rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones_like(u)], -1)
    frames = []
    for k in range(count):
        at, to = rng.uniform([2, 2, 1], [4, 3, 2]), rng.uniform([0, 0, 0], size)
        T = se3.look_at(at, to)
        d = rays @ T[:3, :3].T
        depth = (np.where(d > 0, size - at, -at) / np.where(d == 0, 1e-9, d)).min(-1)
        rgb = (127 + 100 * np.sin(3 * (at + depth[..., None] * d))).astype(np.uint8)
        frames.append(Frame(k, k, camera, T, rgb, depth.astype(np.float32)))
    return frames


def measure_field() -> list[list[str]]:
    """One iteration of the implicit branch, against the same in plain torch."""
    s, rng = FieldSettings(), np.random.default_rng(2)
    low, high = np.full(3, -0.2), np.array([6.2, 5.2, 3.2])
    field = SdfField(low, high, s, torch.Generator().manual_seed(0))
    optimiser = FieldOptimiser(field, s)
    torch.manual_seed(0)
    plain = PlainField(low, high, s)
    adam = torch.optim.Adam(plain.parameters(), lr=0.01)
    batch = sample_rays(made_up_frames(rng), s.rays, rng)
    parts = {"ours": lambda: field_step(field, optimiser, batch, s, rng),
             "plain": lambda: plain_step(plain, adam, batch, s, rng)}
    t = interleaved(parts, {"ours": 30, "plain": 15})
    samples = s.rays * (s.free_samples + s.surface_samples) + 2 * s.prior_points
    return [[f"field iteration, {s.rays} rays, {samples} samples (sampling, forward, backward, Adam)",
             f"{1000 * t['ours']:.0f} ms", f"{1000 * t['plain']:.0f} ms (torch: grid_sample, autograd, Adam)",
             f"{t['plain'] / t['ours']:.1f} x"]]


def measure_queries() -> list[list[str]]:
    """SDF at nodes of a lattice: all at once, as marching cubes asks, against the same points one by one."""
    field = SdfField(np.full(3, -0.2), np.array([6.2, 5.2, 3.2]), FieldSettings(), torch.Generator().manual_seed(0))
    axes = [(x + 0.02 * np.arange(65)).astype(np.float32) for x in (2.0, 2.0, 1.0)]
    rows, rng = [], np.random.default_rng(3)
    for name, share in (("all", 1.0), ("a tenth", 0.1)):
        nodes = LatticePoints((axes[0], axes[1], axes[2]), np.flatnonzero(rng.random(65**3) < share))
        points = np.asarray(nodes)
        parts = {"nodes": partial(field.query_sdf, nodes), "points": partial(field.query_sdf, points)}
        t = {part: 1e9 * s / len(nodes) for part, s in interleaved(parts, dict.fromkeys(parts, 12)).items()}
        rows.append([
            f"SDF at {name} of the nodes of a block of 64 cells", f"{t['nodes']:.0f} ns a node",
            f"{t['points']:.0f} ns (ours, point by point)", f"{t['points'] / t['nodes']:.1f} x",
        ])
    return rows


LOOP = ("capture", "mapping", "uncertainty", "planning")


def read_run(run: Path) -> list[list[str]]:
    """Milliseconds a step of every module, seconds of the stages at the end, and memory, from a run's records."""
    newest = {}
    for line in (run / "journal.jsonl").read_text().splitlines():
        event = json.loads(line)
        if event["event"] == "commit":
            newest[event["node"]] = event
    steps = sum(len(json.loads(p.read_text())["poses"]) for p in sorted(run.glob("capture/*/capture.json")))
    rows, total = [], 0.0
    for stage in LOOP:
        events = [e for n, e in newest.items() if n.split("/")[0] == stage]
        seconds = sum(e["seconds"] for e in events)
        total += seconds
        parts: dict[str, float] = {}
        for event in events:
            for name, s in event["timings"].items():
                parts[name] = parts.get(name, 0.0) + s
        text = ", ".join(f"{n} {1000 * s / steps:.1f}" for n, s in sorted(parts.items(), key=lambda x: -x[1]))
        rows.append([run.name, stage, f"{1000 * seconds / steps:.1f}", text])
    rows.append([run.name, f"a step, mean of {steps}", f"{1000 * total / steps:.1f}", ""])
    for stage in ("export", "evaluation", "report"):
        if stage in newest:
            parts = newest[stage]["timings"]
            text = ", ".join(f"{n} {s:.1f} s" for n, s in sorted(parts.items(), key=lambda x: -x[1]))
            rows.append([run.name, stage, f"{newest[stage]['seconds']:.0f} s", text])
    peak = max((e.get("peak_memory_mb") or 0 for e in newest.values()), default=0)
    rows.append([run.name, "peak memory", f"{peak:.0f} MB" if peak else "not recorded", ""])
    return rows


def table(head: list[str], rows: list[list[str]]) -> str:
    return "\n".join("| " + " | ".join(line) + " |" for line in (head, ["---"] * len(head), *rows)) + "\n"


def write_page(text: str) -> None:
    """Replace what lies between the markers of the page."""
    page = PAGE.read_text()
    before, rest = page.split(BEGIN)
    PAGE.write_text(f"{before}{BEGIN}\n{text}{END}{rest.split(END)[1]}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--run", type=Path, action="append", default=[], help="finished run folder; may be given again")
    parser.add_argument("--no-write", action="store_true", help="print only; docs/performance.md stays as it is")
    given = parser.parse_args()
    torch.set_num_threads(THREADS)
    rows = [*measure_rasteriser(), *gradient_errors(), *measure_field(), *measure_queries()]
    rows.append(["peak memory of this measurement, references included",
                 f"{resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024:.0f} MB", "", ""])
    text = table(["part", "ours", "reference", "ratio, remark"], rows)
    modules = [row for run in given.run for row in read_run(run)]
    if modules:
        text += "\n" + table(["run", "module", "ms a step (or s)", "of which"], modules)
    print(text)
    if not given.no_write:
        write_page(text)


if __name__ == "__main__":
    main()
