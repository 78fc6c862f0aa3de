"""Which policies there are. Light to import: a policy's own module is loaded when it is made.

A new policy inside the package is one line in `POLICIES`. One outside is an entry point of the group
`active3d.policies`, or named by its import path: `planning.policy = "my_module:MyPolicy"`.
"""

import difflib
import hashlib
import importlib
import inspect
from importlib.metadata import entry_points
from typing import TYPE_CHECKING, Any, NamedTuple

from active3d_pipe.errors import ConfigError

if TYPE_CHECKING:
    from active3d_pipe.planning.policies.context import Policy

GROUP = "active3d.policies"


class Entry(NamedTuple):
    """Where a policy is: `module:Class` relative to this package; whether it reads the map."""

    path: str
    needs_map: bool


POLICIES: dict[str, Entry] = {
    "active3d": Entry("active3d:Active3D", False),  # hierarchical uncertainty, information gain per step, risk
    "activeinr": Entry("activeinr:ActiveInr", True),  # weight perturbation of the whole SDF field (ActiveINR, ANM)
    "anm_s": Entry("anm_s:AnmS", True),  # perturbation of the SDF decoder on a Voronoi graph (ANM-S)
    "naruto": Entry("naruto:Naruto", False),  # learned uncertainty summed over visible surface (NARUTO)
    "aggregation": Entry("aggregation:Aggregation", False),  # NARUTO's search over the fused uncertainty volume
    "activesplat": Entry("activesplat:ActiveSplat", True),  # Voronoi graph, opacity, look-around (ActiveSplat)
    "activegamer": Entry("activegamer:ActiveGamer", True),  # unseen pixels of rendered views, two stages (ActiveGAMER)
    "fisherrf": Entry("fisherrf:FisherRF", True),  # expected information gain by the diagonal Fisher matrix (FisherRF)
    "activegs": Entry("activegs:ActiveGS", True),  # confidence of primitives and unexplored space (ActiveGS)
    "gsplanner": Entry("gsplanner:GSPlanner", True),  # unobserved volume in front of the rendered depth (GS-Planner)
    "frontier": Entry("frontier:Frontier", False),  # nearest border between free and unknown space
    "volume": Entry("volume:UnknownVolume", False),  # most unknown voxels in view per step
    "random": Entry("random_views:RandomViews", False),  # a random free pose, then the next
    "sweep": Entry("sweep:Sweep", False),  # boustrophedon over a fixed lattice
    "trajectory": Entry("trajectory:Trajectory", False),  # poses recorded in a file or by another run
}


def policy_names() -> list[str]:
    """Names of the policies inside the package, then those of installed packages."""
    return [*POLICIES, *sorted(e.name for e in entry_points(group=GROUP) if e.name not in POLICIES)]


def check_name(name: str) -> str:
    """The name itself; ValueError (one line) when there is no such policy. Loads nothing from import paths."""
    if ":" in name or name in POLICIES:
        return name
    names = policy_names()
    if name in names:
        return name
    near = difflib.get_close_matches(name, names, 1)
    hint = f"; did you mean {near[0]!r}?" if near else ""
    raise ValueError(
        f"there is no policy {name!r}{hint} The policies are {', '.join(names)}; your own is given as module:Class"
    )


def needs_map(name: str) -> bool:
    """Whether the policy looks at the map itself, beside the uncertainty volume."""
    if name in POLICIES:
        return POLICIES[name].needs_map
    return bool(getattr(_load(name), "needs_map", False))


def source_digest(name: str) -> str | None:
    """SHA-256 of the code of a policy from outside, which enters the keys of its decisions; None for those inside."""
    if name in POLICIES:
        return None
    try:
        return hashlib.sha256(inspect.getsource(inspect.getmodule(_load(name)) or _load(name)).encode()).hexdigest()
    except (OSError, TypeError):
        return "unknown"


def make_policy(name: str) -> "Policy":
    """The policy of that name; ConfigError when it cannot be loaded."""
    made = _load(name)()
    if not callable(getattr(made, "decide", None)):
        raise ConfigError(f"planning.policy = {name!r}: {type(made).__name__} has no method decide(context)")
    return made


def _load(name: str) -> Any:
    if name in POLICIES:
        path = f"{__package__}.{POLICIES[name].path}"
    elif ":" in name:
        path = name
    else:
        found = [e for e in entry_points(group=GROUP) if e.name == name]
        if not found:
            known = ", ".join(policy_names())
            raise ConfigError(f"planning.policy = {name!r}: is not installed; the policies are {known}")
        path = found[0].value
    module, _, attribute = path.partition(":")
    try:
        return getattr(importlib.import_module(module), attribute)
    except (ImportError, AttributeError, SyntaxError, ValueError) as error:
        raise ConfigError(f"planning.policy = {name!r}: cannot be loaded ({error}); expected module:Class") from error
