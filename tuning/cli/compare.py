"""The command that measures images: `compare`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from tuning.cli.console import metrics_table, results
from tuning.cli.options import ConventionName, Overwrite

__all__ = ["compare"]


def compare(
    images: Annotated[
        list[Path],
        typer.Argument(metavar="IMAGE", help="EXR or PNG files, or sequences with ####."),
    ],
    reference: Annotated[
        Path, typer.Option(metavar="REF", help="Image with true motion blur; #### for sequences.")
    ],
    output: Annotated[
        Path | None,
        typer.Option("-o", "--output", metavar="HTML", help="Page with sliders and error maps."),
    ] = None,
    frame: Annotated[
        Path | None,
        typer.Option(
            metavar="SHARP", help="Sharp frame with velocity: adds the band at moving borders."
        ),
    ] = None,
    shutter: Annotated[
        float, typer.Option(metavar="S", help="Shutter of the reference, for the band.")
    ] = 0.5,
    convention: ConventionName = "auto",
    overwrite: Overwrite = False,
) -> None:
    """Measure how close images come to a reference: FLIP, PSNR and SSIM.

    Sequences (`out/####.exr --reference reference.####.exr`): means over the frames, the weighted
    median of FLIP, and the error of the change from frame to frame.
    """
    from torchblur.frame import Shutter
    from tuning.report.compare import compare_images, write_page
    from tuning.report.compare_sequences import compare_sequences, is_sequence

    named = [*images, reference, *([] if frame is None else [frame])]
    compared = compare_sequences if is_sequence(named) else compare_images
    found = compared(
        images, reference, frame=frame, convention=convention, shutter=Shutter(shutter)
    )
    frames = f", mean of {found.frames}" if found.frames else ""
    results.print(metrics_table(f"against {reference}{frames}; PSNR in dB, linear", found.scores))
    if output is not None:
        write_page(output, found, title=f"Against {reference.name}", overwrite=overwrite)
        results.print(f"page: {output}", soft_wrap=True)
