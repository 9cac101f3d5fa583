"""The commands that look: at the parameters of filters (`params`), into a file (`inspect`)."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from tuning.cli.options import ConventionName

__all__ = ["inspect", "params"]


def params(
    filter_name: Annotated[
        str | None, typer.Argument(metavar="[FILTER]", help="Name of a filter. Default: all.")
    ] = None,
    json_schema: Annotated[
        bool, typer.Option("--json-schema", help="Print a JSON Schema for editors instead.")
    ] = False,
) -> None:
    """List the parameters of a filter: default, range, unit, gradient class, source, meaning."""
    from tuning.cli.printing import print_parameters, schema_text

    if json_schema:
        typer.echo(schema_text(filter_name))
    else:
        print_parameters(filter_name)


def inspect(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="EXR file.")],
    reference: Annotated[
        Path | None,
        typer.Option(
            metavar="REF", help="The frame with motion blur: checks the velocity's signs."
        ),
    ] = None,
    convention: ConventionName = "auto",
) -> None:
    """Show what is in a file, how it would be read, and what looks wrong."""
    from torchblur.io import inspect_file
    from tuning.cli.printing import print_inspection

    print_inspection(inspect_file(file, reference, convention=convention))
