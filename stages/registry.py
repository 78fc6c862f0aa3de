"""The stages in execution order. The page to open first.

Light to import: heavy rooms are imported inside the stages' `run` functions, so that an unchanged key is
found out without loading torch.
"""

from active3d_pipe.pipeline.stage import Stage
from stages.capture import STAGE as CAPTURE
from stages.evaluation import STAGE as EVALUATION
from stages.export import STAGE as EXPORT
from stages.mapping import STAGE as MAPPING
from stages.planning import STAGE as PLANNING
from stages.report import STAGE as REPORT
from stages.uncertainty import STAGE as UNCERTAINTY

LOOP: tuple[Stage, ...] = (CAPTURE, MAPPING, UNCERTAINTY, PLANNING)  # once a round
FINISH: tuple[Stage, ...] = (EXPORT, EVALUATION, REPORT)  # once, after the last round
