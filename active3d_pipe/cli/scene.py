"""`scene check`, `scene make`."""

from pathlib import Path

import typer

from active3d_pipe.cli import console, session

app = typer.Typer(no_args_is_help=True, help="Check or make a scene.", rich_markup_mode=None)


@app.command()
def check(
    file: str = typer.Argument(..., help="Scene: .glb, .gltf, .obj, .ply, or a name.", show_default=False),
    out: Path = typer.Option(None, "--out", help="Folder for pictures.", show_default=False),
    set_: list[str] = session.SET,
    json: bool = session.JSON,
) -> None:
    """Say how a scene is understood: size, up axis, units, bounds, start pose; with pictures."""
    from active3d_pipe.pipeline.layers import read_layers

    layers = read_layers(None, set_)
    session.use_threads(layers)

    from active3d_pipe.cli.scene_files import resolve
    from active3d_pipe.pipeline.config import Config, validate
    from active3d_pipe.sim.check import check_scene

    config = validate(layers, Config)
    settings = config.scene
    settings = type(settings).model_validate({**settings.model_dump(), "file": str(resolve(file))})
    found = check_scene(settings, config.camera, config.motion.agent_radius_m)
    pictures: list[str] = []
    if out is not None:
        pictures = _write_pictures(out, found.pictures)
    if json:
        console.out_json({"schema": "active3d.scene/1", **found.summary, "pictures": pictures})
        return
    console.out(console.table(console.flat_notes(found.summary)))
    for name in pictures:
        console.out(name)


@app.command()
def make(
    rooms: int = typer.Option(2, "--rooms", help="Number of rooms, 1 to 8."),
    seed: int = typer.Option(0, "--seed", help="Seed; the same seed makes the same apartment."),
    out: Path = typer.Option(..., "--out", help="GLB file to write.", show_default=False),
    detail: float = typer.Option(1.0, "--detail", help="Amount of geometry and texture; 0.3 is light."),
    json: bool = session.JSON,
) -> None:
    """Make a furnished, textured apartment; scene.json goes beside it."""
    from active3d_pipe.cli.scene_files import write_apartment
    from active3d_pipe.errors import ConfigError

    if out.suffix.lower() != ".glb":
        raise ConfigError(f"--out {out}: expected a name that ends in .glb")
    metadata = write_apartment(rooms, seed, out, detail)
    if json:
        console.out_json({"schema": "active3d.apartment/1", **metadata, "file": str(out)})
    else:
        extent = " x ".join(f"{v:.1f}" for v in metadata["extent_m"])
        console.out(f"{out}: {rooms} rooms, {extent} m, {metadata['triangles']} triangles")


def _write_pictures(folder: Path, pictures: dict) -> list[str]:
    """Write name -> (H, W, 3) uint8 as PNG files."""
    from PIL import Image

    from active3d_pipe.pipeline.files import writing

    names = []
    with writing(folder):
        folder.mkdir(parents=True, exist_ok=True)
        for name, picture in pictures.items():
            path = folder / f"{name}.png"
            Image.fromarray(picture).save(path)
            names.append(str(path))
    return names


