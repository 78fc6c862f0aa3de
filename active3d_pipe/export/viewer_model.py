"""A copy of the Gaussians that looks right in other programs, whose screen-space filters differ from ours."""

from collections.abc import Callable, Sequence

import numpy as np

from active3d_pipe.errors import NumericalError
from active3d_pipe.export.config import ExportSettings
from active3d_pipe.gaussians.config import GaussianSettings
from active3d_pipe.gaussians.optimisation import optimise_step
from active3d_pipe.gaussians.parameters import GaussianParameters
from active3d_pipe.structures import Frame, GaussianModel

# Both kinds of viewers add 0.3 px2 to every projected covariance. The first (Kerbl 2023 and most that follow it) lets
# the primitive grow, the second (Mip-Splatting's filter with this variance) dims it in exchange.
VIEWER_DILATION_PX2 = 0.3
# Two of three iterations draw with the first kind's filter, which is farther from ours and more widespread.
PLAIN_IN_TURN = 2  # then one of the other kind
FINAL_RATE = 0.1  # learning rates fall to this share, exponentially


def viewer_kernels(settings: GaussianSettings) -> tuple[GaussianSettings, GaussianSettings]:
    """`settings` with the filter of viewers without and with opacity compensation."""
    plain, dimming = (
        settings.model_copy(update={"dilation_px2": VIEWER_DILATION_PX2, "opacity_compensation": compensation})
        for compensation in (False, True)
    )
    return plain, dimming


def fit_to_viewers(
    model: GaussianModel,
    frames: Sequence[Frame],
    gaussians: GaussianSettings,
    settings: ExportSettings,
    rng: np.random.Generator,
    progress: Callable[[str], None] = lambda _: None,
) -> GaussianModel:
    """Optimise a copy of the final Gaussians on the captured frames, drawn as viewers draw them.

    A primitive as small as a pixel is drawn larger and more opaque by most programs than by our rasteriser, and no
    closed form mends it for more than one image size. The photometric and depth losses do, in a few hundred
    iterations; no primitive is added or dropped. Frames come in random order, each once before any twice.

    Args:
        model: the final Gaussians; left as they are.
        frames: captured frames, at the size at which the map was made.
        gaussians: loss weights and learning rates.
        settings: `viewer_iterations` (0: a plain copy), `viewer_learning_rate_scale`.
        rng: order of the frames.
        progress: told a line now and then.

    Raises:
        NumericalError: the loss is not finite.
    """
    total = settings.viewer_iterations if frames and len(model) else 0
    params = GaussianParameters.from_model(model)
    plain, dimming = viewer_kernels(gaussians)
    order: list[int] = []
    for i in range(total):
        if not order:
            order = [int(j) for j in rng.permutation(len(frames))]
        frame = frames[order.pop()]
        rate = settings.viewer_learning_rate_scale * FINAL_RATE ** (i / max(total - 1, 1))
        rgb = frame.rgb.astype(np.float32) * np.float32(1 / 255)
        kernel = dimming if i % (PLAIN_IN_TURN + 1) == PLAIN_IN_TURN else plain
        terms = optimise_step(params, frame.camera, frame.T_world_camera, rgb, frame.depth, kernel, rate)
        if not np.isfinite(terms["loss"]):
            raise NumericalError(
                f"Gaussians for viewers: the loss is not finite in iteration {i}; "
                "lower export.viewer_learning_rate_scale or set export.viewer_iterations to 0"
            )
        if i % 20 == 0:
            progress(f"fitting Gaussians to viewers {i}/{total}")
    return params.to_model()
