"""What lies behind the objects in front: rays that go on until they meet another object."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal, NamedTuple, get_args

import torch
from torch import Tensor

from torchblur.errors import ConfigError
from torchblur.frame import Frame
from torchblur.ops.color import luma
from torchblur.render.renderer import Renderer
from torchblur.render.sampling import spread_positions
from torchblur.render.scene import Scene
from torchblur.render.surface import image_path, path_motion, pixel_centers
from torchblur.render.trace import CHUNK, Hit, Tracer

__all__ = ["Criterion", "Revealed", "render_revealed"]

Criterion = Literal["id", "luminance"]
"""What tells another object: its `object_id`, or, as in the paper, its luminance."""

_LAYERS = ("color", "depth", "velocity", "normal", "object_id")


@dataclass(frozen=True, kw_only=True, eq=False)
class Revealed:
    """What lies behind the objects in front.

    Args:
        frame: Color, depth, velocity, normal and object_id of what was found, and of the object
            in front where nothing was; `valid` says where something was.
        layers: Rays that went on from a hit, per pixel, int64, (1, 1, H, W); 0 outside the mask.
        rays: Rays traced through pixel centers: the first ones in the mask and those that went on.
        color_rays: Rays traced beside for the color's samples.
    """

    frame: Frame
    layers: Tensor
    rays: int
    color_rays: int

    @property
    def hit(self) -> Tensor:
        """Where another object was found, bool, (1, 1, H, W)."""
        return self.frame.require("valid")


@torch.no_grad()
def render_revealed(  # noqa: PLR0913 - all that the pass of the paper is told
    scene: Scene,
    size: tuple[int, int],
    *,
    frame: float = 0.0,
    mask: Tensor | None = None,
    by: Criterion = "id",
    threshold: float = 0.01,
    max_layers: int = 5,
    color_spp: int = 16,
    seed: int = 0,
) -> Revealed:
    """Render what lies behind the objects in front, only where a mask asks for it.

    A ray through a pixel's center goes on behind its first hit, along the same line and at the
    same time, until it meets another object, the sky included. The far side of the first object
    is not another one, and takes one of the `max_layers`.

    Args:
        scene: The scene.
        size: Height and width in px, each at least 1.
        frame: The time, in frames; any finite number.
        mask: Where to look, bool, (1, 1, H, W); everywhere if left out. All is computed on its
            device.
        by: "id": another object has another `object_id`. "luminance": its radiance at the hit,
            lit, has another luminance; so that on a textured object the ray may stop at its own
            far side, and behind an object of equal luminance nothing is found.
        threshold: With "luminance": the least difference of scene-linear luminance (Rec. 709)
            that counts, at least 0.
        max_layers: Rays that may go on from a hit, per pixel, at least 1.
        color_spp: Samples per pixel of the color, at least 1, spread over the pixel (box filter).
            1 takes its center. Of more there count those that go on from the same object as the
            center's ray does, and those that see what it found directly: the color is that of
            the pixel without the object in front.
        seed: Seed of the color's samples.

    Returns:
        The layers behind, and the number of rays. Outside the mask, and where nothing was found,
        the frame is that of `render_frame`.

    Raises:
        ConfigError: a bad size, time, mask, criterion or count.

    Differentiable: no.

    Reference: Tan 2022, section 3.2.2 (5 recursions, section 4). We differ: by id unless told,
        which the paper has for later; and the found color is averaged over the pixel.
    """
    _check(mask, by, threshold, max_layers)
    device = torch.device("cpu") if mask is None else mask.device
    front = Renderer(scene, device=device).frame(size, frame=frame, color_spp=color_spp, seed=seed)
    _check_size(mask, size)
    wanted = torch.ones_like(front.require("depth")).bool() if mask is None else mask
    tracer = Tracer(scene, frame, dtype=torch.float64, device=device)
    generator = torch.Generator().manual_seed(seed)
    shift = torch.rand((2, size[0] * size[1]), generator=generator).to(device)
    rule = _Rule(by, threshold, max_layers)
    parts = []
    for pixels in wanted.flatten().nonzero()[:, 0].split(CHUNK):
        x, y = (plane[pixels] for plane in pixel_centers(size, device))
        beam = _Beam(tracer, size, (x, y), rule)
        parts.append((pixels, beam, *_color(beam, color_spp, shift[:, pixels])))
    return Revealed(
        frame=_behind(front, parts),
        layers=_scattered(
            torch.zeros_like(wanted).long(), [(p, b.layers[None]) for p, b, *_ in parts]
        ),
        rays=sum(beam.rays for _, beam, *_ in parts),
        color_rays=sum(count for *_, count in parts),
    )


class _Rule(NamedTuple):
    """When a ray has met another object."""

    by: Criterion
    threshold: float
    max_layers: int

    def differs(self, tracer: Tracer, first: Hit, hit: Hit) -> Tensor:
        """Return where hits are of another object than the first ones, bool, (N,)."""
        if self.by == "id":
            return _ids(tracer, first) != _ids(tracer, hit)
        a, b = (luma(tracer.radiance(h)[None, :, None])[0, 0, 0] for h in (first, hit))
        return (a - b).abs() > self.threshold


class _Beam:
    """Camera rays that went on until they met another object.

    Args:
        tracer: The scene.
        size: Height and width of the image in px.
        at: x and y in the image, px, (N,) each.
        rule: When to stop.
    """

    def __init__(
        self, tracer: Tracer, size: tuple[int, int], at: tuple[Tensor, Tensor], rule: _Rule
    ) -> None:
        self.tracer, self.size, self.at, self.rule = tracer, size, at, rule
        self.now = torch.zeros_like(at[0])
        self.origins, self.directions = tracer.rays(size, *at, self.now)
        self.first = tracer.closest_hit(self.origins, self.directions, self.now)
        self.rays = len(self.now)
        self.hit = Hit(*(part.clone() for part in self.first))
        self.is_found = torch.zeros_like(self.now, dtype=torch.bool)
        self.layers = torch.zeros_like(self.now, dtype=torch.long)
        self._advance()

    def surface(self) -> dict[str, Tensor]:
        """Return depth, normal, object_id and velocity of what was found, (C, N) each."""
        path = image_path(
            self.tracer, self.size, (self.origins, self.directions), self.now, self.hit
        )
        velocity, _ = path_motion(path, self.now)
        return {
            "depth": self.hit.distance[None],
            "normal": self.hit.normal,
            "object_id": _ids(self.tracer, self.hit)[None],
            "velocity": velocity,
        }

    def _advance(self) -> None:
        distance = self.first.distance.clone()
        going = torch.isfinite(distance).nonzero()[:, 0]
        for _ in range(self.rule.max_layers):
            if not len(going):
                return
            origins, directions = self.origins[:, going], self.directions[:, going]
            # What is nearer than the tracer sees is skipped: the surface that the ray leaves.
            starts = origins + directions * distance[going]
            hit = self.tracer.closest_hit(starts, directions, self.now[going])
            self.rays += len(going)
            self.layers[going] += 1
            distance[going] += hit.distance
            first = Hit(*(part[..., going] for part in self.first))
            is_other = self.rule.differs(self.tracer, first, hit)
            other = going[is_other]
            self.is_found[other] = True
            self.hit.distance[other] = distance[other]
            for target, source in zip(self.hit[1:], hit[1:], strict=True):
                target[..., other] = source[..., is_other]
            going = going[~is_other & torch.isfinite(hit.distance)]


def _color(beam: _Beam, spp: int, shift: Tensor) -> tuple[Tensor, int]:
    """Return the mean color of what samples of the pixels find, (3, N), and the rays traced.

    Args:
        beam: Rays through the pixels' centers.
        spp: Samples per pixel; 1 is the center.
        shift: Random numbers per pixel, (2, N).
    """
    center = beam.tracer.radiance(beam.hit)
    if spp == 1:
        return center, 0
    total, count = torch.zeros_like(center), torch.zeros_like(beam.now)
    hidden, behind = (_ids(beam.tracer, hit) for hit in (beam.first, beam.hit))
    rays = 0
    for dx, dy in zip(*spread_positions(spp, shift), strict=True):
        at = (beam.at[0] - 0.5 + dx, beam.at[1] - 0.5 + dy)
        sample = _Beam(beam.tracer, beam.size, at, beam.rule)
        seen = _ids(beam.tracer, sample.first)
        is_past = (seen == hidden) & sample.is_found
        pairs = zip(sample.hit, sample.first, strict=True)
        shown = Hit(*(torch.where(is_past, past, direct) for past, direct in pairs))
        counts = is_past | ((seen == behind) & (seen != hidden))
        total += torch.where(counts, beam.tracer.radiance(shown), 0)
        count += counts
        rays += sample.rays
    return torch.where(count > 0, total / count.clamp(min=1), center), rays


def _behind(front: Frame, parts: list[tuple[Tensor, _Beam, Tensor, int]]) -> Frame:
    """Return the frame with what was found put over it."""
    images: dict[str, Any] = {"valid": torch.zeros_like(front.require("depth")).bool()}
    images |= {name: front.require(name) for name in _LAYERS}
    for pixels, beam, color, _ in parts:
        found = beam.is_found
        layers = beam.surface() | {"color": color, "valid": found[None]}
        for name, values in layers.items():
            images[name] = _scattered(images[name], [(pixels[found], values[:, found])])
    return Frame(**images)


def _scattered(image: Tensor, parts: list[tuple[Tensor, Tensor]]) -> Tensor:
    """Return an image of one with other values at some pixels: those, and (C, N) each."""
    flat = image.flatten(2).clone()
    for pixels, values in parts:
        flat[0, :, pixels] = values.to(image.dtype)
    return flat.view_as(image)


def _ids(tracer: Tracer, hit: Hit) -> Tensor:
    return tracer.object_ids[hit.body.long()]


def _check(mask: Tensor | None, by: str, threshold: float, max_layers: int) -> None:
    if mask is not None and mask.dtype != torch.bool:
        raise ConfigError(f"`mask` must be of type bool, got {mask.dtype}")
    if by not in get_args(Criterion):
        raise ConfigError(f"`by` must be 'id' or 'luminance', got {by!r}")
    if not threshold >= 0:
        raise ConfigError(f"`threshold` must be at least 0, got {threshold}")
    if isinstance(max_layers, bool) or not isinstance(max_layers, int) or max_layers < 1:
        raise ConfigError(f"`max_layers` must be an integer of at least 1, got {max_layers!r}")


def _check_size(mask: Tensor | None, size: tuple[int, int]) -> None:
    if mask is not None and tuple(mask.shape) != (1, 1, *size):
        raise ConfigError(
            f"`mask` must have shape {(1, 1, *size)} as `size` says, got {tuple(mask.shape)}"
        )
