"""Frames that stand for all: as many as asked, and what few show is among them."""

import numpy as np
import pytest

from active3d_pipe.geometry import se3
from active3d_pipe.mapping.frame_choice import CELL_M, VIEWS, covering, surface_cells
from active3d_pipe.structures import Camera, Frame


def walk(count: int) -> list[np.ndarray]:
    """Cells of frames along a walk: each shows a stretch of it, and every seventh something that no other does."""
    out = []
    for n in range(count):
        cells = np.arange(n, n + 40) // 4
        out.append(np.unique([*cells, 1000 + n] if n % 7 == 3 else cells))
    return out


def test_few_frames_are_all_taken() -> None:
    assert covering(walk(20), 20) == list(range(20))
    assert covering([], 5) == []


def test_what_few_frames_show_is_kept() -> None:
    cells = walk(200)
    chosen = covering(cells, 100)
    assert len(chosen) == 100 and chosen == sorted(set(chosen))
    assert {0, 199} <= set(chosen)
    assert set(range(3, 200, 7)) <= set(chosen)
    assert chosen == covering(cells, 100)


@pytest.mark.parametrize("most", [1, 2, 7, 60, 199])
def test_as_many_as_asked(most: int) -> None:
    rng = np.random.default_rng(most)
    cells = [np.unique(rng.integers(0, 300, rng.integers(0, 50))) for _ in range(200)]
    assert len(covering(cells, most)) == most


def test_a_greedy_choice_shows_more_than_an_even_one() -> None:
    rng = np.random.default_rng(2)
    cells = [np.unique((rng.pareto(1.0, 60) * 20).astype(np.int64)) for _ in range(300)]
    available = np.bincount(np.concatenate(cells))

    def short(chosen: list[int]) -> int:
        shown = np.bincount(np.concatenate([cells[i] for i in chosen]), minlength=len(available))
        return int((shown < np.minimum(available, VIEWS)).sum())

    even = [int(i) for i in np.linspace(0, 299, 90).round()]
    assert short(covering(cells, 90)) < 0.9 * short(even)


def test_cells_of_a_frame_lie_on_what_it_reads() -> None:
    camera = Camera.from_fov(80, 60, 70.0)
    T = se3.look_at(np.array([-3.0, 0.0, 0.0]), np.array([0.0, 0.0, 0.0]))
    depth = np.full((60, 80), 2.0, np.float32)
    frame = Frame(0, 0, camera, T, np.zeros((60, 80, 3), np.uint8), depth)
    cells = surface_cells(frame)
    assert (np.diff(cells) > 0).all() and 10 < len(cells) <= 80
    moved = T.copy()
    moved[0, 3] += CELL_M  # one cell on along x: all numbers grow by the same
    assert len(np.unique(surface_cells(Frame(0, 0, camera, moved, frame.rgb, depth)) - cells)) == 1
    nothing = Frame(0, 0, camera, T, frame.rgb, np.zeros_like(depth))
    assert len(surface_cells(nothing)) == 0
