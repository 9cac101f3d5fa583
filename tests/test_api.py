"""The public names and their signatures are those that are written down in api_snapshot.txt.

`python tests/test_api.py` writes them anew.
"""

import difflib
import importlib
import inspect
import pkgutil
import re
from collections.abc import Collection, Iterable, Iterator
from itertools import takewhile
from pathlib import Path
from types import ModuleType
from typing import Any, ForwardRef, Literal, get_args, get_origin

from pydantic import BaseModel

SNAPSHOT = Path(__file__).with_name("api_snapshot.txt")
UPDATE = "python tests/test_api.py"
PACKAGES = (
    "torchblur",
    *(f"torchblur.{n}" for n in "filters io metrics render post export ops".split()),
)


class _Bare(str):
    """An annotation as the source has it; `inspect` would put quotes around it."""

    __slots__ = ()
    __repr__ = str.__str__


def snapshot() -> str:
    """Return a section for each public module, and in it a line for each name."""
    modules = [m for name in PACKAGES for m in _public(importlib.import_module(name))]
    seen: dict[tuple[str, int], str] = {}  # where each was listed first
    public = {getattr(module, name) for module in modules for name in _classes(module)}
    sections = []
    for module in modules:
        lines = [f"[{module.__name__}]"]
        for name in sorted(module.__all__):
            value = getattr(module, name)
            first = seen.setdefault((name, id(value)), module.__name__)
            again = first != module.__name__
            lines += [f"{name}: {first}"] if again else _lines(name, value, public)
        sections.append("\n".join(lines))
    return "\n\n".join(sections) + "\n"


def _public(package: ModuleType) -> Iterator[ModuleType]:
    """Yield the package; its modules, if it names nothing itself."""
    if hasattr(package, "__all__"):
        yield package
        return
    for info in pkgutil.iter_modules(package.__path__, f"{package.__name__}."):
        module = importlib.import_module(info.name)
        if hasattr(module, "__all__"):
            yield module


def _classes(module: ModuleType) -> list[str]:
    return [name for name in module.__all__ if inspect.isclass(getattr(module, name))]


def _lines(name: str, value: Any, public: Collection[type]) -> list[str]:
    if get_origin(value) is Literal:
        return [f"{name} = Literal[{', '.join(map(repr, get_args(value)))}]"]
    if get_origin(value) is not None:
        return [f"{name}: alias of a type"]
    if inspect.isclass(value):
        bases = ", ".join(base.__name__ for base in value.__bases__)
        parents = takewhile(lambda c: _ours(c) and c not in public, value.__mro__[1:])
        return [f"class {name}({bases})", *_members(value, parents)]
    if inspect.isroutine(value):
        return [f"def {name}{_signature(value)}"]
    return [f"{name}: {type(value).__name__}"]


def _ours(cls: type) -> bool:
    return cls.__module__.startswith("torchblur")


def _members(cls: type, parents: Iterable[type]) -> list[str]:
    """Return the public parts of a class, its own and those of parents that no section has."""
    lines = []
    if issubclass(cls, BaseModel):
        own = {k: v for k, v in inspect.get_annotations(cls).items() if k in cls.model_fields}
        lines = [f"    {key}: {_without_param(str(kind))}" for key, kind in own.items()]
    elif maker := vars(cls).get("__init__") or vars(cls).get("__new__"):
        lines = [f"    def __init__{_signature(maker)}"]
    parts = {key: part for c in (*reversed([*parents]), cls) for key, part in vars(c).items()}
    for key, part in sorted(parts.items()):
        if key.startswith(("_", "model_")):
            continue
        if isinstance(part, property):
            lines.append(f"    {key}: property")
        elif isinstance(part, (classmethod, staticmethod)):
            lines.append(f"    {type(part).__name__} {key}{_signature(part.__func__)}")
        elif inspect.isfunction(part):
            lines.append(f"    def {key}{_signature(part)}")
    return lines


def _without_param(kind: str) -> str:
    """Return the type that an annotation has beside its declaration."""
    return re.sub(r"^Annotated\[(.+?), (Param|AfterValidator|Field)\(.*", r"\1", kind, flags=re.S)


def _signature(function: Any) -> str:
    signature = inspect.signature(function)
    parts = [
        part.replace(annotation=_bare(part.annotation)) for part in signature.parameters.values()
    ]
    returned = _bare(signature.return_annotation)
    return str(signature.replace(parameters=parts, return_annotation=returned))


def _bare(annotation: Any) -> Any:
    if isinstance(annotation, ForwardRef):
        annotation = annotation.__forward_arg__
    return _Bare(annotation) if isinstance(annotation, str) else annotation


def test_public_names_and_signatures_are_those_written_down():
    old, new = SNAPSHOT.read_text().splitlines(), snapshot().splitlines()
    changes = "\n".join(difflib.unified_diff(old, new, "written down", "now", lineterm="", n=1))
    assert not changes, (
        f"public names have changed:\n{changes}\n"
        f"If that is meant (docs/stability.md, CHANGELOG.md): {UPDATE}"
    )


def test_the_snapshot_is_the_same_on_every_machine():
    text = snapshot()
    assert " at 0x" not in text
    assert str(Path.home()) not in text


if __name__ == "__main__":
    SNAPSHOT.write_text(snapshot())
