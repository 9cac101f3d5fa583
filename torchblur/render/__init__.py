"""Scenes that move: sharp G-buffers, stochastic streams, and exact motion-blurred references."""

from torchblur.render.renderer import (
    Reference,
    Renderer,
    render_frame,
    render_reference,
    render_stream,
)
from torchblur.render.revealed import Revealed, render_revealed
from torchblur.render.scene import Scene, load_scene

__all__ = [
    "Reference",
    "Renderer",
    "Revealed",
    "Scene",
    "load_scene",
    "render_frame",
    "render_reference",
    "render_revealed",
    "render_stream",
]
