"""`fork`, `verify`, `gc`: the run folder itself."""

from pathlib import Path

import typer

from active3d_pipe.cli import console, session


def fork(
    run: Path = session.RUN,
    round: int = typer.Option(..., "--round", help="Last round that the new run inherits.", show_default=False),
    to: Path = typer.Option(None, "--to", help="Folder of the new run. [default: RUN_fork_ROUND]", show_default=False),
    set_: list[str] = session.SET,
    json: bool = session.JSON,
) -> None:
    """Begin a new run with the first rounds of another: another future from the same past."""
    from active3d_pipe.pipeline.config import resolve_toml, with_values
    from active3d_pipe.pipeline.fork import fork as make_fork

    runner = session.open_run(run)
    target = to or run.resolve().with_name(f"{run.resolve().name}_fork_{round}")
    config = with_values(session.run_config(run, set_), run={"name": target.resolve().name})
    made = make_fork(runner, round, target, config, resolve_toml(config))
    changes = session.changed_settings(runner.config, config)
    if json:
        console.out_json(
            {"schema": "active3d.fork/1", "run": str(made.path), "from": str(run), "round": round, "changes": changes}
        )
        return
    for change in changes:
        console.say(f"configuration: {change}")
    console.out(f"{made.path}: begins with rounds 0 to {round} of {run}; go on with: active3d resume {made.path}")


def verify(
    run: Path = session.RUN,
    deep: bool = typer.Option(False, "--deep", help="Hash every file again."),
    json: bool = session.JSON,
) -> None:
    """Check that every committed artifact is what was committed. Exit code 5 when it is not."""
    from active3d_pipe.errors import DamageFound
    from active3d_pipe.pipeline.verify import verify as check

    found = check(session.open_run(run, to_read=True), deep)
    if json:
        console.out_json(
            {
                "schema": "active3d.verify/1", "run": str(run), "deep": deep, "artifacts": found.artifacts,
                "files": found.files, "bytes": found.bytes, "damage": list(found.damage),
                "remarks": list(found.remarks),
            }
        )
    else:
        for line in (*found.remarks, *found.damage):
            console.out(line)
    if found.damage:
        raise DamageFound(
            f"{run}: {len(found.damage)} of its files or folders are not what was committed; "
            f"`active3d resume {run}` makes them again"
        )
    if not json:
        how = "bytes" if deep else "records and sizes (--deep hashes every file)"
        console.out(f"{run}: {found.artifacts} artifacts, {console.size(found.bytes)}: {how} are what was committed")


def gc(
    run: Path = session.RUN,
    set_: list[str] = session.SET,
    dry_run: bool = typer.Option(False, "--dry-run", help="Say what would go; do nothing."),
    json: bool = session.JSON,
) -> None:
    """Free disk space: run.keep says which rounds stay whole; the others are made again, to the same bytes."""
    from active3d_pipe.pipeline.gc import gc as collect

    runner = session.open_run(run, set_)
    freed = collect(runner, dry_run)
    total = sum(item.bytes for item in freed)
    if json:
        console.out_json(
            {
                "schema": "active3d.gc/1", "run": str(run), "dry_run": dry_run, "bytes": total,
                "artifacts": [{"node": str(i.node), "bytes": i.bytes, "how": i.how} for i in freed],
            }
        )
        return
    for item in freed:
        console.out(f"{item.node}: {item.how}, {console.size(item.bytes)}")
    console.out(f"{console.size(total)} {'would be' if dry_run else 'were'} freed")
