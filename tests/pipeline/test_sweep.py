from dataclasses import replace
from threading import Barrier

import pytest

from active3d_pipe.errors import ConfigError
from active3d_pipe.pipeline import sweep as s
from active3d_pipe.pipeline.layers import read_layers

TEXT = """
title = "T"
base = "smoke"
steps = 5
seeds = [0, 1]
scenes = ["x/room/scene.glb", "generated:rooms=1,seed=5"]
variants = ["a", { name = "b", label = "B!", set = ["run.max_rounds=3"] }]
set = ["run.threads=1"]
"""


def settings_of(name):
    return {"a": {}, "b": {"uncertainty": {"terms": ["imp", "exp"], "lambda_imp": 0.0}}}[name]


@pytest.fixture
def spec(tmp_path):
    file = tmp_path / "t.toml"
    file.write_text(TEXT)
    return s.read_spec(file, settings_of)


def test_every_combination_is_one_run_with_a_folder_of_its_own(spec, tmp_path):
    cells = s.cells(spec)
    assert len(cells) == 8
    assert len({c.folder(tmp_path) for c in cells}) == 8
    assert cells[1].folder(tmp_path) == tmp_path / "room" / "b" / "seed_0"
    assert cells[2].scene == "generated_rooms_1_seed_5"
    assert [c.seed for c in cells] == [0] * 4 + [1] * 4


def test_settings_are_what_the_command_line_takes(spec):
    cell = s.cells(spec)[1]
    values = read_layers(cell.base, cell.settings, {}).values
    assert values["uncertainty"] == {"terms": ["imp", "exp"], "lambda_imp": 0.0}
    assert values["run"]["steps"] == 5 and values["run"]["threads"] == 1 and values["run"]["max_rounds"] == 3
    assert values["scene"]["file"] == "x/room/scene.glb" and values["run"]["seed"] == 0


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ('title = "T"\ncolour = 3', "'colour' is not known"),
        ('scenes = []', "`scenes` is missing"),
        ('variants = ["a", "a"]', "given twice"),
        ('variants = [{ label = "x" }]', "expected a name"),
        ('variants = [{ name = "a", label = 3 }]', "expected a name"),
        ('variants = [1]', "expected a name"),
        ('variants = [{ name = "a", set = "x.y=1" }]', "`set` of variant 'a' is 'x.y=1'; expected a list"),
        ('seeds = "0"', "`seeds` is '0'; expected a list"),
        ('seeds = []', "`seeds` is empty"),
        ('seeds = ["a"]', "each of them a whole number"),
        ('scenes = [3]', "each of them text"),
        ('set = "run.threads=1"', "`set` is 'run.threads=1'; expected a list"),
        ('metrics = "psnr"', "`metrics` is 'psnr'; expected a list"),
        ('steps = "5"', "`steps` is '5'; expected a whole number"),
        ('base = 3', "`base` is 3; expected text"),
    ],
)
def test_mistakes_are_one_line(tmp_path, change, said):
    key = change.split(" = ")[0]
    lines = [line for line in TEXT.splitlines() if not line.startswith(f"{key} =")]
    file = tmp_path / "t.toml"
    file.write_text("\n".join([*lines, change]))
    with pytest.raises(ConfigError, match=said) as error:
        s.read_spec(file, settings_of)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("text", [
    "[]", "{}", '{"ended": {"a": {"state": "failed", "key": "k", "error": 3}}}',
    '{"ended": {"a": 3}}', '{"ended": {"a": {"x": 1}}}', "{",
])
def test_a_damaged_account_of_a_sweep_is_one_line(spec, tmp_path, text):
    (tmp_path / s.SWEEP).write_text(text)
    with pytest.raises(ConfigError, match=r"cannot be read .*; remove it, finished runs are found again"):
        s.Sweep(tmp_path, spec)


def drive(spec, out, fails=(), stop_at=None, jobs=1):
    ran, said = [], []

    def execute(cell, folder):
        if stop_at is not None and len(ran) == stop_at:
            raise KeyboardInterrupt
        ran.append(folder.relative_to(out).as_posix())
        folder.mkdir(parents=True, exist_ok=True)
        if ran[-1] in fails:
            return "it broke"
        (folder / "done").touch()
        return ""

    sweep = s.Sweep(out, spec)
    failed = sweep.run(execute, said.append, lambda folder: (folder / "done").exists(), jobs)
    return ran, said, failed, sweep


def test_finished_runs_are_skipped_and_failed_ones_do_not_stop_the_others(spec, tmp_path):
    bad = "room/b/seed_0"
    ran, said, failed, sweep = drive(spec, tmp_path, fails=(bad,))
    assert len(ran) == 8 and failed == 1
    assert any("FAILED: it broke" in line for line in said)
    assert sweep.state(sweep.cells[1]).state == "failed"
    # Called again only the failed one is tried; now it works.
    ran, said, failed, sweep = drive(spec, tmp_path)
    assert ran == [bad] and failed == 0
    assert sum("done before" in line for line in said) == 7
    assert all(sweep.state(c).state == "done" for c in sweep.cells)


@pytest.mark.parametrize("jobs", [1, 3])
def test_an_interrupted_sweep_goes_on(spec, tmp_path, jobs):
    with pytest.raises(KeyboardInterrupt):
        drive(spec, tmp_path, stop_at=3, jobs=jobs)
    ran, *_, sweep = drive(spec, tmp_path, jobs=jobs)
    assert len(ran) >= 5 and all(sweep.state(c).state == "done" for c in sweep.cells)


def test_runs_go_on_side_by_side_and_none_begins_after_a_stop(spec, tmp_path):
    both, ran = Barrier(2, timeout=60), []

    def execute(cell, folder):
        ran.append(cell)
        if len(ran) <= 2:
            both.wait()  # passes only if two runs are on their way at once
            raise KeyboardInterrupt
        return ""

    with pytest.raises(KeyboardInterrupt):
        s.Sweep(tmp_path, spec).run(execute, lambda _: None, lambda _: True, 2)
    assert len(ran) == 2


def test_other_settings_or_a_lost_folder_run_again(spec, tmp_path):
    from dataclasses import replace

    drive(spec, tmp_path)
    ran, *_ = drive(replace(spec, settings=("run.steps=6",)), tmp_path)
    assert len(ran) == 8
    (tmp_path / "room/a/seed_0/done").unlink()
    ran, *_ = drive(replace(spec, settings=("run.steps=6",)), tmp_path)
    assert ran == ["room/a/seed_0"]


def test_a_run_made_with_other_settings_is_no_result(spec, tmp_path):
    drive(spec, tmp_path)
    other = s.Sweep(tmp_path, replace(spec, settings=(*spec.settings, "run.steps=999")))
    assert all(other.is_outdated(c) and other.state(c) is None for c in other.cells)
    same = s.Sweep(tmp_path, spec)
    assert not any(same.is_outdated(c) for c in same.cells)
    new = s.Sweep(tmp_path / "nothing_yet", spec)
    assert not any(new.is_outdated(c) for c in new.cells)


def test_the_text_of_the_base_belongs_to_what_was_asked_for(spec, tmp_path):
    base = tmp_path / "base.toml"
    base.write_text("[run]\nsteps = 24\n")
    cell = s.cells(replace(spec, base=str(base)))[0]
    before = cell.key
    base.write_text("[run]\nsteps = 2400\n")
    assert cell.key != before


def test_a_seed_counts_once(spec):
    with pytest.raises(ConfigError, match="seed '0' is given twice"):
        s.checked(replace(spec, seeds=(0, 1, 0)))
