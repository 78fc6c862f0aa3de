"""`doctor`: is this machine ready, and if not, what to do."""

import os
import platform
import shutil
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import typer

from active3d_pipe.cli import console, session


@dataclass(frozen=True, slots=True)
class Finding:
    """One check: `state` is ok, warn or fail; `fix` says what to do."""

    name: str
    state: str
    text: str
    fix: str = ""


def doctor(json: bool = session.JSON) -> None:
    """Check Python, libraries, threads, rendering and disk; says how to mend what is not right."""
    from active3d_pipe.pipeline.threads import set_threads

    set_threads(2)
    findings = [finding for check in CHECKS for finding in _guarded(check)]
    bad = [f for f in findings if f.state == "fail"]
    if json:
        console.out_json(
            {
                "schema": "active3d.doctor/1", "ready": not bad,
                "checks": [{"name": f.name, "state": f.state, "text": f.text, "fix": f.fix} for f in findings],
            }
        )
    else:
        rows = [(f.state, f.name, f.text + (f"; {f.fix}" if f.fix else "")) for f in findings]
        console.out(console.table(rows))
        console.out("ready" if not bad else f"not ready: {', '.join(f.name for f in bad)}")
    if bad:
        raise typer.Exit(1)


def _python() -> Iterator[Finding]:
    version = platform.python_version()
    ok = sys.version_info >= (3, 11)
    state, fix = ("ok", "") if ok else ("fail", "use 3.11 or newer")
    yield Finding("python", state, f"{version} on {platform.machine()}", fix)


def _libraries() -> Iterator[Finding]:
    import importlib

    for name in ("numpy", "scipy", "torch", "numba", "trimesh", "mcap", "zarr", "safetensors", "skimage", "matplotlib"):
        try:
            module = importlib.import_module(name)
            yield Finding(name, "ok", getattr(module, "__version__", "installed"))
        except ImportError as error:
            yield Finding(name, "fail", f"cannot be imported ({error})", "pip install active3d again")


def _open3d() -> Iterator[Finding]:
    from active3d_pipe.geometry.raycasting import import_open3d

    yield Finding("open3d", "ok", f"{import_open3d().__version__} (with libusb)")


def _gl() -> Iterator[Finding]:
    """pyrender draws through EGL; only the second rendering backend needs it."""
    import ctypes.util

    if ctypes.util.find_library("EGL"):
        yield Finding("EGL", "ok", "found; sensor.backend = \"pyrender\" can be used")
    else:
        yield Finding("EGL", "warn", "not found", "only sensor.backend = \"pyrender\" needs it (Debian: libegl1)")


def _threads() -> Iterator[Finding]:
    import warnings

    import numba
    import torch

    warnings.filterwarnings("ignore", category=numba.NumbaWarning)  # about threading layers that are not used

    @numba.njit(parallel=True)
    def total(n: int) -> int:
        s = 0
        for i in numba.prange(n):
            s += i
        return s

    total(8)
    layer, cores = numba.threading_layer(), len(os.sched_getaffinity(0))
    state = "ok" if cores >= 2 else "warn"
    text = f"{cores} cores, torch uses {torch.get_num_threads()}, numba {numba.get_num_threads()} ({layer})"
    yield Finding("threads", state, text, "" if cores >= 2 else "set run.threads = 1")
    if torch.cuda.is_available():
        yield Finding("cuda", "ok", f"{torch.cuda.get_device_name()} (not needed)")


def _memory() -> Iterator[Finding]:
    free = os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    total = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    ok = total >= 4e9
    text = f"{console.size(total)}, {console.size(free)} unused"
    yield Finding("memory", "ok" if ok else "warn", text, "" if ok else "8 GB are recommended")


def _disk() -> Iterator[Finding]:
    free = shutil.disk_usage(".").free
    ok = free > 5e9
    text = f"{console.size(free)} free here"
    yield Finding("disk", "ok" if ok else "warn", text, "" if ok else "a long run takes some GB")


def _viewer() -> Iterator[Finding]:
    found = shutil.which("rerun")
    if found:
        yield Finding("rerun", "ok", found)
    else:
        yield Finding("rerun", "warn", "not installed", "only `active3d view` needs it (pip install rerun-sdk)")


CHECKS: tuple[Callable[[], Iterator[Finding]], ...] = (
    _python, _libraries, _open3d, _gl, _threads, _memory, _disk, _viewer
)


def _guarded(check: Callable[[], Iterator[Finding]]) -> Iterator[Finding]:
    """A check that cannot even run is a failed one."""
    try:
        yield from check()
    except Exception as error:
        text = " ".join(str(error).split())
        yield Finding(check.__name__.strip("_"), "fail", f"{type(error).__name__}: {text}")
