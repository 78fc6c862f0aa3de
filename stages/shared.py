"""What several stages need: cached frames, cached simulator, the map on disk."""

import json
import queue
from collections import OrderedDict
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from active3d_pipe.pipeline.stage import NodeId

if TYPE_CHECKING:
    from active3d_pipe.mapping.hybrid_map import HybridMap
    from active3d_pipe.sim.simulator import Simulator
    from active3d_pipe.structures import Frame, UncertaintyVolume

LOG_NAME, CAPTURE_NAME, DECISION_NAME = "frames.mcap", "capture.json", "decision.json"
VOLUME_NAME, SURFACE_NAME = "volume.zarr", "surface.ply"
SURFACES_AT_FIRST, SURFACES_THEN = 16, 4  # the first rounds each leave a coarse surface, then every fourth
CACHE_BYTES = 1 << 29  # decoded frames kept in memory between the stages of one process

_frames: "OrderedDict[tuple, list[Frame]]" = OrderedDict()
_simulators: "dict[str, Simulator]" = {}
# What this process wrote last, and the map before it (to look at only): with their files' identity, at most one each.
# Nobody changes a volume that was read.
_newest_map: "list[tuple[tuple, HybridMap]]" = []
_previous_map: "list[tuple[tuple, HybridMap]]" = []
_newest_volume: "list[tuple[tuple, UncertaintyVolume]]" = []
MAP_NAMES = ("field.safetensors", "gaussians.safetensors", "optimiser.safetensors", "keyframes.json")


def captures(last_round: int) -> tuple[NodeId, ...]:
    """The capture nodes of rounds 0..last_round."""
    return tuple(NodeId("capture", k) for k in range(last_round + 1))


def leaves_surface(round: int) -> bool:
    """Whether a round's uncertainty artifact holds the coarse surface: of long runs the curves need a few only."""
    return round < SURFACES_AT_FIRST or round % SURFACES_THEN == 0


def load_frames(folder: Path) -> "list[Frame]":
    """Frames of one capture artifact; decoded once a process while the cache has room."""
    from active3d_pipe.storage import capture_log

    path = folder / LOG_NAME
    key = _identity([path])
    if key in _frames:
        _frames.move_to_end(key)
        return _frames[key]
    frames = capture_log.read_frames(path)
    _keep_frames(key, frames)
    return frames


@contextmanager
def log_frames(folder: Path, planned_path: np.ndarray) -> "Iterator[Callable[[Frame], None]]":
    """Write the log of a capture artifact: gives the function that takes its frames, one after the other.

    They are compressed on a thread of its own while the next ones are captured; at the end they are kept in memory as
    they will be read. What goes wrong with the file is raised at the end.
    """
    from active3d_pipe.storage import capture_log

    taken: list[Frame] = []
    waiting: queue.SimpleQueue[Frame | None] = queue.SimpleQueue()

    def take(frame: "Frame") -> None:
        taken.append(frame)
        waiting.put(frame)

    with ThreadPoolExecutor(1) as pool:
        written = pool.submit(capture_log.write_frames, folder / LOG_NAME, iter(waiting.get, None), planned_path)
        try:
            yield take
        finally:
            waiting.put(None)
    written.result()
    _keep_frames(_identity([folder / LOG_NAME]), [capture_log.as_logged(f) for f in taken])


def _keep_frames(key: tuple, frames: "list[Frame]") -> None:
    _frames[key] = frames
    while len(_frames) > 1 and sum(f.rgb.nbytes + f.depth.nbytes for fs in _frames.values() for f in fs) > CACHE_BYTES:
        _frames.popitem(last=False)


def load_covering(inputs: Mapping[NodeId, Path], last_round: int, most: int) -> "list[Frame]":
    """At most `most` of the frames of rounds 0..last_round, showing what all show: long runs need not fit in memory."""
    from active3d_pipe.mapping.frame_choice import covering, surface_cells

    folders = [inputs[node] for node in captures(last_round)]
    steps = [len(read_capture(folder)["poses"]) for folder in folders]
    if sum(steps) <= most:
        return [frame for folder in folders for frame in load_frames(folder)]
    chosen = set(covering([surface_cells(frame) for folder in folders for frame in load_frames(folder)], most))
    first = np.cumsum([0, *steps])
    found = []
    for folder, start, stop in zip(folders, first, first[1:], strict=False):
        if not chosen.isdisjoint(range(start, stop)):
            found += [f for i, f in enumerate(load_frames(folder), start=start) if i in chosen]
    return found


def read_capture(folder: Path) -> dict[str, Any]:
    """What a capture artifact says of itself: poses, steps so far, collisions, the rig."""
    from active3d_pipe.storage.files import read_json

    return read_json(folder / CAPTURE_NAME)


def load_rig(inputs: Mapping[NodeId, Path]) -> dict[str, Any]:
    """What the first capture says of the scene and the camera: all that later stages may know of the world.

    `bounds` [[low], [high]], world, m, is the box to explore; None: it is to be found (`scene.bounds = "auto"`).
    """
    return read_capture(inputs[NodeId("capture", 0)])["rig"]


def make_simulator(config: Any, seed: int) -> "Simulator":
    """The simulator of this configuration, made once a process."""
    from active3d_pipe.sim.simulator import make_simulator as make

    key = "|".join(s.model_dump_json() for s in (config.scene, config.camera, config.sensor)) + f"|{seed}"
    if key not in _simulators:
        _simulators.clear()
        _simulators[key] = make(config.scene, config.camera, config.sensor, seed)
    return _simulators[key]


def walked_poses(inputs: Mapping[NodeId, Path], last_round: int) -> np.ndarray:
    """(M, 4, 4) poses of every captured frame, in order."""
    return np.concatenate([np.array(read_capture(inputs[node])["poses"]) for node in captures(last_round)])


def save_volume(folder: Path, volume: "UncertaintyVolume") -> None:
    """Write the volume of a round, and keep it in memory as it will be read."""
    from dataclasses import replace

    from active3d_pipe.storage.volumes import write_volume

    write_volume(folder / VOLUME_NAME, volume)
    _newest_volume[:] = [(_volume_identity(folder), replace(volume, fusion=json.loads(json.dumps(volume.fusion))))]


def load_volume(folder: Path) -> "UncertaintyVolume":
    """Read the volume of a round; the one that this process wrote last is taken from memory."""
    from active3d_pipe.storage.volumes import read_volume

    if _newest_volume and _newest_volume[0][0] == _volume_identity(folder):
        return _newest_volume[0][1]
    return read_volume(folder / VOLUME_NAME)


def _volume_identity(folder: Path) -> tuple:
    return _identity(sorted(path for path in (folder / VOLUME_NAME).rglob("*") if path.is_file()))


def save_map(folder: Path, hybrid: "HybridMap", *, to_train: bool = True) -> None:
    """Write a map: parameters, keyframe list, and what is needed `to_train` it further."""
    from active3d_pipe.storage.files import write_json, write_tensors

    state = hybrid.state()
    write_tensors(folder / "field.safetensors", state["field"])
    write_tensors(folder / "gaussians.safetensors", state["gaussians"])
    write_json(folder / "keyframes.json", [k.to_json() for k in hybrid.keyframes])
    _newest_map.clear()
    if not to_train:
        _previous_map.clear()  # the last map: nothing is mapped after it
    else:
        write_tensors(folder / "optimiser.safetensors", state["optimiser"])
        _newest_map.append((_map_identity(folder), hybrid))


def _identity(paths: "Sequence[Path]") -> tuple:
    """What tells these files from all others, wherever their folder is moved; empty when one is missing."""
    try:
        stats = [path.stat() for path in paths]
    except OSError:
        return ()
    return tuple((s.st_dev, s.st_ino, s.st_mtime_ns, s.st_size) for s in stats)


def _map_identity(folder: Path) -> tuple:
    return _identity([folder / name for name in MAP_NAMES])


def load_map(folder: Path, inputs: Mapping[NodeId, Path], config: Any, *, to_train: bool = True) -> "HybridMap":
    """Read a map; its keyframes' images come from the capture logs among `inputs`.

    Without `to_train` the optimiser's state, two thirds of the bytes, stays on disk. The map that this process wrote
    last is taken from memory: its state is that of its files. Who loads it `to_train` owns it, and leaves a copy to
    look at.
    """
    identity = _map_identity(folder)
    for kept in (_newest_map, _previous_map):
        if kept and kept[0][0] == identity and kept[0][1].settings == config.mapping:
            if not to_train:
                return kept[0][1]
            if kept is _newest_map:
                _previous_map[:] = [(identity, kept[0][1].to_look_at())]
                return _newest_map.pop()[1]
    from active3d_pipe.mapping.hybrid_map import HybridMap
    from active3d_pipe.mapping.keyframes import Keyframe
    from active3d_pipe.storage.files import read_json, read_tensors

    keyframes = []
    for doc in read_json(folder / "keyframes.json"):
        frames = load_frames(inputs[NodeId("capture", doc["round"])])
        frame = frames[doc["step"] - frames[0].step]
        keyframes.append(Keyframe(frame, doc["round"], doc["reason"], doc["delta"], doc["gain"], doc["rho"]))
    names = ("field", "gaussians", "optimiser") if to_train else ("field", "gaussians")
    state = {name: read_tensors(folder / f"{name}.safetensors")[0] for name in names}
    return HybridMap.from_state(config.mapping, state, keyframes)
