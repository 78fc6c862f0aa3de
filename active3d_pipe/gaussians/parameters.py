"""The Gaussians while they are optimised: one packed tensor, Adam's moments, and what a resume needs."""

import numpy as np
import torch
from torch import Tensor

from active3d_pipe.errors import ArtifactError
from active3d_pipe.gaussians import kernels_adam, raster_pass
from active3d_pipe.gaussians.config import GaussianSettings
from active3d_pipe.gaussians.raster_pass import Workspace
from active3d_pipe.structures import Camera, GaussianModel

MEANS, LOG_SCALES, QUATS = slice(0, 3), slice(3, 6), slice(6, 10)
OPACITY_LOGITS, COLORS = 10, slice(11, 14)
WIDTH = 14
LARGEST_M = 1e3  # standard deviation of a primitive, where no bound is given, m
GROWTH = 0.05  # share of room that is taken for more when arrays grow


class GaussianParameters:
    """N Gaussians and the state of their optimiser.

    An iteration moves those that its image shows; the others owe the steps that their momentum takes (`kernels_adam`),
    and take them when they may be seen again, or when any of the four arrays below is asked for.

    Attributes:
        values: (N, 14) float32, one row per primitive: mean (world, m) 0:3, log-scale 3:6, quaternion wxyz 6:10,
            opacity logit 10, colour 11:14. `means`, `log_scales`, `quats`, `opacity_logits`, `colors` are
            writable views of its columns.
        moment1, moment2: (N, 14) float32, Adam's moments.
        steps: (N,) int32, number of Adam steps each primitive has taken; new ones start at 0.
        workspace: buffers of the kernels; no part of the state.
    """

    def __init__(self, values: Tensor, moment1: Tensor, moment2: Tensor, steps: Tensor) -> None:
        self._arrays: tuple[Tensor, ...] = (values, moment1, moment2, steps)
        self.workspace = Workspace()
        self._room: tuple[Tensor, ...] = ()
        # Iterations so far, the one that each primitive has come to, and how Adam ran in the last.
        self._now = 0
        self._done = np.zeros(len(values), np.int32)
        self._adam = (np.zeros(WIDTH, np.float32), np.float32(0), np.float32(0), np.float32(0))
        self._owing = False
        self._places: np.ndarray | None = None

    @property
    def values(self) -> Tensor:
        """See the class."""
        return self._settled()[0]

    @property
    def moment1(self) -> Tensor:
        """See the class."""
        return self._settled()[1]

    @property
    def moment2(self) -> Tensor:
        """See the class."""
        return self._settled()[2]

    @property
    def steps(self) -> Tensor:
        """See the class."""
        return self._settled()[3]

    def _plain(self) -> tuple[np.ndarray, ...]:
        """The four arrays as they are, and `kernels_adam.measure` of the first."""
        arrays = tuple(a.detach().numpy() for a in self._arrays)
        if self._places is None:
            self._places = np.empty((len(self), 4), np.float32)
            kernels_adam.measure(arrays[0], self._places)
        return *arrays, self._places

    def _settled(self) -> tuple[Tensor, ...]:
        """The four arrays, when all steps that are owed have been taken; who gets them may change them."""
        if self._owing:
            self._catch_up(np.arange(len(self), dtype=np.int32))
            self._owing = False
        self._places = None
        return self._arrays

    def _catch_up(self, rows: np.ndarray) -> None:
        kernels_adam.catch_up(*self._plain(), self._done, self._now, rows, *self._adam)  # type: ignore[call-arg]

    def _replace(self, arrays: tuple[Tensor, ...]) -> None:
        """Other arrays, none of which owes a step."""
        self._arrays, self._owing, self._places = arrays, False, None
        self._done = np.full(len(arrays[0]), self._now, np.int32)

    @classmethod
    def from_model(cls, model: GaussianModel) -> "GaussianParameters":
        """Parameters that hold a copy of `model`; moments and steps start at zero."""
        return cls._fresh(_pack(model))

    @classmethod
    def from_values(cls, values: np.ndarray) -> "GaussianParameters":
        """Parameters with a copy of `values` (N, 14) float32; moments and steps start at zero."""
        if values.ndim != 2 or values.shape[1] != WIDTH or values.dtype != np.float32:
            raise ArtifactError(f"Gaussians: values are {values.shape} {values.dtype}, expected (N, {WIDTH}) float32")
        return cls._fresh(values.copy())

    @classmethod
    def _fresh(cls, values: np.ndarray) -> "GaussianParameters":
        return cls(torch.from_numpy(values), *_no_moments(len(values)))

    def to_model(self, *, copy: bool = True) -> GaussianModel:
        """As plain arrays: a copy, or views for who only reads and is done before the next change."""
        v = self.values.detach().numpy()
        columns = (MEANS, LOG_SCALES, QUATS, OPACITY_LOGITS, COLORS)
        return GaussianModel(*(v[:, c].copy() if copy else v[:, c] for c in columns))

    def __len__(self) -> int:
        return len(self._arrays[0])

    @property
    def means(self) -> Tensor:
        """(N, 3) world, m; a view."""
        return self.values[:, MEANS]

    @property
    def log_scales(self) -> Tensor:
        """(N, 3) natural logarithm of the standard deviations, m; a view."""
        return self.values[:, LOG_SCALES]

    @property
    def quats(self) -> Tensor:
        """(N, 4) local -> world, wxyz, not normalised; a view."""
        return self.values[:, QUATS]

    @property
    def opacity_logits(self) -> Tensor:
        """(N,) opacity = sigmoid(logit); a view."""
        return self.values[:, OPACITY_LOGITS]

    @property
    def colors(self) -> Tensor:
        """(N, 3) display colour; a view."""
        return self.values[:, COLORS]

    def append(self, model: GaussianModel) -> None:
        """Add the primitives of `model` at the end; their moments and step counts start at zero."""
        if len(model) == 0:
            return
        n = len(self)
        room = self._reserve(n + len(model))
        room[0][n : n + len(model)] = torch.from_numpy(_pack(model))
        self._arrays, self._places = tuple(a[: n + len(model)] for a in room), None
        self._done = np.concatenate([self._done, np.full(len(model), self._now, np.int32)])

    def _reserve(self, count: int) -> tuple[Tensor, ...]:
        """Arrays for at least `count` primitives that begin with these; what lies beyond them was never written."""
        room = self._room
        if room and len(room[0]) >= count and room[0].data_ptr() == self._arrays[0].data_ptr():
            return room
        size = count + int(GROWTH * count)
        room = (torch.from_numpy(np.zeros((size, WIDTH), np.float32)), *_no_moments(size))
        for new, old in zip(room, self._arrays, strict=True):
            new[: len(self)] = old.detach()
        self._room = room
        return room

    def keep(self, mask: np.ndarray) -> None:
        """Drop the primitives where `mask` (N,) bool is False; the others keep order and optimiser state."""
        if mask.all():
            return
        kept = torch.from_numpy(np.flatnonzero(mask))
        self._replace(tuple(a.detach()[kept] for a in self._settled()))

    def rest(self, mask: np.ndarray) -> np.ndarray:
        """Keep the primitives where `mask` (N,) bool is False; returns the values (M, 14) of the others for `wake`."""
        resting = self.values.detach().numpy()[mask]
        self.keep(~mask)
        return resting

    def wake(self, resting: np.ndarray) -> None:
        """Put primitives with these values (M, 14) in front, as if the optimiser had never run on them."""
        held = self._settled()
        m = len(resting)
        whole = (np.empty((m + len(self), WIDTH), np.float32), *(a.numpy() for a in _no_moments(m + len(self))))
        whole[0][:m] = resting
        for new, old in zip(whole, held, strict=True):
            new[m:] = old.detach()
        self._replace(tuple(torch.from_numpy(a) for a in whole))

    def state(self) -> dict[str, np.ndarray]:
        """Everything a later `from_state` needs to go on with the same bytes; views, valid until the next step.

        `moment1`, `moment2` and `steps` hold the last primitives only, from the first one with a step on: those
        before it have zeros.
        """
        moved = np.flatnonzero(self.steps.numpy())
        first = int(moved[0]) if len(moved) else len(self)
        return {
            "values": self.values.detach().numpy(),
            "moment1": self.moment1.numpy()[first:],
            "moment2": self.moment2.numpy()[first:],
            "steps": self.steps.numpy()[first:],
        }

    @classmethod
    def from_state(cls, state: dict[str, np.ndarray]) -> "GaussianParameters":
        """Inverse of `state`; raises ArtifactError on missing, misshapen or mistyped arrays."""
        n = len(state["values"]) if "values" in state else 0
        m = len(state["steps"]) if "steps" in state else 0
        whole = {}
        for name in ("values", "moment1", "moment2", "steps"):
            a = state.get(name)
            shape = (n if name == "values" else m, WIDTH) if name != "steps" else (m,)
            dtype = np.int32 if name == "steps" else np.float32
            if a is None or a.shape != shape or a.dtype != dtype or m > n:
                got = "missing" if a is None else f"{a.shape} {a.dtype}"
                raise ArtifactError(f"optimiser state: {name} is {got}, expected {shape} {np.dtype(dtype)}")
            whole[name] = np.zeros((n, *shape[1:]), dtype)
            whole[name][n - len(a) :] = a
        return cls(*(torch.from_numpy(a) for a in whole.values()))

    def near(self, camera: Camera, T_world_camera: np.ndarray, dilation_px2: float) -> tuple[np.ndarray, np.ndarray]:
        """The primitives that a view may show, after the steps that they owe.

        Returns:
            values (N, 14) float32, of which only the rows that follow are up to date; a view.
            rows (L,) int32, ascending, a superset of those that the view shows.
        """
        n, chunks = len(self), raster_pass.CHUNKS
        which, counts = self.workspace.get("may_be_seen", (n,), np.int32), np.zeros(chunks, np.int64)
        kernels_adam.near(  # type: ignore[call-arg]
            *self._plain(), self._done, self._now, *self._adam, *raster_pass.view_arrays(camera, T_world_camera),
            np.float32(dilation_px2), chunks, which, counts,
        )
        parts = [which[n * c // chunks :][:count] for c, count in enumerate(counts.tolist())]
        return self._plain()[0], np.concatenate(parts)

    def rows(self, rows: np.ndarray) -> np.ndarray:
        """(M, 14) float32 copy of the values of primitives (M,), after the steps that they owe."""
        self._catch_up(rows)
        return self._plain()[0][rows]

    def step(
        self, grads: np.ndarray | Tensor, settings: GaussianSettings, learning_rate_scale: float = 1.0,
        rows: np.ndarray | None = None, largest_m: float = LARGEST_M,
    ) -> None:
        """One Adam step with dL/dvalues `grads`.

        Args:
            grads: (M, 14) float32 gradient of the loss, at the primitives `rows`.
            settings: learning rates and decays; with `visible_only` the others stay as they are for good.
            learning_rate_scale: factor on all learning rates (annealing).
            rows: (M,) int32, different primitives that `near` or `rows` gave out since the last step; default all.
                The gradient of the others is zero.
            largest_m: standard deviation that none may grow beyond, m.
        """
        grad = grads.numpy() if isinstance(grads, Tensor) else grads
        if rows is None:
            self._settled()
            rows = np.arange(len(self), dtype=np.int32)
        rates = np.empty(WIDTH, np.float32)
        rates[MEANS], rates[LOG_SCALES], rates[QUATS] = settings.lr_means_m, settings.lr_log_scales, settings.lr_quats
        rates[OPACITY_LOGITS], rates[COLORS] = settings.lr_opacity_logits, settings.lr_colors
        self._adam = (
            rates * np.float32(learning_rate_scale), np.float32(settings.adam_beta1), np.float32(settings.adam_beta2),
            np.float32(np.log(largest_m)),
        )
        grad = np.ascontiguousarray(grad, dtype=np.float32)
        kernels_adam.adam(*self._plain(), rows, grad, *self._adam)  # type: ignore[call-arg]
        if settings.visible_only:
            return
        self._now += 1
        self._done[rows] = self._now
        self._owing |= len(rows) < len(self)


def _no_moments(n: int) -> tuple[Tensor, Tensor, Tensor]:
    """Moments and step counts of n primitives that were never moved; NumPy's zeros take memory when written to."""
    shapes = ((n, WIDTH), np.float32), ((n, WIDTH), np.float32), ((n,), np.int32)
    moment1, moment2, steps = (torch.from_numpy(np.zeros(shape, dtype)) for shape, dtype in shapes)
    return moment1, moment2, steps


def _pack(model: GaussianModel) -> np.ndarray:
    """(N, 14) float32 rows of a model."""
    return np.concatenate(
        [model.means, model.log_scales, model.quats, model.opacity_logits[:, None], model.colors], axis=1
    ).astype(np.float32)
