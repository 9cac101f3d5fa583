"""The command that renders scenes, and scenes of families: `render`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from tuning.cli.console import results, show_progress, stoppable
from tuning.cli.options import NoCompile, Overwrite

__all__ = ["render"]


def render(  # noqa: PLR0913 - each argument is an option
    scene: Annotated[
        str,
        typer.Argument(
            metavar="SCENE",
            help="File of a scene or family, or a name in configs/scenes or configs/families.",
        ),
    ],
    output: Annotated[
        Path, typer.Option("-o", "--output", metavar="DIR", help="Folder for the files.")
    ],
    size: Annotated[str, typer.Option(metavar="WxH", help="Size in px.")] = "640x360",
    of: Annotated[
        str | None,
        typer.Option(metavar="WxH", help="Render a window of an image of this size, in px."),
    ] = None,
    at: Annotated[
        str | None,
        typer.Option(
            metavar="X,Y",
            help="Middle of the window, in shares of that image, or motion: where most moves. "
            "Default: 0.5,0.5; of a family: motion.",
        ),
    ] = None,
    spp: Annotated[int, typer.Option(metavar="N", help="Samples per pixel of references.")] = 256,
    frames: Annotated[int, typer.Option(metavar="N", help="Number of frames.")] = 1,
    shutter: Annotated[
        float, typer.Option(metavar="S", help="Open time as a fraction of a frame.")
    ] = 0.5,
    seed: Annotated[
        int, typer.Option(metavar="N", help="Seed of the random samples; of a family, which scene.")
    ] = 0,
    scenes: Annotated[
        int | None,
        typer.Option(metavar="N", min=1, help="Of a family: number of scenes. Default: 1."),
    ] = None,
    start: Annotated[float, typer.Option(metavar="T", help="Time of the first frame.")] = 0.0,
    stream: Annotated[
        bool, typer.Option("--stream", help="Also stream.####.exr: each pixel at a random time.")
    ] = False,
    stream_spp: Annotated[
        int | None, typer.Option(metavar="N", help="Samples per pixel of the stream. Default: 1.")
    ] = None,
    point_sampled: Annotated[
        bool,
        typer.Option(
            "--point-sampled",
            help="Also reference_pointsampled.####.exr: what the stream converges to.",
        ),
    ] = False,
    overwrite: Overwrite = False,
    no_compile: NoCompile = False,
) -> None:
    """Render a procedural scene: sharp frames with all layers, and references beside them.

    Files that are done are kept, so a stopped run goes on when started again. Several samples per
    pixel of a stream are files of their own: stream01.####.exr, stream02.####.exr … Each scene of
    a family goes to a folder of its own, with the scene as YAML.
    """
    from tuning.render.family import render_file
    from tuning.render.scene import find_scene, settings_of

    settings = settings_of(
        size,
        of=of,
        at=at,
        spp=spp,
        frames=frames,
        start=start,
        shutter=shutter,
        seed=seed,
        stream_spp=(1 if stream else 0) if stream_spp is None else stream_spp,
        point_sampled=point_sampled,
    )
    with stoppable(), show_progress() as progress:
        files = render_file(
            find_scene(scene),
            output,
            settings,
            scenes=scenes,
            overwrite=overwrite,
            progress=progress,
        )
    first, last = (file.relative_to(output) for file in (files[0], files[-1]))
    results.print(f"{len(files)} files in {output}: {first} to {last}")
