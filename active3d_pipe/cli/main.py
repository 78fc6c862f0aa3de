"""`active3d`: the entry point. Every error is one line and an exit code (`docs/commands.md`)."""

import errno
import os
import sys
import traceback
import warnings
from pathlib import Path

import typer

from active3d_pipe import __version__
from active3d_pipe.cli import console, session
from active3d_pipe.cli.compare import compare
from active3d_pipe.cli.configure import app as configure
from active3d_pipe.cli.doctor import doctor
from active3d_pipe.cli.explore import evaluate, export, report, resume, run, run_stage
from active3d_pipe.cli.look import inspect, status, view
from active3d_pipe.cli.manage import fork, gc, verify
from active3d_pipe.cli.scene import app as scene
from active3d_pipe.errors import Active3dError, ConfigError

app = typer.Typer(
    name="active3d", no_args_is_help=True, add_completion=True, rich_markup_mode=None, pretty_exceptions_enable=False,
    help="Explore an unknown indoor scene and reconstruct it in 3D, on a CPU.",
)


def _version(value: bool) -> None:
    if value:
        console.out(f"active3d {__version__}")
        raise typer.Exit


@app.callback()
def _options(
    debug: bool = typer.Option(False, "--debug", help="Show the traceback of an error."),
    quiet: bool = typer.Option(False, "--quiet", "-q", help="No progress on stderr."),
    version: bool = typer.Option(False, "--version", callback=_version, is_eager=True, help="Show the version."),
) -> None:
    session.debug, session.quiet = debug, quiet


for command in (
    run, resume, run_stage, status, inspect, fork, export, evaluate, report, verify, gc, view, doctor, compare,
):
    app.command(command.__name__.replace("_", "-"))(command)
app.add_typer(scene, name="scene")
app.add_typer(configure, name="config")


def main() -> None:
    """Run the command line and exit with its code."""
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:  # closed (`2>&-`): no file of a run may take its place
            setattr(sys, name, os.fdopen(os.open(os.devnull, os.O_WRONLY), "w"))
    # Numba tells of an old TBB library although it goes on with OpenMP, which is what is wanted.
    warnings.filterwarnings("ignore", message="The TBB threading layer requires TBB")
    sys.exit(_main(sys.argv[1:]))


def _main(arguments: list[str]) -> int:
    try:
        code = typer.main.get_command(app).main(args=arguments, prog_name="active3d", standalone_mode=False)
        return code if isinstance(code, int) else 0
    except Active3dError as error:
        _trace()
        for line in str(error).splitlines() or [type(error).__name__]:
            console.say(f"active3d: {line}")
        return error.exit_code
    except (KeyboardInterrupt, typer.Abort):
        console.say("active3d: stopped at once; everything committed is kept")
        return 130
    except Exception as error:
        if type(error).__name__ == "NoArgsIsHelpError":
            console.out(str(error))
            return 2
        if hasattr(error, "format_message"):  # a usage error of the command line itself
            console.say(f"active3d: {' '.join(error.format_message().split())} (see active3d --help)")
            return int(getattr(error, "exit_code", 2))
        if isinstance(error, OSError) and error.errno == errno.ENAMETOOLONG:
            console.say(f"active3d: {error.filename}: the name is too long for the file system; give a shorter one")
            return ConfigError.exit_code
        return _internal(error)


def _internal(error: Exception) -> int:
    """An error that nobody foresaw: one line, and the traceback where it can be found."""
    _trace()
    where = "run again with `active3d --debug ...` for the traceback"
    if session.run_folder is not None:
        log = session.run_folder / "logs" / "error.log"
        try:
            log.parent.mkdir(exist_ok=True)
            with open(log, "a", encoding="utf-8") as f:
                f.write(f"$ {' '.join(sys.argv)}\n{traceback.format_exc()}\n")
            where = f"the traceback is in {log}"
        except OSError:
            pass
    text = " ".join(str(error).split())
    console.say(f"active3d: internal error: {type(error).__name__}: {text}; {where}")
    return 1


def _trace() -> None:
    if session.debug:
        console.say(traceback.format_exc().rstrip())


if __name__ == "__main__":
    sys.argv[0] = str(Path(sys.argv[0]).with_name("active3d"))
    main()
