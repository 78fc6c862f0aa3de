"""One closed, immutable MCAP per round: what the camera saw, from where, and the path it was asked to walk.

Foxglove protobuf schemas, so that Rerun, Foxglove, and any MCAP reader with the embedded descriptors open it.
Times are simulated, never wall clock: equal runs give equal bytes.
"""

from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from active3d_pipe import __version__
from active3d_pipe.errors import ArtifactError
from active3d_pipe.geometry import se3
from active3d_pipe.storage.files import COMPRESSION_THREADS, reading, writing
from active3d_pipe.storage.png import decode_png, encode_png
from active3d_pipe.structures import Camera, Frame

COLOR, DEPTH, CALIBRATION = "/camera/color/image", "/camera/depth/image", "/camera/color/calibration"
DEPTH_CALIBRATION, TRANSFORMS, POSE, PATH = "/camera/depth/calibration", "/tf", "/camera/pose", "/plan/path"
WORLD, OPTICAL = "world", "camera_optical"
STEP_NS = 100_000_000  # simulated duration of a step


def write_frames(path: Path, frames: Iterable[Frame], planned_path: np.ndarray) -> None:
    """Write frames, as they come, and the planned path (M, 4, 4) T_world_camera to a closed MCAP file."""
    from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
    from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
    from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
    from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
    from foxglove_schemas_protobuf.PosesInFrame_pb2 import PosesInFrame
    from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
    from mcap.writer import CompressionType, Writer
    from mcap_protobuf.schema import register_schema

    topics = {
        COLOR: CompressedImage, DEPTH: RawImage, CALIBRATION: CameraCalibration, DEPTH_CALIBRATION: CameraCalibration,
        TRANSFORMS: FrameTransforms, POSE: PoseInFrame, PATH: PosesInFrame,
    }
    camera = Camera(1, 1, 1, 1, 0.5, 0.5)
    with writing(path), path.open("wb") as stream:
        writer = Writer(stream, compression=CompressionType.ZSTD, enable_crcs=True)
        # Set by ourselves: the default names the library's version, and an upgrade would change the bytes.
        writer.start(profile="", library=f"active3d/{__version__}")
        schemas = {cls: register_schema(writer, cls) for cls in dict.fromkeys(topics.values())}
        channels = {topic: writer.register_channel(topic, "protobuf", schemas[cls]) for topic, cls in topics.items()}

        def add(topic: str, message: Any, frame: Frame) -> None:
            data = message.SerializeToString(deterministic=True)
            writer.add_message(channels[topic], frame.stamp_ns, data, frame.stamp_ns, sequence=frame.step)

        for i, frame in enumerate(frames):
            if i == 0:
                camera = frame.camera
                add(PATH, _path_message(PosesInFrame(), frame, planned_path), frame)
            add(COLOR, _color_message(CompressedImage(), frame, encode_png(frame.rgb)), frame)
            add(DEPTH, _depth_message(RawImage(), frame), frame)
            add(CALIBRATION, _calibration_message(CameraCalibration(), frame), frame)
            add(DEPTH_CALIBRATION, _calibration_message(CameraCalibration(), frame), frame)
            add(TRANSFORMS, _transform_message(FrameTransforms(), frame), frame)
            add(POSE, _pose_message(PoseInFrame(), frame), frame)
        writer.add_metadata("active3d", {"schema": "active3d.capture/1", "camera": f"{camera.near!r} {camera.far!r}"})
        writer.finish()


def as_logged(frame: Frame) -> Frame:
    """The frame that `read_frames` gives back for a written one: poses are logged as quaternions."""
    T = _matrix(frame.T_world_camera[:3, 3], se3.quat_from_matrix(frame.T_world_camera[:3, :3]))
    return replace(frame, T_world_camera=T)


def read_frames(path: Path) -> list[Frame]:
    """Read the frames of a closed log, checksums verified; ArtifactError when it is damaged."""
    from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
    from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
    from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
    from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
    from mcap.reader import SeekingReader

    types = {COLOR: CompressedImage, DEPTH: RawImage, CALIBRATION: CameraCalibration, POSE: PoseInFrame}
    messages: dict[int, dict[str, Any]] = {}
    stamps: dict[int, int] = {}
    with reading(path, "a closed MCAP log of active3d"), path.open("rb") as stream:
        reader = SeekingReader(stream, validate_crcs=True, record_size_limit=256 * 2**20)
        for _, channel, record in reader.iter_messages(topics=list(types)):
            message = types[channel.topic]()
            message.ParseFromString(record.data)
            messages.setdefault(record.sequence, {})[channel.topic] = message
            stamps[record.sequence] = record.log_time
        ranges = next((dict(m.metadata) for m in reader.iter_metadata() if m.name == "active3d"), {})
        near, far = (float(x) for x in ranges.get("camera", "0.05 10").split())
        steps = sorted(messages)
        for step in steps:
            if set(messages[step]) != set(types):
                raise ArtifactError(f"{path}: step {step} has {sorted(messages[step])}, expected {sorted(types)}")
        with ThreadPoolExecutor(COMPRESSION_THREADS) as pool:
            images = pool.map(decode_png, [messages[step][COLOR].data for step in steps])
            return [
                _frame(step, stamps[step], messages[step], image, near, far)
                for step, image in zip(steps, images, strict=True)
            ]


def _frame(step: int, stamp_ns: int, found: dict, rgb: np.ndarray, near: float, far: float) -> Frame:
    calibration, depth_message = found[CALIBRATION], found[DEPTH]
    K = calibration.K
    camera = Camera(calibration.width, calibration.height, K[0], K[4], K[2], K[5], near, far)
    if rgb.shape != (camera.height, camera.width, 3):
        raise ArtifactError(f"step {step}: image of shape {rgb.shape} for a camera of {camera.width}x{camera.height}")
    depth = np.frombuffer(depth_message.data, "<f4").reshape(camera.height, camera.width).astype(np.float32)
    p, q = found[POSE].pose.position, found[POSE].pose.orientation
    T = _matrix(np.array([p.x, p.y, p.z]), np.array([q.w, q.x, q.y, q.z]))
    return Frame(step, stamp_ns, camera, T, rgb, depth)


def _matrix(position: np.ndarray, quat: np.ndarray) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3] = se3.matrix_from_quat(quat)
    T[:3, 3] = position
    return T


def _stamp(message: Any, frame: Frame, frame_id: str) -> None:
    message.timestamp.FromNanoseconds(frame.stamp_ns)
    message.timestamp.SetInParent()
    message.frame_id = frame_id


def _set_pose(pose: Any, T: np.ndarray) -> None:
    # Sub-messages are set explicitly: an unset one makes strict readers fail even when every value is zero.
    pose.SetInParent()
    position, orientation = pose.position, pose.orientation
    position.SetInParent()
    orientation.SetInParent()
    position.x, position.y, position.z = (float(v) for v in T[:3, 3])
    q = se3.quat_from_matrix(T[:3, :3])
    orientation.w, orientation.x, orientation.y, orientation.z = (float(v) for v in q)


def _color_message(message: Any, frame: Frame, image: bytes) -> Any:
    _stamp(message, frame, OPTICAL)
    message.data, message.format = image, "png"
    return message


def _depth_message(message: Any, frame: Frame) -> Any:
    _stamp(message, frame, OPTICAL)
    message.width, message.height = frame.camera.width, frame.camera.height
    message.encoding, message.step = "32FC1", 4 * frame.camera.width
    message.data = np.ascontiguousarray(frame.depth, "<f4").tobytes()
    return message


def _calibration_message(message: Any, frame: Frame) -> Any:
    _stamp(message, frame, OPTICAL)
    c = frame.camera
    message.width, message.height = c.width, c.height
    message.K.extend([c.fx, 0, c.cx, 0, c.fy, c.cy, 0, 0, 1])
    message.R.extend([1, 0, 0, 0, 1, 0, 0, 0, 1])
    message.P.extend([c.fx, 0, c.cx, 0, 0, c.fy, c.cy, 0, 0, 0, 1, 0])
    return message


def _transform_message(message: Any, frame: Frame) -> Any:
    transform = message.transforms.add()
    transform.timestamp.FromNanoseconds(frame.stamp_ns)
    transform.timestamp.SetInParent()
    transform.parent_frame_id, transform.child_frame_id = WORLD, OPTICAL
    transform.translation.SetInParent()
    transform.rotation.SetInParent()
    T = frame.T_world_camera
    transform.translation.x, transform.translation.y, transform.translation.z = (float(v) for v in T[:3, 3])
    q = se3.quat_from_matrix(T[:3, :3])
    transform.rotation.w, transform.rotation.x, transform.rotation.y, transform.rotation.z = (float(v) for v in q)
    return message


def _pose_message(message: Any, frame: Frame) -> Any:
    _stamp(message, frame, WORLD)
    _set_pose(message.pose, frame.T_world_camera)
    return message


def _path_message(message: Any, frame: Frame, planned_path: np.ndarray) -> Any:
    _stamp(message, frame, WORLD)
    for T in planned_path:
        _set_pose(message.poses.add(), T)
    return message
