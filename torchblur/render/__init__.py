"""Scenes that move: sharp G-buffers, stochastic streams, and exact motion-blurred references."""

from torchblur.render.family import SceneFamily, draw_scene, load_family
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
    "SceneFamily",
    "draw_scene",
    "load_family",
    "load_scene",
    "render_frame",
    "render_reference",
    "render_revealed",
    "render_stream",
]
