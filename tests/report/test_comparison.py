import csv
import io
import json

import numpy as np
import pytest

from active3d_pipe.report import comparison as c
from active3d_pipe.report import comparison_tables as tables
from active3d_pipe.report.comparison_curves import band, completion_figure, write_figure
from active3d_pipe.report.comparison_data import read_result
from tests.tiny_run import active3d

LABELS = {"ours": "Ours", "other": "Other & co", "none": "None"}
PSNR, ACC = c.KNOWN["psnr"], c.KNOWN["accuracy_cm_surface"]


def result(scene, variant, seed, psnr=None, state="done", **more):
    metrics = {} if psnr is None else {"psnr": psnr, "accuracy_cm_surface": 40 - psnr, **more}
    curve = np.array([(10, 0.5, 0.4), (20, 1.5, 0.8)]) if metrics else np.zeros((0, 3))
    return c.Result(scene, variant, seed, state, metrics, curve, "boom" if state == "failed" else "")


@pytest.fixture
def results():
    return [
        result("a", "ours", 0, 30.0), result("a", "ours", 1, 32.0), result("b", "ours", 0, 20.0),
        result("b", "ours", 1, 22.0), result("a", "other", 0, 31.0), result("a", "other", 1, 31.0),
        result("b", "other", 0, 25.0), result("b", "other", 1, state="failed"), result("a", "none", 0, state="failed"),
        result("a", "none", 1, state="failed"), result("b", "none", 0, state="missing"),
        result("b", "none", 1, state="missing"),
    ]


def test_means_deviations_and_averages_are_over_seeds(results):
    ours = [r for r in results if r.variant == "ours"]
    s = c.summarise(ours[:2], PSNR)
    assert (s.mean, s.count, s.failed, s.total) == (31.0, 2, 0, 2)
    assert s.std == pytest.approx(np.sqrt(2))
    whole = c.average(ours, PSNR)
    # Seed 0: (30 + 20) / 2, seed 1: (32 + 22) / 2.
    assert (whole.mean, whole.std) == (26.0, pytest.approx(np.sqrt(2)))
    other = c.average([r for r in results if r.variant == "other"], PSNR)
    assert (other.mean, other.std, other.count, other.total) == (28.0, None, 3, 4)
    # Without a result in one scene there is no average that could be compared.
    assert c.average([r for r in results if r.variant == "none"], PSNR).mean is None


def test_cells_mark_failures_and_what_is_missing(results):
    grid = tables.Grid(results, LABELS, [PSNR])
    text = {v: [tables.cell_text(s, PSNR) for s in grid.row(v, PSNR)] for v in LABELS}
    assert text["ours"] == ["31.00 ± 1.41", "21.00 ± 1.41", "26.00 ± 1.41"]
    assert text["other"] == ["31.00 ± 0.00", "25.00 (1/2)", "28.00 (3/4)"]
    assert text["none"] == ["×", "–", "× (2/4)"]


def test_the_best_is_marked_in_the_right_direction_and_ties_share(results):
    grid = tables.Grid(results, LABELS, [PSNR, ACC])
    assert grid.best_of(PSNR) == [{"ours", "other"}, {"other"}, {"other"}]
    assert grid.best_of(ACC) == [{"ours", "other"}, {"other"}, {"other"}]
    lines = tables.per_scene_markdown(grid).splitlines()
    assert lines[0] == "| Method | Metric | a | b | Avg. |"
    assert lines[2] == "| Ours | PSNR ↑ | **31.00 ± 1.41** | 21.00 ± 1.41 | 26.00 ± 1.41 |"
    assert lines[3].startswith("|  | Acc (cm) ↓ | **9.00 ± 1.41** |")
    assert all(line.count("|") == 6 for line in lines)


def test_latex_is_shaded_escaped_and_balanced(results):
    grid = tables.Grid(results, LABELS, [PSNR, ACC])
    for text in (tables.per_scene_latex(grid, "50 % of it"), tables.overall_latex(grid, "50 % of it")):
        assert text.count("{") - text.count(r"\{") == text.count("}") - text.count(r"\}")
        assert r"Other \& co" in text and r"50 \% of it" in text and r"$\times$" in text
        assert r"\cellcolor{blue!25}28.00" in text
        assert r"26.00 $\pm$ 1.41" in text


def test_csv_can_be_read_again(results):
    grid = tables.Grid(results, LABELS, [PSNR])
    rows = list(csv.DictReader(io.StringIO(tables.summary_csv(grid))))
    assert len(rows) == 9
    assert [r["mean"] for r in rows if r["variant"] == "ours"] == ["31.0", "21.0", "26.0"]
    runs = list(csv.DictReader(io.StringIO(tables.runs_csv(results))))
    assert [r["state"] for r in runs].count("failed") == 3
    assert float(runs[0]["psnr"]) == 30.0 and runs[7]["psnr"] == "" and runs[7]["error"] == "boom"


def test_permutation_p_is_exact():
    assert c.permutation_p(np.array([1.0])) is None
    # All of one sign: only the two extreme of 2^n sign patterns are as large.
    assert c.permutation_p(np.array([1.0, 2.0, 3.0, 4.0])) == 2 / 16
    assert c.permutation_p(np.array([1.0, -1.0])) == 1.0
    many = np.random.default_rng(0).normal(0, 1, 40)
    assert c.permutation_p(many - many.mean()) > 0.95
    assert c.permutation_p(many + 2) < 0.001


def test_paired_tests_use_pairs_only_and_are_corrected():
    rng = np.random.default_rng(1)
    results = []
    for scene in "abc":
        for seed in range(2):
            base = rng.normal(30, 3)
            results += [
                result(scene, "ours", seed, base), result(scene, "worse", seed, base - 1 - 0.01 * seed),
                result(scene, "same", seed, base + (-1) ** seed * 0.1),
            ]
    results.append(result("d", "worse", 0, 99.0))
    tests = c.paired_tests(results, ["ours", "worse", "same"], [PSNR])
    worse, same = tests
    assert (worse.count, same.count) == (6, 6)
    assert worse.mean == pytest.approx(-1.005)
    assert worse.p_permutation == 2 / 64 and worse.p_holm == 4 / 64
    assert worse.p_wilcoxon == pytest.approx(2 / 64)
    assert same.p_permutation > 0.9
    text = tables.tests_markdown(tests, {"worse": "Worse"}, "Ours")
    assert "| PSNR | Worse | 6 | -1.00 | 0.031 | 0.062 | 0.031 |" in text or "-1.01" in text


def test_a_band_covers_the_runs_and_a_stopped_run_keeps_its_value():
    a = np.array([(0, 0.0, 0.0), (10, 1.0, 0.5)])
    b = np.array([(0, 0.0, 0.0), (20, 2.0, 1.0)])
    x, mean, low, high = band([a, b], 0)
    assert (x[0], x[-1]) == (0, 20)
    assert (low[-1], mean[-1], high[-1]) == (50, 75, 100)
    assert (low <= mean).all() and (mean <= high).all()


def test_figures_are_written_and_equal_bytes(results, tmp_path):
    first, second = tmp_path / "1", tmp_path / "2"
    for folder in (first, second):
        folder.mkdir()
        assert len(write_figure(results, LABELS, folder)) == 2
    for name in ("completion.png", "completion.svg"):
        assert (first / name).read_bytes() == (second / name).read_bytes()
    assert write_figure([result("a", "ours", 0, state="missing")], LABELS, tmp_path) == []


def test_a_curve_without_metres_is_drawn_over_steps_alone():
    curve = np.array([[10, np.nan, 0.5], [20, np.nan, 0.75]])
    figure = completion_figure([c.Result("a", "ours", 0, "done", {}, curve)], {"ours": "ours"})
    over_steps, over_metres = figure.axes
    assert len(over_steps.lines[0].get_xdata()) > 0 and len(over_metres.lines[0].get_xdata()) == 0


def fabricate(run):
    """The files of a finished run that tables are made of."""
    (run / "evaluation").mkdir(parents=True)
    (run / "evaluation" / "metrics.json").write_text(json.dumps({"metrics": {"psnr": 30.0, "steps": 20, "x": None}}))
    key = "completion_ratio_surface_observable"
    points = [{"round": 0, "step": 10, "path_m": 0.5, key: 0.5}, {"round": 2, "step": 20, "path_m": 3.5, key: 0.75}]
    (run / "evaluation" / "curves.json").write_text(json.dumps(points))
    events = [("capture/round_0000", 1.0), ("capture/round_0000", 3.0), ("mapping/round_0000", 5.0), ("export", 9.0)]
    lines = [json.dumps({"event": "commit", "node": n, "seconds": s}) for n, s in events]
    (run / "journal.jsonl").write_text("\n".join(lines))


def test_reading_a_run_folder(tmp_path):
    run = tmp_path / "run"
    assert read_result("a", "v", 0, run).state == "missing"
    fabricate(run)
    r = read_result("a", "v", 0, run)
    assert r.metrics == {"psnr": 30.0, "steps": 20.0, "seconds_per_step": 8 / 20}
    np.testing.assert_allclose(r.curve, [(10, 0.5, 0.5), (20, 3.5, 0.75)])
    assert read_result("a", "v", 0, run, "broke").state == "failed"
    for text in ("{", "[]", '{"metrics": 3}'):
        (run / "evaluation" / "metrics.json").write_text(text)
        r = read_result("a", "v", 0, run)
        assert r.state == "failed" and "active3d evaluate" in r.error


def test_what_is_neither_good_nor_bad_is_not_marked(results):
    for r in results:
        if r.metrics:
            r.metrics["steps"] = 10.0 + r.seed
    grid = tables.Grid(results, LABELS, [c.KNOWN["steps"]])
    text = tables.overall_markdown(grid)
    assert "**" not in text and text.startswith("| Method | steps |")


def test_the_command_makes_tables_of_what_is_there_and_says_what_is_left(tmp_path):
    out = tmp_path / "out"
    fabricate(out / "room" / "active3d" / "seed_0")
    scene = tmp_path / "room" / "scene.glb"
    common = ("compare", "active3d", "without_rgb_uncertainty", "--scene", scene, "--out", out)
    plan = active3d(*common, "--dry-run", "--steps", 7)
    assert plan.returncode == 0, plan.stderr
    assert "2 of 2 would run" in plan.stdout and "--set run.steps=7" in plan.stdout
    made = active3d(*common, "--tables-only", "--json")
    assert made.returncode == 0, made.stderr
    document = json.loads(made.stdout)
    assert document["runs"]["room/without_rgb_uncertainty/seed_0"] == "to do"
    names = {f.rsplit("/", 1)[1] for f in document["files"]}
    assert {"overall.md", "per_scene.tex", "tests.md", "completion.png"} <= names
    assert "| active3d | 30.00 |" in (out / "overall.md").read_text()
    wrong = active3d("compare", "narutoo", "--scene", "x", "--out", out)
    assert wrong.returncode == 2 and "did you mean 'naruto'" in wrong.stderr and wrong.stderr.count("\n") == 1


def test_a_run_that_fails_is_marked_and_the_command_says_so(tmp_path):
    scene = tmp_path / "nowhere.glb"
    done = active3d("compare", "random", "--base", "smoke", "--scene", scene, "--out", tmp_path / "out")
    assert done.returncode == 1
    assert "FAILED" in done.stderr and "no such file" in done.stderr
    assert "×" in (tmp_path / "out" / "overall.md").read_text()
