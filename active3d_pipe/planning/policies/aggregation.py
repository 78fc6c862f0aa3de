"""Naive aggregation of the uncertainty volume: the ablation "w.o. Risk Planning" of the paper.

The paper replaces its planner with "naive uncertainty-volume aggregation". Read as: NARUTO's search (`naruto.py`: sum
of the uncertainty of the visible targets, argmax, no cost of travel, no expected gain) over the fused volume U. The
risk and reward terms of the path are switched off in `configs/ablations/without_risk_planning.toml`.
"""

import numpy as np

from active3d_pipe.planning.policies.context import PolicyContext
from active3d_pipe.planning.policies.naruto import Naruto


class Aggregation(Naruto):
    """See the module."""

    turns_first = False

    def uncertainty(self, context: PolicyContext) -> np.ndarray:
        """(X, Y, Z) the fused uncertainty, wherever it is not known to be free."""
        return context.volume["u_final"]
