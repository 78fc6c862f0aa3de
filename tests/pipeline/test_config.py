"""Configuration: layers, and messages that say where, what, and what was expected."""

from pathlib import Path

import pytest

from active3d_pipe.errors import ArtifactError, ConfigError
from active3d_pipe.pipeline.config import Config, load_config, load_run_config, resolve_toml, validate
from active3d_pipe.pipeline.layers import Layers, parse_value, preset_names, read_layers


@pytest.fixture
def write(tmp_path: Path):
    def write(text: str, name: str = "mine.toml") -> str:
        (tmp_path / name).write_text(text)
        return str(tmp_path / name)

    return write


def test_layers_from_weak_to_strong(write) -> None:
    file = write('preset = "demo"\n[run]\nsteps = 7\nseed = 7\nthreads = 1\n')
    environ = {"ACTIVE3D__RUN__SEED": "8", "ACTIVE3D__RUN__THREADS": "2", "ACTIVE3D_SCENES": "/elsewhere"}
    config = load_config(file, ["run.threads=3"], environ)
    assert (config.camera.width, config.run.steps, config.run.seed, config.run.threads) == (320, 7, 8, 3)
    assert config.camera.far == Config().camera.far


def test_every_preset_is_valid() -> None:
    assert {"default", "demo", "paper"} <= set(preset_names())
    for name in preset_names():
        load_config(name, environ={})


def test_a_file_may_be_named_like_a_preset_only_with_its_ending(write, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(Path(write("[run]\nsteps = 3\n", "demo.toml")).parent)
    assert load_config("demo.toml", environ={}).run.steps == 3
    assert load_config("demo", environ={}).run.steps != 3


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("3", 3), ("0.5", 0.5), ("true", True), ('"a b"', "a b"), ("free", "free"), ("a/b.glb", "a/b.glb"),
        ("[1, 2]", [1, 2]),
    ],
)
def test_set_values_are_toml_or_else_text(text: str, value: object) -> None:
    assert parse_value(text) == value


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("run.step=3", "run.step: unknown key (--set); did you mean 'run.steps'?"),
        ("mapping.windw.size=3", "mapping.windw: unknown key (--set); did you mean 'mapping.window'?"),
        ("steps=3", "steps: unknown key (--set); did you mean 'run.steps'?"),
        ("run.steps=many", 'run.steps = "many" (--set): expected a valid integer'),
        ("run.steps=0", "run.steps = 0 (--set): expected greater than or equal to 1"),
        ("run.steps=2.5", "run.steps = 2.5 (--set): expected a valid integer"),
        ("run.steps=", 'run.steps = "" (--set): expected a valid integer'),
        ("run=3", "run = 3 (--set): expected a table of settings"),
        ("motion.model=fly", "motion.model = \"fly\" (--set): expected 'free' or 'ground'"),
        ("camera.far=inf", "camera.far = Infinity (--set): expected a finite number"),
        ("run.keep.stages=[1]", "run.keep.stages = [1] (--set): expected a valid string"),
        ("run.steps", "--set run.steps: expected a.b=value, for example --set run.steps=400"),
        (".steps=3", "--set .steps=3: expected a.b=value, for example --set run.steps=400"),
        (
            "scene.unit_scale=-1",
            "scene.unit_scale = -1 (--set): expected 'auto' or greater than 0",
        ),
    ],
)
def test_messages(override: str, message: str) -> None:
    with pytest.raises(ConfigError) as caught:
        load_config(None, [override], {})
    assert str(caught.value) == message


def test_a_key_that_is_near_nothing_lists_what_is_known() -> None:
    with pytest.raises(ConfigError, match=r"run\.zzzzzz: unknown key \(--set\); known here: name, seed, steps"):
        load_config(None, ["run.zzzzzz=1"], {})


def test_every_problem_is_one_line_and_names_its_layer(write) -> None:
    file = write("[run]\nsteps = 'x'\n[camra]\nwidth = 3\n")
    with pytest.raises(ConfigError) as caught:
        load_config(file, ["run.seed=-1"], {"ACTIVE3D__RUN__THREADS": "none"})
    assert set(str(caught.value).splitlines()) == {
        f'run.steps = "x" ({file}): expected a valid integer',
        "run.seed = -1 (--set): expected greater than or equal to 0",
        'run.threads = "none" (ACTIVE3D__RUN__THREADS): expected a valid integer',
        f"camra: unknown key ({file}); did you mean 'camera'?",
    }


@pytest.mark.parametrize(
    ("base", "message"),
    [
        ("dmo", r"^'dmo' is neither a TOML file nor a preset; did you mean 'demo'\?; the presets are default, "),
        ("nowhere.toml", r"^nowhere\.toml: cannot be read: No such file or directory; expected a TOML file$"),
    ],
)
def test_a_missing_base(base: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        load_config(base, environ={})


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[run\n", r"mine\.toml: is not valid TOML: "),
        ("preset = 3\n", r"mine\.toml: preset = 3; expected the name of a preset"),
        ('preset = "mine.toml"\n', r"`preset` leads back to itself \(mine\.toml -> .*mine\.toml"),
    ],
)
def test_a_broken_file(write, monkeypatch: pytest.MonkeyPatch, text: str, message: str) -> None:
    monkeypatch.chdir(Path(write(text)).parent)
    with pytest.raises(ConfigError, match=message) as caught:
        load_config("mine.toml", environ={})
    assert "\n" not in str(caught.value)


def test_a_file_that_is_no_text(tmp_path: Path) -> None:
    (tmp_path / "mine.toml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ConfigError, match="is not valid TOML"):
        load_config(str(tmp_path / "mine.toml"), environ={})


def test_the_resolved_configuration_reads_back_the_same(tmp_path: Path) -> None:
    config = load_config("demo", ["scene.start_position=[1.0, 2.0, 1.5]", 'run.name="a \\"b\\" #c"'], {})
    (tmp_path / "run.toml").write_text(resolve_toml(config))
    assert load_run_config(tmp_path / "run.toml", Config) == config
    assert load_run_config(tmp_path / "run.toml", Config, ["run.steps=3"]).run.steps == 3


def test_settings_of_another_version_in_a_run(tmp_path: Path) -> None:
    file, said = tmp_path / "run.toml", []
    file.write_text("old = 1\n[run]\nsteps = 7\nstepz = 3\n[mapping.window]\nwidth = 3\n[gone]\na.b = 1\n")
    assert load_run_config(file, Config, warn=said.append).run.steps == 7
    assert said == [f"{file}: old, run.stepz, mapping.window.width, gone not known to this version, ignored"]
    with pytest.raises(ArtifactError, match=r"run\.stepz, .* not known to this version; go on with") as error:
        load_run_config(file, Config)
    assert "\n" not in str(error.value)
    with pytest.raises(ConfigError, match=r"did you mean 'run\.steps'"):
        load_run_config(file, Config, ["run.stepz=4"], said.append)


def test_a_value_may_replace_a_table_and_the_other_way_round() -> None:
    layers = Layers()
    layers.merge({"a": {"b": 1}, "c": 2}, "first")
    layers.merge({"a": 3, "c": {"d": 4}}, "second")
    assert layers.values == {"a": 3, "c": {"d": 4}}
    assert layers.source_of("c.d") == "second"


def test_a_relative_path_belongs_to_the_file_that_says_it(tmp_path: Path) -> None:
    (tmp_path / "deep").mkdir()
    (tmp_path / "deep/below.toml").write_text('[scene]\nfile = "room.glb"\n[planning]\ntrajectory = "walk"\n')
    (tmp_path / "top.toml").write_text('preset = "deep/below.toml"\n[planning]\ntrajectory = "other"\n')
    layers = read_layers(str(tmp_path / "top.toml"), environ={})
    assert layers.folder_of("scene.file") == tmp_path / "deep"
    assert layers.folder_of("planning.trajectory") == tmp_path
    assert read_layers(str(tmp_path / "top.toml"), ["scene.file=x.glb"], {}).folder_of("scene.file") is None


def test_the_name_of_the_file_is_kept(write) -> None:
    file = write('preset = "demo"\n', "my_room.toml")
    layers = read_layers(file, environ={})
    assert layers.name == "my_room" and layers.folder_of("scene.file") is None
    validate(layers, Config)
