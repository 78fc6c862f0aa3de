"""Keys: what re-runs when one setting changes."""

import warnings
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from active3d_pipe.pipeline.config import Config, load_config
from active3d_pipe.pipeline.config_errors import leaves, section_of
from active3d_pipe.pipeline.graph import Registry
from active3d_pipe.pipeline.keys import canonical, differences, digest, node_seed
from active3d_pipe.pipeline.stage import NodeId
from active3d_pipe.pipeline.threads import set_threads
from active3d_pipe.pipeline.view import UndeclaredConfigError, subset
from tests.pipeline.conftest import open_runner
from tests.pipeline.toy import REGISTRY

ALL = [str(node) for node in REGISTRY.nodes(2)]
FROM = ALL.index


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ("run.name=other", ["report"]),
        ("camera.width=9", ["evaluation", "report"]),
        ("evaluation.num_views=3", []),
        ("planning.rrt_iterations=1", []),
        ("sensor.dropout=0.5", ALL),
        ("run.seed=1", ALL),
        ("run.threads=1", ALL),
        ("mapping.keyframes.tau_high=0.5", ALL[FROM("uncertainty/round_0000") :]),
        ("motion.max_step_m=0.05", ALL[FROM("planning/round_0000") :]),
        ("run.steps=9", [*ALL[FROM("capture/round_0002") :]]),
        # Declared, so mapping runs again; it comes to the same bytes, so nothing after it does.
        ("mapping.window.replay=0.1", [n for n in ALL if n.startswith("mapping")]),
    ],
)
def test_a_changed_setting_reruns_what_reads_it(run_path: Path, change: str, expected: list[str]) -> None:
    runner = open_runner(run_path, change)
    outcome = runner.run()
    set_threads(2)
    assert [str(node) for node in outcome.executed] == expected
    assert open_runner(run_path, change).run().executed == ()


@pytest.mark.parametrize(
    ("change", "node", "reason"),
    [
        ("run.name=other", "report", 'run.name  -> other'),
        ("sensor.dropout=0.5", "capture/round_0000", "sensor.dropout 0.0 -> 0.5"),
        ("run.threads=1", "capture/round_0000", "threads 2 -> 1"),
        ("run.steps=9", "capture/round_0002", "limit 2 -> 1"),
        ("motion.max_step_m=0.05", "capture/round_0001", "follows planning/round_0000"),
    ],
)
def test_dry_run_says_why_and_touches_nothing(run_path: Path, change: str, node: str, reason: str) -> None:
    before = {p: p.stat().st_mtime_ns for p in run_path.rglob("*")}
    plan = open_runner(run_path, change, write=False).dry_run().plan
    found = {str(state.node): state for state in plan}
    assert not found[node].state.is_hit
    assert reason in found[node].reasons
    assert {p: p.stat().st_mtime_ns for p in run_path.rglob("*")} == before


def test_dry_run_of_a_complete_run_is_all_hits(run_path: Path) -> None:
    assert all(state.state.is_hit for state in open_runner(run_path).dry_run().plan)


def _changed(config: Any, path: str) -> Any:
    name, _, rest = path.partition(".")
    value = _changed(getattr(config, name), rest) if rest else f"{getattr(config, name)} changed"
    return config.model_copy(update={name: value})


def _real_registry() -> Registry:
    registry = pytest.importorskip("stages.registry")
    return Registry(registry.LOOP, registry.FINISH)


@pytest.mark.parametrize("registry", [lambda: REGISTRY, _real_registry], ids=["toy", "real"])
def test_every_setting_enters_the_keys_of_exactly_the_stages_that_declare_it(registry: Any) -> None:
    config, stages = Config(), registry().stages
    before = {stage.name: canonical(subset(config, stage.config, stage.unkeyed)) for stage in stages}
    paths = [path for path in leaves(Config) if _is_leaf(path)]
    assert len(paths) > 50
    for path in paths:
        changed = _changed(config, path)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            after = {stage.name: canonical(subset(changed, stage.config, stage.unkeyed)) for stage in stages}
        differ = {name for name in before if before[name] != after[name]}
        declare = {
            s.name for s in stages
            if path not in s.unkeyed and any(path == c or path.startswith(f"{c}.") for c in s.config)
        }
        assert differ == declare, path


def test_a_moved_scene_keeps_its_key_and_a_changed_or_renamed_one_does_not(tmp_path: Path) -> None:
    stage = next(s for s in _real_registry().stages if s.name == "capture")

    def key(folder: Path, content: bytes) -> str:
        folder.mkdir(parents=True)
        (folder / "scene.glb").write_bytes(content)
        config = load_config(None, (f"scene.file={folder / 'scene.glb'}",), environ={})
        assert stage.parameters is not None
        return digest([subset(config, stage.config, stage.unkeyed), stage.parameters(config, {})])

    first = key(tmp_path / "here" / "flat", b"a")
    assert key(tmp_path / "there" / "flat", b"a") == first
    assert key(tmp_path / "elsewhere" / "flat", b"b") != first
    assert key(tmp_path / "there" / "house", b"a") != first


def test_an_unkeyed_setting_must_be_declared() -> None:
    with pytest.raises(UndeclaredConfigError, match=r"scene\.file"):
        subset(Config(), ("camera",), ("scene.file",))


def _is_leaf(path: str) -> bool:
    model: Any = Config
    for name in path.split("."):
        model = section_of(model.model_fields[name].annotation)
    return model is None


def test_seeds_differ_between_nodes_and_runs() -> None:
    nodes = [NodeId(stage, k) for stage in ("capture", "mapping") for k in (None, 0, 1, 2)]
    seeds = [node_seed(seed, node) for seed in (0, 1) for node in nodes]
    assert len(set(seeds)) == len(seeds)
    assert all(0 <= seed < 2**63 for seed in seeds)
    assert node_seed(0, NodeId("capture", 0)) == node_seed(0, NodeId("capture", 0))


_json = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False, allow_infinity=False) | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=3), inner, max_size=3), max_leaves=8,
)


@settings(max_examples=50, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(st.dictionaries(st.text(max_size=4), _json, max_size=4))
def test_canonical_json_does_not_depend_on_order(value: dict) -> None:
    turned = dict(reversed(list(value.items())))
    assert canonical(value) == canonical(turned)
    assert digest(value) == digest(turned)


def test_nan_has_no_key() -> None:
    with pytest.raises(ValueError, match="JSON"):
        canonical({"a": float("nan")})


def test_differences_name_added_and_dropped_inputs() -> None:
    old = {"inputs": {"a": "1", "b": "2"}, "version": 1}
    new = {"inputs": {"b": "3", "c": "4"}, "version": 2}
    assert differences(old, new) == [
        "stage version 1 -> 2", "input a is no input any more", "input b changed", "input c is a new input",
    ]
