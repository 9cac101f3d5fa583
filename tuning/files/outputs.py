"""Which files go in, under which names the results go out, and which of them are done."""

from __future__ import annotations

import re
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any, Literal

from torchblur.errors import ConfigError, FileFormatError, OutputError, nearest_name
from torchblur.io import find_frames
from tuning.files.images import IMAGE_TYPES, read_metadata

__all__ = [
    "Job",
    "State",
    "drop_results",
    "find_inputs",
    "made_by",
    "make_folders",
    "name_outputs",
    "newest_of",
    "number_of",
    "numbered",
    "refuse_existing",
    "remove_leftovers",
    "state_of",
]

State = Literal["to do", "done", "out of date", "other"]

_NUMBERED = re.compile(r"^(?P<name>.*?)(?P<separator>[._-]?)(?P<number>\d+)$")
_HASHES = re.compile(r"#+")
_WILD = re.compile(r"[*?\[]")
_COMPANION = re.compile(r"^(gbuffer|reference|revealed|stream)", re.IGNORECASE)
_MAGIC = (b"\x76\x2f\x31\x01", b"\x89PNG\r\n\x1a\n")  # of EXR and PNG
_LEFTOVER_AGE = 600.0  # seconds: a younger one may be in another process's hands
_FIELDS = ("name", "stem", "folder")


@dataclass(frozen=True)
class Job:
    """One frame that is to be filtered.

    Args:
        source: The sharp frame.
        output: The image to be written.
        gbuffer: A second file with all layers but the color.
        samples: Files with more samples of the same pixels.
    """

    source: Path
    output: Path
    gbuffer: Path | None = None
    samples: tuple[Path, ...] = ()

    @property
    def sources(self) -> tuple[Path, ...]:
        """All files that are read."""
        gbuffer = () if self.gbuffer is None else (self.gbuffer,)
        return (self.source, *gbuffer, *self.samples)


# -- inputs ------------------------------------------------------------------------------------


def find_inputs(patterns: Iterable[str | Path], root: Path | None = None) -> list[Path]:
    """Return the files that patterns name, in the order of their frame numbers, each once.

    Args:
        patterns: Files; folders; or patterns with ``#`` for digits and ``*``, ``?``, ``[ab]`` and
            ``**`` as in a shell. In folders and for wildcards the companions of a frame
            (`gbuffer`, `reference`, `revealed`, `stream`) are left out.
        root: What relative patterns are relative to; the working folder if left out.

    Raises:
        FileFormatError: a pattern fits no file.
    """
    root = Path() if root is None else root
    return list(dict.fromkeys(path for p in patterns for path in _expand(root / p)))


def _expand(place: Path) -> list[Path]:
    wild_folder = _WILD.search(str(place.parent)) or _HASHES.search(str(place.parent))
    if place.is_file() or not (wild_folder or _WILD.search(place.name)):
        return [files.path for files in find_frames(place)]
    anchor = Path(place.anchor)
    relative = place.relative_to(anchor)
    digits = _HASHES.sub("*", str(relative))
    found = [path for path in anchor.glob(digits) if _fits(place.name, path.name)]
    if not found:
        raise FileFormatError(f"no file fits {place}; {_near(place)}")
    return sorted(found, key=_natural)


def _fits(pattern: str, name: str) -> bool:
    """Whether the # of a pattern stand for digits, and the file is no companion by accident."""
    if _COMPANION.match(name) and not _COMPANION.match(pattern):
        return False
    if not _HASHES.search(pattern):
        return not name.startswith(".")
    parts = [re.escape(part) for part in _HASHES.split(pattern)]
    expression = r"\d+".join(part.replace(r"\*", ".*").replace(r"\?", ".") for part in parts)
    return re.fullmatch(expression, name) is not None


def _natural(path: Path) -> list[tuple[int, int | str]]:
    parts = re.split(r"(\d+)", str(path))
    return [(0, int(part)) if part.isdigit() else (1, part) for part in parts]


def _near(place: Path) -> str:
    folder = place.parent
    while not folder.is_dir():
        folder = folder.parent
    names = sorted(entry.name for entry in folder.iterdir() if entry.name[0] != ".")
    if not names:
        return f"the folder {folder} is empty"
    more = f" and {len(names) - 5} more" if len(names) > 5 else ""
    return f"the folder {folder} holds {', '.join(names[:5])}{more}"


# -- outputs -----------------------------------------------------------------------------------


def name_outputs(
    sources: Sequence[Path], pattern: str, root: Path | None = None
) -> list[tuple[Path, Path]]:
    """Return each input with the file that its result goes to.

    Args:
        sources: The inputs.
        pattern: A file; a folder (then the results keep the names of the inputs, as `.exr`); or a
            pattern with ``####`` for the frame number, ``{name}`` for the input's name without
            it, ``{stem}`` for all of its name and ``{folder}`` for its folder below `root`.
        root: What `{folder}` and a relative pattern are relative to; the working folder if left
            out.

    Raises:
        ConfigError: unknown placeholder, or an input without a frame number.
        OutputError: not an image's ending, two inputs with one output, or a result that would
            replace an input.
    """
    root = Path() if root is None else root
    pairs = [(source, root / _named(pattern, source, root)) for source in sources]
    return _without_collisions(pairs)


def drop_results(pairs: Sequence[tuple[Path, Path]]) -> list[tuple[Path, Path]]:
    """Leave out inputs that are results of other inputs: a wildcard finds them on a second run."""
    made = {output.resolve() for source, output in pairs if source.resolve() != output.resolve()}
    return [(source, output) for source, output in pairs if source.resolve() not in made]


def number_of(path: Path) -> str | None:
    """Return the digits of a frame number at the end of a name, or None."""
    match = _NUMBERED.match(path.stem)
    return match["number"] if match else None


def numbered(pattern: str, source: Path) -> str:
    """Replace ``####`` in a pattern by the frame number of a file, padded to as many digits.

    Raises:
        ConfigError: if the file's name has no number.
    """
    if not _HASHES.search(pattern):
        return pattern
    number = number_of(source)
    if number is None:
        raise ConfigError(f"{pattern} needs a frame number, and {source.name} has none")
    return _HASHES.sub(lambda match: f"{int(number):0{len(match[0])}d}", pattern)


def _named(pattern: str, source: Path, root: Path) -> str:
    path = Path(pattern)
    if pattern.endswith(("/", "\\")) or not path.suffix or (root / path).is_dir():
        return str(Path(_filled(pattern, source, root)) / f"{source.stem}.exr")
    if path.suffix.lower() not in IMAGE_TYPES:
        raise OutputError(f"{pattern} must end in {' or '.join(IMAGE_TYPES)}, or be a folder")
    return numbered(_filled(pattern, source, root), source)


def _filled(pattern: str, source: Path, root: Path) -> str:
    match = _NUMBERED.match(source.stem)
    folder = source.parent
    if folder.is_relative_to(root):
        folder = folder.relative_to(root)
    values = {
        "name": match["name"] if match else source.stem,
        "stem": source.stem,
        "folder": folder.name if folder.is_absolute() else str(folder),
    }
    for field in re.findall(r"{(.*?)}", pattern):
        if field not in values:
            hint = nearest_name(field, _FIELDS) or f"; there are {', '.join(_FIELDS)}"
            raise ConfigError(f"unknown placeholder `{{{field}}}` in {pattern}{hint}")
        pattern = pattern.replace(f"{{{field}}}", values[field])
    return pattern


def _without_collisions(pairs: list[tuple[Path, Path]]) -> list[tuple[Path, Path]]:
    pairs = drop_results(pairs)
    sources = {source.resolve() for source, _ in pairs}
    by_output: dict[Path, Path] = {}
    for source, output in pairs:
        if output.resolve() in sources:
            raise OutputError(f"the result {output} would replace an input; choose another name")
        other = by_output.setdefault(output.resolve(), source)
        if other != source:
            raise OutputError(
                f"{other} and {source} would both be written to {output}; tell them apart by "
                "####, {name} or {folder}"
            )
    return pairs


# -- what is there already ---------------------------------------------------------------------


def made_by(recipe: Mapping[str, Any], source: Path, shot: str | None = None) -> dict[str, Any]:
    """Return the metadata of a result: what it was made with and from.

    Args:
        recipe: All settings that the pixels depend on, as plain data.
        source: The input.
        shot: Name of the first frame of its shot, if the frames before it matter.
    """
    made = {"torchblur": version("torchblur"), "recipe": dict(recipe), "source": source.name}
    return made if shot is None else made | {"shot": shot}


def state_of(
    output: Path, sources: Sequence[Path], recipe: Mapping[str, Any], shot: str | None = None
) -> State:
    """Return whether a result is still to be made.

    Args:
        output: Its file.
        sources: The files that it is made from.
        recipe: What `made_by` was given.
        shot: The same.

    Returns:
        "to do": not there, or an image cut short. "done": made with this recipe, and newer
        than its inputs. "out of date": made with this recipe from inputs that have changed since,
        or with another beginning of its shot.
        "other": made with other settings or by another program; only the user may replace it.
    """
    if not output.exists():
        return "to do"
    try:
        found = read_metadata(output)
    except FileFormatError:
        return "to do" if _begins_as_image(output) else "other"
    if found.get("recipe") != dict(recipe):
        return "other"
    is_older = newest_of(sources) > output.stat().st_mtime
    return "out of date" if is_older or found.get("shot") != shot else "done"


def newest_of(paths: Iterable[Path]) -> float:
    """Return when the youngest of some files was changed; 0 if none is there."""
    return max((path.stat().st_mtime for path in paths if path.exists()), default=0.0)


def _begins_as_image(path: Path) -> bool:
    """Whether a file is an image that was cut short: an empty one is as well."""
    if not path.is_file():
        return False
    with path.open("rb") as file:
        head = file.read(8)
    return any(head[: len(magic)] == magic[: len(head)] for magic in _MAGIC)


def refuse_existing(outputs: Iterable[Path], *, overwrite: bool = False) -> None:
    """Refuse to replace a file, before the work that leads to it.

    Raises:
        OutputError: one of them exists, and `overwrite` is off.
    """
    for output in outputs:
        if output.exists() and not overwrite:
            raise OutputError(f"{output} exists; overwrite=True (--overwrite) replaces it")


def make_folders(outputs: Iterable[Path]) -> None:
    """Make the folders of results.

    Raises:
        OutputError: if one cannot be made or written to.
    """
    for folder in dict.fromkeys(output.parent for output in outputs):
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise OutputError(f"cannot make the folder {folder}: {error.strerror}") from error


def remove_leftovers(outputs: Sequence[Path]) -> None:
    """Remove temporary files that a killed run has left beside its results."""
    oldest = time.time() - _LEFTOVER_AGE
    wanted = {output.name for output in outputs}
    for folder in {output.parent for output in outputs}:
        for path in folder.glob(".*.part"):
            name = path.name[1:].rpartition(".part")[0].rpartition(".")[0]
            if name in wanted and path.stat().st_mtime < oldest:
                path.unlink(missing_ok=True)
