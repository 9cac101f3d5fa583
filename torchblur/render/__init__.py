"""Procedural scenes that move, their sharp G-buffers, and exact motion-blurred references."""

from torchblur.render.renderer import Reference, Renderer, render_frame, render_reference
from torchblur.render.scene import Scene, load_scene

__all__ = ["Reference", "Renderer", "Scene", "load_scene", "render_frame", "render_reference"]
