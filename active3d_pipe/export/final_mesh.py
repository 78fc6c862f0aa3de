"""The mesh that a run hands over: extracted near what was read, culled by what was seen, completed, coloured."""

from collections.abc import Sequence

from active3d_pipe.export.config import MeshSettings
from active3d_pipe.export.correction import corrected_sdf
from active3d_pipe.export.fused_readings import fused_if_noisy
from active3d_pipe.export.isosurface import drop_small_components, extract_mesh
from active3d_pipe.export.sheets import with_sheets
from active3d_pipe.export.view_fusion import colour_from_views, colour_mesh, cull_unseen, near_readings
from active3d_pipe.field.surface_view import Surface
from active3d_pipe.field.tsdf import TsdfField
from active3d_pipe.geometry.lattice import SdfQuery
from active3d_pipe.structures import Frame, TriangleMesh


def final_mesh(field: Surface, frames: Sequence[Frame], settings: MeshSettings) -> TriangleMesh:
    """The coloured mesh of a field, with the frames it was fitted to.

    Args:
        field: `query_sdf` ((N, 3) world m -> (N,) m, positive in free space) and `query_color` (-> (N, 3) in 0..1).
        frames: logged frames with depth and colour; no surface is made far from their readings.
        settings: see `MeshSettings`.
    """
    grid, observed = near_readings(frames, field.low, field.high, 2 * settings.voxel_size_m, settings.dilate_cells)
    whole = settings.model_copy(update={"min_component_m2": 0.0})
    query_sdf: SdfQuery = field.query_sdf
    if not isinstance(field, TsdfField):
        query_sdf = fused_if_noisy(query_sdf, field.low, field.high, frames, settings)
    query_sdf = corrected_sdf(query_sdf, field.low, field.high, frames, settings)
    mesh = extract_mesh(query_sdf, field.low, field.high, whole, grid=grid, observed=observed)
    mesh = drop_small_components(cull_unseen(mesh, frames, settings), settings.min_component_m2)
    mesh = with_sheets(mesh, frames, field.low, field.high, settings)
    if settings.colour == "views":
        return colour_from_views(mesh, frames, settings, field.query_color)
    return colour_mesh(mesh, field.query_color)
