# mypy: ignore-errors
"""How much of one view another one sees: a kernel, since every frame is compared with many keyframes."""

from numba import njit


@njit(cache=True)
def seen_share(points, T_camera_world, fx, fy, cx, cy, near, depth, tolerance):
    """Share of world points (N, 3) that a view sees, N > 0.

    Args:
        points: (N, 3) float64, m.
        T_camera_world: (4, 4) float64, world to the view's optical frame.
        fx, fy, cx, cy: its intrinsics, px; `near`: its nearest valid depth, m.
        depth: (H, W) float32 depth image, 0 = invalid.
        tolerance: relative depth difference up to which a point behind the reading counts as seen.
    """
    height, width = depth.shape
    T = T_camera_world
    count = 0
    for i in range(points.shape[0]):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        depth_of_point = T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3]
        if depth_of_point <= near or depth_of_point < 1e-9:
            continue
        u = fx * (T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3]) / depth_of_point + cx
        v = fy * (T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3]) / depth_of_point + cy
        if 0 <= u < width and 0 <= v < height:
            reading = depth[int(v), int(u)]
            if reading > 0 and depth_of_point < reading * (1 + tolerance):
                count += 1
    return count / points.shape[0]
