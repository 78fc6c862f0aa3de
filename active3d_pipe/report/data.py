"""What the report is made from: plain arrays and dicts, gathered by whoever calls it."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from active3d_pipe.errors import InputError


@dataclass(frozen=True, eq=False)
class Metric:
    """One number of the summary.

    `value` None = not measured, `note` then says why. Unit "%" means that the value is a share of 1. `better` is
    "higher", "lower" or "".
    """

    value: float | None
    unit: str = ""
    explanation: str = ""
    better: str = ""
    note: str = ""


@dataclass(frozen=True, eq=False)
class FloorPlan:
    """A horizontal slice of the occupancy: O [X, Y] float in [0, 1] (0.5 = unknown), corner origin (2,) world m."""

    occupancy: np.ndarray
    origin: np.ndarray
    voxel_size: float
    height_m: float

    def __post_init__(self) -> None:
        if self.occupancy.ndim != 2:
            raise InputError(f"floor plan: occupancy is {self.occupancy.shape}, expected [X, Y]")

    @property
    def extent(self) -> tuple[float, float, float, float]:
        """(x low, x high, y low, y high), world m."""
        x, y = float(self.origin[0]), float(self.origin[1])
        return x, x + self.occupancy.shape[0] * self.voxel_size, y, y + self.occupancy.shape[1] * self.voxel_size


@dataclass(frozen=True, eq=False)
class Curve:
    """A quantity over exploration steps; curves with the same `panel` share axes. Unit "%" = shares of 1."""

    panel: str
    label: str
    unit: str
    steps: Sequence[float]
    values: Sequence[float | None]


@dataclass(frozen=True, eq=False)
class HeldOutView:
    """A true view beside its render: rgb (H, W, 3) uint8, z-depth (H, W) m with 0 = nothing."""

    label: str
    truth_rgb: np.ndarray
    render_rgb: np.ndarray
    truth_depth: np.ndarray | None = None
    render_depth: np.ndarray | None = None

    def __post_init__(self) -> None:
        if self.truth_rgb.shape != self.render_rgb.shape or self.truth_rgb.ndim != 3:
            raise InputError(
                f"view {self.label}: images are {self.truth_rgb.shape} and {self.render_rgb.shape}, expected two "
                "of the same shape (H, W, 3)"
            )


@dataclass(frozen=True, eq=False)
class SliceSeries:
    """One volume's horizontal slice over rounds: [(round, [X, Y] float, NaN = not known)], on the floor plan's grid."""

    name: str
    unit: str
    explanation: str
    rounds: Sequence[tuple[int, np.ndarray]]


@dataclass(frozen=True, eq=False)
class Picture:
    """An image (H, W, 3) uint8 with its caption."""

    caption: str
    image: np.ndarray


@dataclass(frozen=True, eq=False)
class DecisionRow:
    """One decision: what was expected of it and what came of it. None = not known (the last round has no outcome)."""

    round: int
    reason: str
    gain_imp_bits: float | None = None
    gain_exp_bits: float | None = None
    realised_bits: float | None = None
    path_m: float | None = None
    risk: float | None = None
    steps: int | None = None
    candidates: int | None = None
    realised_imp_bits: float | None = None
    realised_exp_bits: float | None = None


@dataclass(frozen=True, eq=False)
class FusionHistory:
    """What evidence maximisation found: rounds (R,), alphas (R, 3) of u_imp, u_exp, u_time; evidence and noise (R,)."""

    rounds: Sequence[int]
    alphas: np.ndarray
    evidence: Sequence[float | None] = ()
    noise: Sequence[float | None] = ()


@dataclass(frozen=True, eq=False)
class Timing:
    """Wall time that a module of a stage used over the whole run."""

    stage: str
    module: str
    seconds: float
    calls: int | None = None


SECTIONS = {
    "metrics": "Result",
    "floor_plan": "What was explored",
    "curves": "Progress over steps",
    "views": "Held-out views",
    "mesh": "Mesh",
    "slices": "Uncertainty over rounds",
    "fusion": "Fusion of the uncertainty terms",
    "decisions": "Decisions",
    "timings": "Time",
    "reproducibility": "Reproducibility",
    "config": "Configuration",
}
"""Section key -> heading, in the order of the page."""


@dataclass(frozen=True, eq=False)
class ReportData:
    """Everything on the page. A section without data appears as one line that gives `missing[section]`.

    Attributes:
        title: name of the run.
        subtitle: one line: scene, preset, steps, seed.
        metrics: name -> value with unit and explanation; the names of the evaluation are laid out as a table of
            forms, others are listed.
        headline: names of the metrics that stand at the top of the page.
        trajectory: (M, 4, 4) T_world_camera of every step, or None.
        keyframes: (K, 3) positions, goals (G, 3) positions of the chosen views, in the order of decisions.
        missing: section key of `SECTIONS` -> why it has no data.
    """

    title: str
    subtitle: str = ""
    config_text: str = ""
    metrics: Mapping[str, Metric] = field(default_factory=dict)
    headline: Sequence[str] = ()
    floor_plan: FloorPlan | None = None
    trajectory: np.ndarray | None = None
    keyframes: np.ndarray | None = None
    goals: np.ndarray | None = None
    curves: Sequence[Curve] = ()
    views: Sequence[HeldOutView] = ()
    mesh_pictures: Sequence[Picture] = ()
    slices: Sequence[SliceSeries] = ()
    fusion: FusionHistory | None = None
    decisions: Sequence[DecisionRow] = ()
    timings: Sequence[Timing] = ()
    reproducibility: Mapping[str, Any] = field(default_factory=dict)
    missing: Mapping[str, str] = field(default_factory=dict)
