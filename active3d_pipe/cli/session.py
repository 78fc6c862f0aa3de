"""What the commands share: the global options, the registry, and opening a run with its threads set first."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

if TYPE_CHECKING:
    from active3d_pipe.pipeline.config import Config
    from active3d_pipe.pipeline.events import Watcher
    from active3d_pipe.pipeline.graph import Registry
    from active3d_pipe.pipeline.layers import Layers
    from active3d_pipe.pipeline.runner import Runner

debug = False
quiet = False
run_folder: Path | None = None  # where an unforeseen error leaves its traceback

RUN = typer.Argument(..., help="Folder of the run.", show_default=False)
SET = typer.Option([], "--set", metavar="A.B=VALUE", help="Change a setting; may be given again.", show_default=False)
JSON = typer.Option(False, "--json", help="One JSON document on stdout.")


def registry() -> "Registry":
    """The stages, in execution order."""
    from active3d_pipe.pipeline.graph import Registry
    from stages.registry import FINISH, LOOP

    return Registry(LOOP, FINISH)


def use_threads(layers: "Layers") -> None:
    """Set the number of threads before NumPy is imported; a wrong value is left for the validation to name."""
    from active3d_pipe.pipeline.threads import set_threads

    section = layers.values.get("run")
    threads = section.get("threads", 2) if isinstance(section, dict) else 2
    if isinstance(threads, int) and 1 <= threads <= 256:
        set_threads(threads)


def watcher(budget: int = 0) -> "Watcher":
    """Progress on stderr."""
    from active3d_pipe.cli.progress import make_watcher

    return make_watcher(budget, quiet)


def open_run(path: Path, overrides: Sequence[str] = (), *, to_read: bool = False) -> "Runner":
    """An existing run, with `--set` texts on top of its configuration (they are not written).

    Opened only `to_read`, settings that this version does not know are ignored with a warning.
    """
    from active3d_pipe.pipeline.layers import Layers, merge_overrides, read_toml
    from active3d_pipe.pipeline.run_dir import RUN_TOML, RunDir

    global run_folder
    run_dir = RunDir.open(path)
    layers = Layers()
    layers.merge(read_toml(path / RUN_TOML), str(path / RUN_TOML))
    merge_overrides(layers, overrides)
    use_threads(layers)

    from active3d_pipe.pipeline.runner import Runner

    config = run_config(path, overrides, to_read=to_read)
    run_folder = path
    return Runner(run_dir, registry(), config, watcher(config.run.steps))


def run_config(path: Path, overrides: Sequence[str], *, to_read: bool = False) -> "Config":
    """The configuration of a run folder with `--set` texts on top; files named there are found as `run` finds them."""
    from active3d_pipe.cli.console import say
    from active3d_pipe.pipeline.config import Config, load_run_config
    from active3d_pipe.pipeline.run_dir import RUN_TOML

    config = load_run_config(path / RUN_TOML, Config, overrides, warn=say if to_read else None)
    files = ("scene.file", "planning.trajectory")
    if any(text.partition("=")[0].strip() in files for text in overrides):
        from active3d_pipe.cli.scene_files import with_files
        from active3d_pipe.pipeline.layers import Layers

        return with_files(config, Layers())
    return config


def write_config(runner: "Runner") -> None:
    """Make the runner's configuration that of its run folder, and say what changed."""
    from active3d_pipe.cli.console import say
    from active3d_pipe.pipeline.config import Config, load_run_config, resolve_toml
    from active3d_pipe.pipeline.lock import RunLock
    from active3d_pipe.pipeline.run_dir import RUN_TOML, Manifest, new_manifest

    run_dir, config = runner.run_dir, runner.config
    with RunLock(run_dir.path):
        if not run_dir.exists:
            run_dir.write(resolve_toml(config), new_manifest(config.run.seed, config.run.threads))
            return
        changes = changed_settings(load_run_config(run_dir.path / RUN_TOML, Config), config)
        if changes:
            old = run_dir.manifest()
            run_dir.write(
                resolve_toml(config), Manifest(config.run.seed, config.run.threads, old.versions, old.lineage)
            )
            run_dir.journal.append("config", changes=changes)
            for change in changes:
                say(f"configuration: {change}")


def changed_settings(old: Any, new: Any) -> list[str]:
    """Which settings differ, as `a.b 1 -> 2`."""
    from active3d_pipe.pipeline.keys import differences

    return differences({"config": old.model_dump(mode="json")}, {"config": new.model_dump(mode="json")})
