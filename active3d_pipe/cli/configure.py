"""`config show`, `config schema`."""

import typer

from active3d_pipe.cli import console, session

app = typer.Typer(no_args_is_help=True, help="Show what can be configured.", rich_markup_mode=None)


@app.command()
def show(
    config: str = typer.Argument(None, help="A preset, a TOML file, or nothing for the defaults.", show_default=False),
    set_: list[str] = session.SET,
    json: bool = session.JSON,
) -> None:
    """The resolved configuration: every setting, its value, and what it means, as TOML."""
    from active3d_pipe.pipeline.config import load_config, resolve_toml

    resolved = load_config(config, set_)
    if json:
        console.out_json({"schema": "active3d.config/1", **resolved.model_dump(mode="json")})
    else:
        console.out(resolve_toml(resolved).rstrip())


@app.command()
def schema() -> None:
    """The JSON Schema of the configuration, for editors."""
    from active3d_pipe.pipeline.config import Config

    console.out_json(Config.model_json_schema())


@app.command()
def presets(json: bool = session.JSON) -> None:
    """Names of the presets."""
    from active3d_pipe.pipeline.layers import preset_names

    if json:
        console.out_json({"schema": "active3d.presets/1", "presets": preset_names()})
    else:
        console.out("\n".join(preset_names()))
