"""`status`, `inspect`, `view`: look at a run; nothing is changed."""

import shutil
import subprocess
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from active3d_pipe.cli import console, session

if TYPE_CHECKING:
    from active3d_pipe.pipeline.status import Status
    from active3d_pipe.structures import UncertaintyVolume

PICTURES = (".png", ".jpg", ".svg", ".pdf")


def status(run: Path = session.RUN, json: bool = session.JSON) -> None:
    """What a run holds: rounds, steps, seconds and bytes of every stage, what is stale, missing or pruned."""
    from active3d_pipe.pipeline.status import status as survey

    found = survey(session.open_run(run, to_read=True))
    if json:
        console.out_json(found.to_json())
    else:
        _print_status(found)


def inspect(
    run: Path = session.RUN,
    volume: str = typer.Option("u_final", "--volume", help="u_final, u_imp, u_exp, occupancy, entropy, sdf ..."),
    round: int = typer.Option(None, "--round", help="Round; default: the newest.", show_default=False),
    slice_: str = typer.Option(None, "--slice", metavar="AXIS=METRES", help="A slice, as z=1.2.", show_default=False),
    out: Path = typer.Option(
        None, "--out", help="Picture to write (.png, .jpg, .svg, .pdf). [default: beside the run]", show_default=False
    ),
    json: bool = session.JSON,
) -> None:
    """Numbers and a picture of one uncertainty volume."""
    from active3d_pipe.cli.volume_picture import describe, draw, parse_slice
    from active3d_pipe.errors import ArtifactError, ConfigError
    from active3d_pipe.pipeline.nearest import did_you_mean
    from active3d_pipe.pipeline.stage import NodeId
    from active3d_pipe.structures import VOLUMES

    if volume not in VOLUMES:
        hint = did_you_mean(volume, VOLUMES)
        raise ConfigError(f"--volume {volume}: no such volume{hint}; there are {', '.join(VOLUMES)}")
    runner = session.open_run(run, to_read=True)
    store = runner.run_dir.store
    rounds = [k for k in store.rounds("uncertainty") if not store.is_pruned(NodeId("uncertainty", k))]
    if round is None and not rounds:
        raise ArtifactError(f"{run}: has no uncertainty volume yet; `active3d resume {run}` makes it")
    node = NodeId("uncertainty", rounds[-1] if round is None else round)
    if node.round not in rounds:
        have = f"{rounds[0]} to {rounds[-1]}" if rounds else "none"
        raise ConfigError(f"--round {round}: there is no volume of that round; there are {have}")

    from active3d_pipe.storage.volumes import read_volume

    data: UncertaintyVolume = read_volume(store.folder(node) / "volume.zarr")
    cut = parse_slice(slice_, data.grid)
    document = describe(data, volume, cut)
    whole = run.resolve()
    name = f"{whole.name}_{volume}_round_{node.round:04d}_{cut.axis}{cut.metres:.2f}.png"
    png = out or whole.with_name(name)
    if png.suffix.lower() not in PICTURES:
        raise ConfigError(f"--out {png}: expected a picture's name, ending in {', '.join(PICTURES)}")
    draw(data, volume, cut, png)
    document["picture"] = str(png)
    if json:
        console.out_json(document)
        return
    console.out(f"{volume} of round {node.round}: {VOLUMES[volume][1]}, unit {VOLUMES[volume][0]}")
    grid = data.grid
    console.out(f"grid {' x '.join(map(str, grid.shape))} voxels of {grid.voxel_size:g} m from {_triple(grid.low)} m")
    rows = [
        (name, *(console.number(values[key]) for key in ("voxels", "min", "mean", "median", "p95", "max")))
        for name, values in document["regions"].items()
    ]
    console.out(console.table(rows, ("", "voxels", "min", "mean", "median", "p95", "max")))
    console.out(str(png))


def view(run: Path = session.RUN) -> None:
    """Open the captured frames, the mesh and the Gaussians in the Rerun viewer (`pip install rerun-sdk`)."""
    from active3d_pipe.errors import ConfigError
    from active3d_pipe.pipeline.stage import NodeId

    runner = session.open_run(run, to_read=True)
    folders = [runner.run_dir.store.folder(NodeId("capture", k)) for k in runner.run_dir.store.rounds("capture")]
    found = [path for folder in folders for path in sorted(folder.glob("*.mcap"))]
    files = [str(path) for path in (*found, *sorted(run.glob("export/*.glb")), *sorted(run.glob("export/*.ply")))]
    program = shutil.which("rerun")
    if program is None:
        raise ConfigError(
            "the Rerun viewer is not installed; `pip install rerun-sdk` brings it (it opens the run's "
            f"{len(files)} MCAP, GLB and PLY files), or open {run}/capture/*/frames.mcap in any MCAP viewer"
        )
    console.say(f"opening {len(files)} files in Rerun")
    raise typer.Exit(subprocess.run([program, "--bind", "127.0.0.1", *files], check=False).returncode)


def _print_status(found: "Status") -> None:
    what = "complete" if found.complete else "not complete"
    if found.writer is not None:
        what = f"process {found.writer} works on it"
    console.out(f"{found.path}: {what}; {found.rounds} rounds, {found.steps} of {found.budget} steps")
    if found.ended:
        console.out(f"the loop ended because {found.ended}")
    rows = []
    for name, row in found.totals().items():
        states = ", ".join(f"{count} {state}" for state, count in row["states"].items())
        rows.append((name, str(row["nodes"]), f"{row['seconds']:.1f}", console.size(row["bytes"]), states))
    total = found.totals().values()
    rows.append(("total", str(sum(r["nodes"] for r in total)), f"{sum(r['seconds'] for r in total):.1f}",
                 console.size(sum(r["bytes"] for r in total)), ""))
    console.out(console.table(rows, ("stage", "artifacts", "seconds", "size", "state")))
    for node in found.nodes:
        if node.state.reasons and node.state.state.value not in ("missing",):
            console.out(f"{node.state.node}: {node.state.state.value}: {'; '.join(node.state.reasons[:3])}")
    notes: dict[str, Any] = found.notes()
    if notes:
        console.out(console.table(console.flat_notes(notes)))
    if found.beyond:
        console.out(f"{len(found.beyond)} artifacts lie beyond the loop's end; `active3d gc {found.path}` removes them")
    if found.torn_lines:
        console.out(f"the journal has {found.torn_lines} line(s) torn by a crash; nothing else is affected")


def _triple(values: Any) -> str:
    return f"({', '.join(f'{float(v):.2f}' for v in values)})"
