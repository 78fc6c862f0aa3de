"""What every metric's name means: unit, which way is better, one sentence. The names are part of the interface."""

from typing import TypedDict


class About(TypedDict):
    """Unit ("" = none; "%" = a share of 1), "higher" | "lower" | "" and an explanation in one sentence."""

    unit: str
    better: str
    explanation: str


GEOMETRY: dict[str, tuple[str, str, str]] = {
    "accuracy_cm": ("cm", "lower", "mean distance reconstruction to ground truth"),
    "accuracy_median_cm": ("cm", "lower", "median distance reconstruction to ground truth"),
    "completion_cm": ("cm", "lower", "mean distance ground truth to reconstruction"),
    "completion_median_cm": ("cm", "lower", "median distance ground truth to reconstruction"),
    "completion_ratio": ("%", "higher", "share of the ground truth within the threshold of the reconstruction"),
    "precision": ("%", "higher", "share of the reconstruction within the threshold of the ground truth"),
    "fscore": ("%", "higher", "harmonic mean of precision and completion ratio"),
}
FORMS = {
    "surface": "point to surface",
    "p2p": "point to point, fixed number of points",
    "density": "point to point, fixed density",
}
SUBSETS = {
    "floor": "what a perfect reconstruction scores by sampling alone",
    "observable": "against surface that a reachable pose can see",
    "unculled": "parts that no camera saw included",
    "observable_unculled": "against surface that a reachable pose can see, unseen parts included",
}
VIEWS: dict[str, tuple[str, str, str]] = {
    "psnr": ("dB", "higher", "peak signal-to-noise ratio, mean over views"),
    "ssim": ("", "higher", "structural similarity, plain, 11x11 Gaussian window"),
    "ms_ssim": ("", "higher", "multi-scale structural similarity"),
    "lpips": ("", "lower", "learned perceptual distance, AlexNet"),
    "depth_l1_cm": ("cm", "lower", "mean absolute depth error"),
    "depth_median_cm": ("cm", "lower", "median absolute depth error, mean over views"),
    "rendered_share": ("%", "higher", "share of pixels where the model renders something"),
    "psnr_median": ("dB", "higher", "median over views"),
    "psnr_p10": ("dB", "higher", "a tenth of the views are worse"),
    "num_views": ("", "", "number of views"),
}
VIEW_SETS = {
    "": "held-out views",
    "circle": "views on the inward-looking circle",
    "train": "captured frames",
}
SINGLE: dict[str, tuple[str, str, str]] = {
    "mad_cm": ("cm", "lower", "mean |SDF| of the field at ground-truth points, unseen ones included"),
    "psnr_gap": ("dB", "lower", "captured frames minus held-out views"),
    "reconstruction_area_m2": ("m²", "", "area of the reconstruction"),
    "truth_area_m2": ("m²", "", "area of the ground truth"),
    "observable_share": ("%", "", "share of the ground truth that a reachable pose can see"),
    "path_m": ("m", "lower", "length of the walked path"),
    "min_clearance_m": ("m", "higher", "least distance of a walked pose to any true surface"),
    "collisions": ("", "lower", "steps that ended in or passed through true surface"),
    "steps": ("", "", "exploration steps"),
    "rounds": ("", "", "rounds of the loop"),
    "seconds_per_step": ("s", "lower", "mean wall time of a step"),
    "peak_memory_mb": ("MB", "lower", "peak resident memory"),
}


def _table() -> dict[str, About]:
    found = {name: About(unit=u, better=b, explanation=e) for name, (u, b, e) in SINGLE.items()}
    for name, (unit, better, text) in GEOMETRY.items():
        for form, how in FORMS.items():
            found[f"{name}_{form}"] = About(unit=unit, better=better, explanation=f"{text}; {how}")
            for subset, what in SUBSETS.items():
                found[f"{name}_{form}_{subset}"] = About(
                    unit=unit, better="" if subset == "floor" else better, explanation=f"{text}; {how}; {what}"
                )
    for name, (unit, better, text) in VIEWS.items():
        for view_set, where in VIEW_SETS.items():
            base, _, statistic = name.partition("_") if name in ("psnr_median", "psnr_p10") else (name, "", "")
            key = "_".join(part for part in (base, view_set, statistic) if part)
            found[key] = About(unit=unit, better=better, explanation=f"{text}; {where}")
    return found


TABLE = _table()


def describe(name: str) -> About | None:
    """Unit, direction and explanation of a metric; None for a name that is not a metric."""
    return TABLE.get(name)
