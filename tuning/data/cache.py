"""Rendered frames on disk: made once, found again by everything that they depend on."""

from __future__ import annotations

import hashlib
import json
import uuid
import warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from torchblur.frame import Frame
from torchblur.ops.compiling import cache_folder
from torchblur.render import load_scene
from tuning.files.source import source_hash

__all__ = ["cache_key", "cached", "frame_of", "hash_scene", "planes_of"]


def cached(key: str, make: Callable[[], dict[str, Tensor]]) -> dict[str, Tensor]:
    """Return tensors from the cache, or make them and keep them there.

    Args:
        key: What `cache_key` returned.
        make: Makes them.
    """
    path = cache_folder() / "frames" / f"{key}.pt"
    if path.is_file():
        try:
            stored: dict[str, Tensor] = torch.load(path, weights_only=True)
            return stored
        except Exception as error:
            warnings.warn(f"{path} cannot be read ({error}); rendering again", stacklevel=2)
    tensors = {name: tensor.contiguous() for name, tensor in make().items()}
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        # Another machine may have a process of the same number, and the same cache.
        temporary = path.with_name(f".{path.name}.{uuid.uuid4().hex}.part")
        torch.save(tensors, temporary)
        temporary.replace(path)
    except OSError as error:
        warnings.warn(f"rendered frames are not kept: {error}", stacklevel=2)
    return tensors


def cache_key(scene_key: str, settings: Mapping[str, Any], time: float) -> str:
    """Return a name for a frame: of its scene, its settings, and the renderer's source.

    Args:
        scene_key: What `hash_scene` returned.
        settings: All that the renderer is told, as plain data.
        time: The frame's time.
    """
    # Families are left out: what they draw is a scene, which has a hash of its own.
    renderer = source_hash("render", without="family")
    parts = [scene_key, json.dumps(settings, sort_keys=True), repr(time), renderer]
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()[:32]


def hash_scene(path: Path) -> str:
    """Return the hash of a scene file and of the files that it names."""
    return load_scene(path).fingerprint()


def planes_of(frame: Frame, prefix: str) -> dict[str, Tensor]:
    """Return the layers of a frame under names that begin with a prefix, to be kept."""
    return {f"{prefix}.{name}": layer for name, layer in frame.layers().items()}


def frame_of(tensors: Mapping[str, Tensor], prefix: str, source: str) -> Frame:
    """Return the frame whose layers `planes_of` named.

    Args:
        tensors: What `cached` returned.
        prefix: As it was given to `planes_of`.
        source: Name of the frame for messages.
    """
    layers: dict[str, Any] = {
        name.removeprefix(f"{prefix}."): tensor
        for name, tensor in tensors.items()
        if name.startswith(f"{prefix}.")
    }
    return Frame(**layers, source=source)
