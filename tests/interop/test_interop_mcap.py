"""Capture logs open in Rerun and in the reference TypeScript reader."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from active3d_pipe.storage import capture_log

pytestmark = pytest.mark.interop

# Written out, not imported: these names are what other programs rely on.
SCHEMAS = {
    "/camera/color/image": "foxglove.CompressedImage",
    "/camera/depth/image": "foxglove.RawImage",
    "/camera/color/calibration": "foxglove.CameraCalibration",
    "/camera/depth/calibration": "foxglove.CameraCalibration",
    "/tf": "foxglove.FrameTransforms",
    "/camera/pose": "foxglove.PoseInFrame",
    "/plan/path": "foxglove.PosesInFrame",
}


@pytest.mark.parametrize("mode", [[], ["--full"]])
def test_rerun_finds_nothing_wrong(tiny_run: Path, rerun: Callable[..., str], mode: list[str]) -> None:
    answer = rerun("mcap", "check", *mode, tiny_run / "capture" / "round_0000" / "frames.mcap")
    verdicts = [line.split()[0] for line in answer.splitlines() if any(t in line.split() for t in SCHEMAS)]
    assert verdicts == ["ok"] * len(SCHEMAS), answer


def test_rerun_converts_the_log_and_its_recording_is_valid(
    tiny_run: Path, rerun: Callable[..., str], tmp_path: Path
) -> None:
    recording = tmp_path / "frames.rrd"
    rerun("mcap", "convert", tiny_run / "capture" / "round_0000" / "frames.mcap", "-o", recording)
    rerun("rrd", "verify", recording)
    listing = rerun("rrd", "print", "-vv", recording)
    for topic, archetype in (("color/image", "EncodedImage"), ("depth/image", "Image"), ("calibration", "Pinhole")):
        assert topic in listing, topic
        assert archetype in listing, archetype


def test_mcap_core_decodes_every_message_with_the_embedded_descriptors(
    tiny_run: Path, node_script: Callable[..., Any]
) -> None:
    for log in sorted(tiny_run.glob("capture/*/frames.mcap")):
        found = node_script("read_mcap.mjs", ["@mcap/core", "@mcap/nodejs", "@mcap/support"], log)
        frames = capture_log.read_frames(log)
        topics = found["topics"]
        assert {t: v["schema"] for t, v in topics.items()} == SCHEMAS
        assert {v["encoding"] for v in topics.values()} == {"protobuf"}
        counts = {t: v["count"] for t, v in topics.items()}
        assert counts == {t: 1 if t == "/plan/path" else len(frames) for t in SCHEMAS}
        positions = [f.T_world_camera[:3, 3] for f in frames]
        np.testing.assert_array_equal(topics["/camera/pose"]["positions"], positions)
        np.testing.assert_array_equal(topics["/tf"]["positions"], positions)
        assert topics["/camera/pose"]["times"] == [f.stamp_ns for f in frames]
        assert topics["/camera/depth/image"]["bytes"] == [f.depth.nbytes for f in frames]
        c = frames[0].camera
        assert topics["/camera/color/calibration"]["K"] == [c.fx, 0, c.cx, 0, c.fy, c.cy, 0, 0, 1]
        assert topics["/camera/color/image"]["frame"] == topics["/camera/color/calibration"]["frame"]
        assert topics["/plan/path"]["poses"] >= len(frames)
        assert "active3d" in found["metadata"]
