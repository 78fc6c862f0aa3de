"""Knobs of the engine itself."""

from pydantic import Field

from active3d_pipe.structures.settings import Settings


class KeepSettings(Settings):
    """Which artifacts keep their payload; the others keep their record and are made again when needed."""

    stages: tuple[str, ...] = Field(("mapping",), description="stages whose old artifacts are pruned")
    last: int = Field(2, ge=2, description="newest rounds that are kept whole (a round needs its predecessor)")
    every: int = Field(10, ge=0, description="keep every n-th round whole as well; 1 = all, 0 = none")


class RunSettings(Settings):
    """One exploration."""

    name: str = Field("", description="name of the run and of its folder; default: that of the configuration")
    seed: int = Field(0, ge=0, lt=2**63, description="seed that every random choice of the run derives from")
    steps: int = Field(2000, ge=1, description="captured frames after which exploration ends")
    max_rounds: int = Field(1000, ge=1, description="rounds after which exploration ends")
    threads: int = Field(2, ge=1, le=256, description="threads of the numeric libraries; part of every key")
    keep: KeepSettings = Field(KeepSettings(), description="which old artifacts keep their payload")
