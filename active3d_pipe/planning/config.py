"""The knobs of next-best-view search, path planning and the stop rule."""

from pydantic import Field, field_validator

from active3d_pipe.information.config import InformationSettings
from active3d_pipe.planning.policies.registry import check_name
from active3d_pipe.structures.settings import Settings


class PlanningSettings(Settings):
    """Section `planning` of the configuration."""

    policy: str = Field(
        "active3d", description="who decides where to look: a policy of docs/policies.md, or your own as module:Class"
    )
    trajectory: str = Field(
        "", description="policy trajectory: file of poses (JSON, NPY, TXT) or run folder whose poses are walked again"
    )
    information: InformationSettings = Field(
        InformationSettings(), description="weights and observation model of the expected gain"
    )
    # Candidates.
    coarse_spacing_m: float = Field(0.5, gt=0, description="spacing of candidate positions over all free space, m")
    fine_spacing_m: float = Field(0.25, gt=0, description="spacing of the positions around the best coarse ones, m")
    max_positions: int = Field(250, ge=1, description="coarse positions at most; the spacing grows to keep to it")
    refine_top: int = Field(2, ge=0, description="coarse positions that are refined")
    max_targets: int = Field(
        48, ge=0, description="places of value whose best viewpoints are sought among all positions, beside the lattice"
    )
    target_block_m: float = Field(0.3, gt=0, description="edge of the blocks that value is gathered in for that, m")
    num_yaws: int = Field(24, ge=1, description="view directions around the vertical, evenly spread")
    pitches_deg: tuple[float, ...] = Field(
        (-60.0, -30.0, 0.0, 30.0, 60.0), min_length=1, description="view pitch, degrees, up > 0"
    )
    max_range_m: float = Field(5.0, gt=0, description="how far a view is expected to see, m")
    exact_top: int = Field(32, ge=1, description="candidates whose visible set is computed exactly")
    unknown_free_path_m: float = Field(
        1.0, gt=0, description="mean length of a ray through unknown space before something stops it, m"
    )
    cell_weight: float = Field(
        2.0, ge=0, description="worth of an eighth of a surface voxel that no ray met though it borders on clear "
        "space, against an eighth of an unseen voxel"
    )
    credit_views: int = Field(48, ge=0, description="walked poses searched for looks that brought nothing")
    credit_factor: float = Field(
        0.5, gt=0, le=1, description="what each look that brought nothing leaves of a voxel's expected gain"
    )
    # Choice.
    view_steps: float = Field(
        10.0, gt=0, description="fixed cost of a view in steps, added to travel: larger prefers large gains far away"
    )
    reward_scale: float = Field(
        1000.0, gt=0, description="reward from which more of it counts less and less (logarithmically)"
    )
    commitment: float = Field(
        1.25, ge=1, description="factor on the utility of going on to the goal of the decision before"
    )
    stop_reward: float = Field(
        2.0, ge=0, description="stop when no reachable view has a higher expected reward; 1 = what discovering two "
        "voxels brings, the tolerance of the stop rule"
    )
    stop_search: int = Field(
        4, ge=1, description="before it stops, the search is repeated with this many times the positions, targets and "
        "exactly scored views"
    )
    spread_share: float = Field(
        1.0, ge=0, description="once nothing new is left to see, the walk goes on for this share of the steps so far, "
        "to where surface was looked at less than random views would look at it; 0 = stop at once"
    )
    hidden_reward: float = Field(
        30.0, ge=0, description="once the best view promises less than this, unseen space is searched for what few "
        "places can see; 0 = only before the stop"
    )
    hidden_pairs: int = Field(
        10_000_000, ge=1, description="pairs of a place and a block of unseen space that one such search tries; before "
        "the stop many times as many (THOROUGH_PAIRS in planning/decide.py)"
    )
    max_steps_per_round: int = Field(30, ge=1, description="steps of one decision at most; longer paths are cut")
    min_steps_per_round: int = Field(
        10, ge=1, description="a shorter path is continued to the next view, seen from its end"
    )
    num_ranked: int = Field(10, ge=1, description="candidates reported with a decision")
    # Free space and risk.
    min_free_rays: float = Field(2.0, gt=0, description="depth rays that must have passed a voxel before it is walked")
    max_free_occupancy: float = Field(0.4, gt=0, lt=1, description="joint occupancy up to which a voxel is free")
    clearance_margin_m: float = Field(0.05, ge=0, description="clearance kept beyond the agent's radius, m")
    preferred_clearance_m: float = Field(0.4, gt=0, description="clearance from which a place carries no risk, m")
    escape_m: float = Field(0.8, ge=0, description="around a tight start, clearance as small as there is accepted, m")
    sdf_trust_rays: float = Field(
        4.0, gt=0, description="rays through a voxel at which observation and field weigh the same in the risk field"
    )
    sdf_softness_m: float = Field(0.05, gt=0, description="width of the step from free to solid in the field's SDF, m")
    # Path (eq. risk_path).
    rrt_iterations: int = Field(600, ge=0, description="samples drawn by RRT*; 0 walks the grid path")
    rrt_step_m: float = Field(0.5, gt=0, description="longest edge of the tree, m")
    eta: float = Field(0.3, ge=0, lt=1, description="weight of the reward along the path")
    lambda_risk: float = Field(2.0, ge=0, description="weight of the collision risk along the path")
    # Start.
    bootstrap_turn_deg: float = Field(360.0, ge=0, le=720, description="turn on the spot before anything is known")
    bootstrap_pitch_deg: float = Field(25.0, ge=0, le=60, description="nodding of that turn, up and down, degrees")

    @field_validator("policy")
    @classmethod
    def _known(cls, value: str) -> str:
        return check_name(value)
