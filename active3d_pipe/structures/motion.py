"""How the agent may move: read by planning (which obeys it) and capture (which checks it)."""

from typing import Literal

from pydantic import Field

from active3d_pipe.structures.settings import Settings


class MotionSettings(Settings):
    """Limits of one exploration step and the agent's body."""

    max_step_m: float = Field(0.1, gt=0, description="longest motion of one step, m")
    max_turn_deg: float = Field(10.0, gt=0, le=180, description="largest rotation of one step, degrees")
    agent_radius_m: float = Field(0.2, gt=0, description="radius of the sphere that must stay clear of surfaces, m")
    model: Literal["free", "ground"] = Field(
        "free", description="free: camera with six degrees of freedom; ground: robot at the height of the start pose"
    )

    @property
    def planar(self) -> bool:
        """Whether the agent stays at one height."""
        return self.model == "ground"
