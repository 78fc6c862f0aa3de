"""`run`, `resume`, `run-stage`, and the finishing stages by name."""

import shutil
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from active3d_pipe.cli import console, session

if TYPE_CHECKING:
    from active3d_pipe.pipeline.runner import Outcome, Runner

PLAN = "active3d.plan/1"
_DRY = typer.Option(False, "--dry-run", help="Say what would run and why; do nothing.")


def run(
    config: str = typer.Argument(..., help="A preset (demo, default, paper) or a TOML file.", show_default=False),
    out: Path = typer.Option(None, "--out", help="Folder of the run. [default: runs/NAME]", show_default=False),
    set_: list[str] = session.SET,
    dry_run: bool = _DRY,
    json: bool = session.JSON,
) -> None:
    """Explore to the end, export, evaluate, report. Given again, it goes on, or does nothing when complete."""
    from active3d_pipe.pipeline.layers import read_layers

    layers = read_layers(config, set_)
    session.use_threads(layers)

    from active3d_pipe.cli.scene_files import with_files
    from active3d_pipe.pipeline.config import Config, validate, with_values
    from active3d_pipe.pipeline.run_dir import RunDir, new_manifest
    from active3d_pipe.pipeline.runner import Runner

    settings = with_files(validate(layers, Config), layers)
    settings = with_values(settings, run={"name": settings.run.name or layers.name})
    path = out or Path("runs") / settings.run.name
    if dry_run and not (path / "manifest.json").is_file():
        if json:
            console.out_json({"schema": PLAN, "last_round": -1, "ended": None, "nodes": []})
        else:
            console.out(f"{path}: does not exist yet; everything would run")
        return
    run_dir = RunDir.prepare(path)
    session.run_folder = path
    manifest = None if run_dir.exists else new_manifest(settings.run.seed, settings.run.threads)
    runner = Runner(run_dir, session.registry(), settings, session.watcher(settings.run.steps), manifest)
    _explore(runner, dry_run, json)


def resume(
    run: Path = session.RUN, set_: list[str] = session.SET, dry_run: bool = _DRY, json: bool = session.JSON
) -> None:
    """Go on with a run, after an interruption or with changed settings."""
    _explore(session.open_run(run, set_), dry_run, json)


def run_stage(
    stage: str = typer.Argument(
        ..., help="capture, mapping, uncertainty, planning, export, evaluation or report.", show_default=False
    ),
    run: Path = typer.Option(..., "--run", help="Folder of the run.", show_default=False),
    round: int = typer.Option(None, "--round", help="Round; default: the newest that can run.", show_default=False),
    until: str = typer.Option(None, "--until", help="Go on to this later stage.", show_default=False),
    force: bool = typer.Option(False, "--force", help="Run even if nothing changed."),
    set_: list[str] = session.SET,
    dry_run: bool = _DRY,
    json: bool = session.JSON,
) -> None:
    """Run one stage of one round, if its key changed."""
    runner = session.open_run(run, set_)
    if dry_run:
        _print_plan(runner.dry_run(stage, round, force=force, until=until), json)
        return
    # What is refused must leave no trace: the selection is checked before changed settings are written.
    runner.selection(stage, round, until)
    session.write_config(runner)
    outcome = _closing(runner, lambda: runner.run_stage(stage, round, force=force, until=until))
    if json:
        console.out_json(_document(runner, outcome))
    elif not outcome.executed:
        console.out(f"{stage}: up to date, nothing to do (--force runs it anyway)")
    else:
        console.out(f"{', '.join(str(node) for node in outcome.executed)}: done")
        waiting = sum(not s.state.is_hit for s in runner.survey().values())
        if waiting:
            console.out(f"{waiting} artifacts that follow are stale or missing; active3d resume {run}")


def export(
    run: Path = session.RUN,
    to: Path = typer.Option(..., "--to", help="Folder to copy mesh and Gaussians into.", show_default=False),
    json: bool = session.JSON,
) -> None:
    """Copy the final mesh and Gaussians out of a run, made first if need be."""
    from active3d_pipe.errors import OutputError
    from active3d_pipe.pipeline import files
    from active3d_pipe.pipeline.stage import NodeId

    if to.resolve().is_relative_to(run.resolve()):
        raise OutputError(f"--to {to}: lies inside the run, which holds what its stages make; choose another folder")
    runner = session.open_run(run)
    _closing(runner, lambda: runner.run_stage("export"))
    node = NodeId("export")
    record = runner.surveyor.record(node)
    names = sorted(record.files) if record is not None else []
    with files.writing(to):
        for name in names:
            target = to / name
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(runner.run_dir.store.folder(node) / name, target)
    if json:
        console.out_json({"schema": "active3d.export/1", "folder": str(to), "files": names})
    else:
        for name in names:
            console.out(str(to / name))


def evaluate(run: Path = session.RUN, json: bool = session.JSON) -> None:
    """Measure what a run reconstructed, made first if need be."""
    _finish(run, "evaluation", json)


def report(run: Path = session.RUN, json: bool = session.JSON) -> None:
    """Write the HTML page of a run, made first if need be."""
    _finish(run, "report", json)


def _finish(run: Path, stage: str, json: bool) -> None:
    from active3d_pipe.pipeline.stage import NodeId

    runner = session.open_run(run)
    names = [s.name for s in runner.registry.finish]
    # A page without an evaluation would be empty: what comes before a finishing stage is made as well.
    outcome = _closing(runner, lambda: runner.run_stage(names[0], until=stage))
    folder = runner.run_dir.store.folder(NodeId(stage))
    record = runner.surveyor.record(NodeId(stage))
    if json:
        console.out_json({**_document(runner, outcome), "folder": str(folder)})
        return
    if record is not None and record.notes:
        console.out(console.table(console.flat_notes(record.notes)))
    for name in sorted(record.files if record is not None else ())[:8]:
        console.out(str(folder / name))


def _explore(runner: "Runner", dry_run: bool, json: bool) -> None:
    if dry_run:
        _print_plan(runner.dry_run(), json, whole=True)
        return
    session.write_config(runner)
    outcome = _closing(runner, runner.run)
    if json:
        console.out_json(_document(runner, outcome))
    else:
        _print_summary(runner, outcome)


def _closing(runner: "Runner", work: Any) -> Any:
    """Do `work`; the progress bar goes away before anything else is printed."""
    try:
        return work()
    finally:
        close = getattr(runner.watcher, "close", None)
        if close is not None:
            close()


def _print_plan(outcome: "Outcome", json: bool, whole: bool = False) -> None:
    if json:
        console.out_json(
            {
                "schema": PLAN, "last_round": outcome.last_round, "ended": outcome.ended,
                "nodes": [
                    {
                        "node": str(s.node), "state": s.state.value, "hit": s.state.is_hit, "reasons": list(s.reasons)
                    }
                    for s in outcome.plan
                ],
            }
        )
        return
    rows = [
        (str(s.node), "hit" if s.state.is_hit else "miss", s.state.value, "; ".join(s.reasons)) for s in outcome.plan
    ]
    console.out(console.table(rows))
    misses = sum(not s.state.is_hit for s in outcome.plan)
    more = "" if outcome.ended or not whole else ", and the loop goes on from there"
    console.out(f"{misses} of {len(rows)} would run{more}")


def _document(runner: "Runner", outcome: "Outcome") -> dict:
    notes: dict[str, Any] = {}
    for stage in runner.registry.finish:
        from active3d_pipe.pipeline.stage import NodeId

        record = runner.surveyor.record(NodeId(stage.name))
        if record is not None:
            notes[stage.name] = record.notes
    return {
        "schema": "active3d.outcome/1", "run": str(runner.run_dir.path), "ended": outcome.ended,
        "last_round": outcome.last_round, "steps": runner.steps(outcome.last_round),
        "executed": [str(node) for node in outcome.executed], "notes": notes,
    }


def _print_summary(runner: "Runner", outcome: "Outcome") -> None:
    from active3d_pipe.pipeline.stage import NodeId

    path = runner.run_dir.path
    done = f"{len(outcome.executed)} artifacts made" if outcome.executed else "complete already, nothing to do"
    console.out(f"{path}: {done}; {runner.steps(outcome.last_round)} steps in {outcome.last_round + 1} rounds")
    console.out(f"ended because {outcome.ended}")
    for stage in runner.registry.finish:
        record = runner.surveyor.record(NodeId(stage.name))
        if record is not None and record.notes:
            console.out(f"\n{stage.name}")
            console.out(console.table([(f"  {name}", value) for name, value in console.flat_notes(record.notes)]))
        if record is not None and "index.html" in record.files:
            console.out(f"\nreport: {runner.run_dir.store.folder(record.node) / 'index.html'}")
