"""The base of every room's configuration model."""

from pydantic import BaseModel, ConfigDict


class Settings(BaseModel):
    """A frozen section of the configuration; unknown keys are refused.

    A room declares its knobs in `<room>/config.py` as one subclass, units in the names, every field with a
    default and a `Field(description=...)`. `pipeline/config.py` composes the sections; a room receives its
    own section and never the whole tree.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", validate_default=True, allow_inf_nan=False)
