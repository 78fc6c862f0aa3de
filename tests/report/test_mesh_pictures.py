"""Pictures of a mesh: the right thing in the right place."""

import numpy as np
from sample_run import room_mesh, trajectory

from active3d_pipe.report.mesh_pictures import default_views, render_mesh, top_rays
from active3d_pipe.structures import TriangleMesh


def test_default_views_show_the_mesh():
    mesh = room_mesh()
    views = default_views(mesh, trajectory(), width_px=80)
    pictures = render_mesh(mesh, views)
    assert [p.caption for p in pictures] == [v.caption for v in views] and len(pictures) == 4
    for p in pictures:
        assert p.image.dtype == np.uint8 and p.image.shape[1] == 80
        covered = (p.image.reshape(-1, 3).min(axis=1) < 250).mean()
        assert covered > 0.2
    inside = pictures[-1].image
    assert (inside.reshape(-1, 3).min(axis=1) < 250).all()  # no hole in a closed room
    for outside in pictures[1:3]:  # the mesh fits into the picture: the border stays white
        border = np.concatenate([outside.image[0], outside.image[-1], outside.image[:, 0], outside.image[:, -1]])
        assert (border > 250).all()


def test_walls_do_not_hide_the_room_from_outside():
    mesh = room_mesh()
    views = default_views(mesh, trajectory(), width_px=60)
    assert all(v.see_through for v in views[:3])
    # With the faces turned round the poses tell that the normals face away, and nothing is looked through.
    turned = TriangleMesh(mesh.vertices, np.ascontiguousarray(mesh.faces[:, ::-1]), mesh.colors)
    assert not any(v.see_through for v in default_views(turned, trajectory(), width_px=60))


def test_top_view_is_a_plan_with_x_right_and_y_up():
    quad = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    def square(x, y, z):
        return np.array([[x, y, z], [x + 1, y, z], [x + 1, y + 1, z], [x, y + 1, z]], np.float32)
    red, green, high = square(0, 0, 0), square(3, 3, 0), square(0, 3, 2.5)
    colors = np.repeat(np.array([[255, 0, 0], [0, 255, 0], [0, 0, 255]], np.uint8), 4, axis=0)
    mesh = TriangleMesh(np.concatenate([red, green, high]), np.concatenate([quad, quad + 4, quad + 8]), colors)
    from active3d_pipe.report.mesh_pictures import MeshView

    rays = top_rays(np.array([0.0, 0, 0]), np.array([4.0, 4, 2.5]), 40)
    whole, cut = render_mesh(mesh, [MeshView("whole", rays), MeshView("cut", rays, False, 2.0)])
    assert whole.image.shape == (40, 40, 3)
    assert whole.image[34, 5].argmax() == 0 and whole.image[34, 5, 1] == 0  # red at low x and low y: bottom left
    assert whole.image[5, 34].argmax() == 1  # green at high x and high y: top right
    assert whole.image[5, 5].argmax() == 2 and whole.image[5, 5, 0] == 0  # blue, the ceiling, top left
    assert (cut.image[5, 5] == 255).all()  # cut away
    assert (whole.image[20, 20] == 255).all()  # nothing there


def test_a_mesh_without_colours_or_faces():
    mesh = room_mesh()
    bare = TriangleMesh(mesh.vertices, mesh.faces)
    picture = render_mesh(bare, default_views(bare, None, width_px=40))
    assert len(picture) == 3  # without poses there is no view from inside
    empty = TriangleMesh(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32))
    assert render_mesh(empty, default_views(empty, None)) == []
