"""Scenes that move: sharp G-buffers, stochastic streams, and exact motion-blurred references."""

from torchblur.render.renderer import (
    Reference,
    Renderer,
    render_frame,
    render_reference,
    render_stream,
)
from torchblur.render.scene import Scene, load_scene

__all__ = [
    "Reference",
    "Renderer",
    "Scene",
    "load_scene",
    "render_frame",
    "render_reference",
    "render_stream",
]
