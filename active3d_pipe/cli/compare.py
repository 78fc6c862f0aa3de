"""`compare`: variants x scenes x seeds, then tables, curves and paired tests."""

import os
import subprocess
import sys
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from active3d_pipe.cli import console, session

if TYPE_CHECKING:
    from active3d_pipe.pipeline.interrupt import StopRequest
    from active3d_pipe.pipeline.sweep import Cell, Spec, Sweep
    from active3d_pipe.report.comparison import Metric

FOLDERS = ("ablations", "baselines", "maps")


def compare(
    what: list[str] = typer.Argument(
        ..., help="A comparison (TOML), or variants: policies, ablations, configuration files.", show_default=False
    ),
    scene: list[str] = typer.Option([], "--scene", help="A scene; may be given again.", show_default=False),
    seed: list[int] = typer.Option(
        [], "--seed", help="A seed; may be given again. [default: 0]", show_default=False
    ),
    steps: int = typer.Option(None, "--steps", help="Steps of every run.", show_default=False),
    base: str = typer.Option(
        None, "--base", help="Preset or file under every variant. [default: default]", show_default=False
    ),
    out: Path = typer.Option(None, "--out", help="Folder of the comparison. [default: runs/NAME]", show_default=False),
    set_: list[str] = session.SET,
    jobs: int = typer.Option(
        1, "--jobs", min=1, help="Runs at a time. With --set run.threads=1, two on two cores take 0.6 of the time."
    ),
    tables_only: bool = typer.Option(False, "--tables-only", help="Make the tables of what is there; run nothing."),
    dry_run: bool = typer.Option(False, "--dry-run", help="Say what would run; do nothing."),
    json: bool = session.JSON,
) -> None:
    """Compare policies and configurations over scenes and seeds. Given again, it goes on where it stopped."""
    from active3d_pipe.pipeline.interrupt import StopRequest
    from active3d_pipe.pipeline.sweep import Sweep
    from active3d_pipe.report.comparison_data import is_complete

    spec, name = _spec(what, scene, seed, steps, base, set_)
    _metrics(spec)  # a wrong name is told before hours of runs
    path = out or Path("runs") / name
    sweep = Sweep(path, spec)
    if dry_run:
        if json:
            console.out_json(_document(sweep, is_complete))
        else:
            _print_plan(sweep, is_complete)
        return
    failed = 0
    if not tables_only:
        with StopRequest() as stop:
            failed = sweep.run(partial(_execute, stop), console.say, is_complete, jobs)
    written = write_tables(sweep)
    if json:
        console.out_json({**_document(sweep, is_complete), "files": [str(f) for f in written]})
    else:
        console.out((path / "overall.md").read_text(encoding="utf-8").rstrip())
        console.out("\n" + "\n".join(str(f) for f in written))
    if failed:
        console.say(f"active3d: {failed} of {len(sweep.cells)} runs failed; they are marked in the tables")
        raise typer.Exit(1)


def variant_settings(name: str) -> Mapping[str, Any]:
    """What a variant's name stands for: `final`, a TOML file, an ablation, a baseline, a map, or a policy."""
    from importlib.resources import files as package_files

    from active3d_pipe.errors import ConfigError
    from active3d_pipe.pipeline.layers import read_toml
    from active3d_pipe.planning.policies.registry import check_name

    if name == "final":
        return {}
    if name.endswith(".toml"):
        table = read_toml(Path(name))
        if "preset" in table:
            raise ConfigError(f"{name}: a variant lies on top of the base and names no preset; use --base, or `base`")
        planning = table.get("planning")
        if isinstance(planning, dict) and isinstance(walk := planning.get("trajectory"), str) and walk:
            # Its settings become those of a command line, where a relative path belongs to the working directory.
            beside = Path(name).resolve().parent / walk
            planning["trajectory"] = str(beside) if beside.exists() else walk
        return table
    for folder in FOLDERS:
        entry = package_files("configs").joinpath(folder, f"{name}.toml")
        if entry.is_file():
            return read_toml(Path(str(entry)))
    try:
        return {"planning": {"policy": check_name(name)}}
    except ValueError as error:
        raise ConfigError(f"variant {name!r} is no TOML file, ablation, baseline or map, and {error}") from None


def _spec(
    what: list[str], scenes: list[str], seeds: list[int], steps: int | None, base: str | None, settings: list[str]
) -> "tuple[Spec, str]":
    """The comparison from a file, or from the command line alone; options go over the file."""
    from active3d_pipe.errors import ConfigError
    from active3d_pipe.pipeline.layers import read_toml
    from active3d_pipe.pipeline.sweep import Spec, checked, make_variant, read_spec

    if len(what) == 1 and what[0].endswith(".toml") and "variants" in read_toml(Path(what[0])):
        spec, name = read_spec(Path(what[0]), variant_settings), Path(what[0]).stem
    else:
        if not scenes:
            raise ConfigError("--scene is not given; give at least one scene (a file, a name, or a recipe)")
        variants = tuple(make_variant(v, variant_settings, "command line") for v in what)
        spec, name = Spec("Comparison", "default", (), (0,), variants), "comparison"
    more = ([f"run.steps={steps}"] if steps is not None else []) + settings
    spec = replace(
        spec, scenes=tuple(scenes) or spec.scenes, seeds=tuple(seeds) or spec.seeds, base=base or spec.base,
        settings=(*spec.settings, *more),
    )
    return checked(spec), name


def _metrics(spec: "Spec") -> "list[Metric]":
    """The rows of the tables; ConfigError for a name that is not known."""
    from active3d_pipe.errors import ConfigError
    from active3d_pipe.report.comparison_tables import chosen_metrics

    try:
        return chosen_metrics(spec.metrics)
    except KeyError as error:
        raise ConfigError(f"metrics: {error} is not known; expected names of METRICS in report/comparison.py") from None


def command(cell: "Cell", folder: Path) -> list[str]:
    """The command line that makes one run: what a user would type."""
    line = [sys.executable, "-m", "active3d_pipe.cli.main", "--quiet", "run", cell.base, "--out", str(folder)]
    for text in cell.settings:
        line += ["--set", text]
    return line


def _execute(stop: "StopRequest", cell: "Cell", folder: Path) -> str:
    """One run in a process of its own, so that nothing of it is left when it ends, however it ends."""
    from active3d_pipe.pipeline.interrupt import Interrupted

    process = subprocess.Popen(
        command(cell, folder), stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, env=dict(os.environ)
    )
    told = False
    while True:
        try:
            _, errors = process.communicate(timeout=1.0)
            break
        except subprocess.TimeoutExpired:
            if stop.signum is not None and not told:
                process.send_signal(stop.signum)  # a second one from the terminal is harmless: it ends at once
                told = True
    code = process.returncode
    if stop.signum is not None or code in (130, 143):
        raise Interrupted("stopped; what is done is kept, the same command goes on", stop.signum or code - 128)
    if code == 0:
        return ""
    lines = [line for line in errors.splitlines() if line.strip()]
    return lines[-1].removeprefix("active3d: ") if lines else f"ended with code {code}"


def write_tables(sweep: "Sweep") -> list[Path]:
    """Write every table and figure of what is there; the files."""
    from active3d_pipe.pipeline import files
    from active3d_pipe.report import comparison_tables as tables
    from active3d_pipe.report.comparison import EXTRA, paired_tests
    from active3d_pipe.report.comparison_curves import write_figure
    from active3d_pipe.report.comparison_data import read_result

    results = []
    for cell in sweep.cells:
        ended = sweep.state(cell)
        error = ended.error if ended is not None and ended.state == "failed" else ""
        outdated = sweep.is_outdated(cell)
        results.append(read_result(cell.scene, cell.variant, cell.seed, cell.folder(sweep.out), error, outdated))
    labels = {v.name: v.label for v in sweep.spec.variants}
    metrics = _metrics(sweep.spec)
    grid, extra = tables.Grid(results, labels, metrics), tables.Grid(results, labels, EXTRA)
    title = sweep.spec.title
    texts = {
        "overall.md": tables.overall_markdown(grid), "per_scene.md": tables.per_scene_markdown(grid),
        "running.md": tables.overall_markdown(extra),
        "overall.tex": tables.overall_latex(grid, title), "per_scene.tex": tables.per_scene_latex(grid, title),
        "summary.csv": tables.summary_csv(grid), "runs.csv": tables.runs_csv(results),
    }
    if len(labels) > 1:
        reference = next(iter(labels))
        tests = paired_tests(results, list(labels), metrics)
        texts["tests.md"] = tables.tests_markdown(tests, labels, labels[reference])
    with files.writing(sweep.out):
        files.make_folder(sweep.out)
        for name, text in texts.items():
            files.replace_file(sweep.out / name, text.encode())
        figures = write_figure(results, labels, sweep.out)
    return [*(sweep.out / name for name in texts), *figures]


def _state(sweep: "Sweep", cell: "Cell", is_complete: Callable[[Path], bool]) -> str:
    ended = sweep.state(cell)
    if ended is not None and ended.state == "failed":
        return f"failed: {ended.error}"
    return "done" if ended is not None and is_complete(cell.folder(sweep.out)) else "to do"


def _document(sweep: "Sweep", is_complete: Callable[[Path], bool]) -> dict[str, Any]:
    states = {f"{c.scene}/{c.variant}/seed_{c.seed}": _state(sweep, c, is_complete) for c in sweep.cells}
    return {"schema": "active3d.compare/1", "folder": str(sweep.out), "runs": states}


def _print_plan(sweep: "Sweep", is_complete: Callable[[Path], bool]) -> None:
    import shlex

    rows = [(c.scene, c.variant, str(c.seed), _state(sweep, c, is_complete)) for c in sweep.cells]
    console.out(console.table(rows, ("scene", "variant", "seed", "state")))
    left = [c for c in sweep.cells if _state(sweep, c, is_complete) != "done"]
    console.out(f"{len(left)} of {len(rows)} would run")
    if left:
        line = command(left[0], left[0].folder(sweep.out))
        console.out("the first: active3d " + shlex.join(line[4:]))
