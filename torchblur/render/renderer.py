"""Sharp G-buffers and motion-blurred references of a scene.

Both come from the same rays. The G-buffer is computed in float64 and eagerly; its motion vectors
are the derivative of where a surface point appears, through the transforms of body and camera.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchblur.errors import ConfigError
from torchblur.frame import Frame, Shutter
from torchblur.render.camera import project
from torchblur.render.compiling import Engine, check_engine
from torchblur.render.motion import into, place
from torchblur.render.scene import Scene
from torchblur.render.trace import CHUNK, Hit, Tracer
from torchblur.render.vectors import Vec

__all__ = ["Reference", "Renderer", "render_frame", "render_reference"]

_WORTH_COMPILING = 1e8  # rays times bodies: half a minute of eager work on one core
_STEP_X, _STEP_Y = 0.7548776662466927, 0.5698402909980532  # R2 sequence: 1/p, 1/p², p³ = p + 1


@dataclass(frozen=True, kw_only=True, eq=False)
class Reference:
    """A motion-blurred image that knows its own error.

    Args:
        mean: Scene-linear radiance, (1, 3, H, W).
        variance: Variance of that mean, (1, 3, H, W), from differences between neighboring
            strata. It is conservative: on average the true variance or more (2 to 3 times it in
            our scenes). +inf where spp is 1, which tells nothing.
        spp: Samples per pixel.
    """

    mean: Tensor
    variance: Tensor
    spp: int


class Renderer:
    """Renders one scene; `render_frame` and `render_reference` with more choice.

    Args:
        scene: The scene.
        engine: "compiled", "eager", or "auto": compile what is large enough to gain by it.
            Without a compiler "compiled" is "eager" with one warning.
        device: Where to compute; results are there too. Random numbers come from the CPU, so
            that a seed means the same on all devices.

    Raises:
        ConfigError: if the engine has another name.
    """

    def __init__(
        self, scene: Scene, *, engine: Engine = "auto", device: torch.device | str = "cpu"
    ) -> None:
        check_engine(engine)
        self.scene = scene
        self.engine = engine
        self.device = torch.device(device)
        self._num_bodies = len(scene.placed_bodies())

    @torch.no_grad()
    def frame(
        self, size: tuple[int, int], *, frame: float = 0.0, color_spp: int = 16, seed: int = 0
    ) -> Frame:
        """Return the sharp frame; see `render_frame`."""
        _check(size, color_spp, "color_spp", frame)
        tracer = Tracer(self.scene, frame, dtype=torch.float64, device=self.device)
        x, y = _pixel_centers(size, self.device)
        layers = _surface_layers(tracer, size, x, y)
        if color_spp == 1:
            color = tracer.image(size, x, y, torch.zeros_like(x))
        else:
            color, _ = self._sampled(size, color_spp, (0.0, 0.0), frame, seed)
        images = {name: _image(layer, size) for name, layer in layers.items()}
        return Frame(
            color=_image(color, size),
            velocity=images["velocity"],
            depth=images["depth"],
            normal=images["normal"],
            object_id=images["object_id"].long(),
            acceleration=images["acceleration"],
        )

    @torch.no_grad()
    def reference(
        self,
        size: tuple[int, int],
        *,
        spp: int = 256,
        shutter: Shutter | None = None,
        frame: float = 0.0,
        seed: int = 0,
    ) -> Reference:
        """Return the motion-blurred reference; see `render_reference`."""
        _check(size, spp, "spp", frame)
        interval = (shutter or Shutter()).interval
        mean, variance = self._sampled(size, spp, interval, frame, seed)
        return Reference(mean=_image(mean, size), variance=_image(variance, size), spp=spp)

    def _sampled(
        self,
        size: tuple[int, int],
        spp: int,
        interval: tuple[float, float],
        frame: float,
        seed: int,
    ) -> tuple[Tensor, Tensor]:
        """Return mean and variance of the mean, (3, H*W) each."""
        height, width = size
        work = height * width * spp * self._num_bodies
        compiled = self.engine == "compiled" or (self.engine == "auto" and work > _WORTH_COMPILING)
        tracer = Tracer(self.scene, frame, device=self.device, compiled=compiled)
        generator = torch.Generator().manual_seed(seed)
        block = max(1, CHUNK // spp)
        means, variances = [], []
        for first in range(0, height * width, block):
            pixels = torch.arange(first, min(first + block, height * width))
            samples = _samples(pixels, width, spp, interval, generator)
            x, y, times = (plane.flatten().to(self.device) for plane in samples)
            radiance = tracer.image(size, x, y, times).view(3, spp, -1)
            means.append(radiance.mean(1))
            variances.append(_variance_of_mean(radiance))
        return torch.cat(means, 1), torch.cat(variances, 1)


def render_frame(
    scene: Scene, size: tuple[int, int], *, frame: float = 0.0, color_spp: int = 16, seed: int = 0
) -> Frame:
    """Render the sharp G-buffer of a scene at one time.

    Args:
        scene: The scene.
        size: Height and width in px, each at least 1.
        frame: The time, in frames; any finite number.
        color_spp: Samples per pixel of the color, at least 1, spread over the pixel's area (box
            filter). 1 takes the pixel's center, as all other layers do.
        seed: Seed of the color's samples.

    Returns:
        A frame of one with `color`, planar `depth` (+inf for the sky), `normal` (in the world,
        facing the camera; 0 for the sky), `object_id` (0 for the sky), and `velocity` and
        `acceleration`: the first and second derivative, at the frame's time, of where the point
        seen at the pixel's center appears, px/frame and px/frame². The sky is fixed to the world
        and moves as the camera turns.

    Raises:
        ConfigError: a bad size, number of samples or time.

    Differentiable: no.

    Reference: the G-buffer that Guertin 2014 (section 3) and McGuire 2012 filter. We differ:
        velocity is the derivative, not the difference of two frames.
    """
    return Renderer(scene).frame(size, frame=frame, color_spp=color_spp, seed=seed)


def render_reference(
    scene: Scene,
    size: tuple[int, int],
    *,
    spp: int = 256,
    shutter: Shutter | None = None,
    frame: float = 0.0,
    seed: int = 0,
) -> Reference:
    """Render what a camera with an open shutter sees: the mean over the shutter and the pixel.

    Each pixel divides the shutter into `spp` equal strata and takes one random time in each; its
    positions in the pixel (box filter) are an R2 sequence with a random shift of its own. The
    estimate is unbiased, and its error falls faster than ``spp ** -0.5``.

    Args:
        scene: The scene.
        size: Height and width in px, each at least 1.
        spp: Samples per pixel, at least 1.
        shutter: When the shutter is open around `frame`; half a frame, centered, if left out.
        frame: The time, in frames; any finite number.
        seed: Same seed, same bits (on one machine with one engine); another seed gives an
            independent image.

    Returns:
        Mean and variance of the mean.

    Raises:
        ConfigError: a bad size, number of samples or time.

    Differentiable: no.

    Reference: the references of Oberberger 2022, section 5 (4096 samples with random times). We
        differ: stratified, so that fewer samples do.
    """
    return Renderer(scene).reference(size, spp=spp, shutter=shutter, frame=frame, seed=seed)


def _samples(
    pixels: Tensor, width: int, spp: int, interval: tuple[float, float], generator: torch.Generator
) -> tuple[Tensor, Tensor, Tensor]:
    """Return x, y and time of all samples of some pixels, (spp, pixels) each, float32."""
    count = pixels.shape[0]
    shift_x, shift_y = torch.rand((2, 1, count), generator=generator).unbind(0)
    jitter = torch.rand((spp, count), generator=generator)
    index = torch.arange(spp, dtype=torch.float64)[:, None]
    x = ((index * _STEP_X % 1).float() + shift_x) % 1
    y = ((index * _STEP_Y % 1).float() + shift_y) % 1
    start, end = interval
    times = start + (end - start) * (index.float() + jitter) / spp
    return x + (pixels % width), y + pixels.div(width, rounding_mode="floor"), times


def _variance_of_mean(values: Tensor) -> Tensor:
    """Return the variance of the mean over ordered strata, (C, S, P) -> (C, P).

    Half the squared difference of neighboring strata (around in a circle) estimates the variance
    within them, and adds half the squared difference of their means: on average too large,
    by a factor of 2 to 3 in our scenes, and not too small.
    """
    num_strata = values.shape[1]
    if num_strata == 1:
        return torch.full_like(values[:, 0], math.inf)
    steps = values - values.roll(1, 1)
    return steps.square().sum(1) / (2 * num_strata**2)


def _surface_layers(
    tracer: Tracer, size: tuple[int, int], x: Tensor, y: Tensor
) -> dict[str, Tensor]:
    now = torch.zeros_like(x)
    origins, directions = tracer.rays(size, x, y, now)
    hit = tracer.closest_hit(origins, directions, now)
    velocity, acceleration = _image_motion(_path(tracer, size, origins, directions, hit), now)
    return {
        "depth": hit.distance,
        "normal": hit.normal,
        "object_id": tracer.object_ids[hit.body.long()],
        "velocity": velocity,
        "acceleration": acceleration,
    }


def _path(
    tracer: Tracer, size: tuple[int, int], origins: Tensor, directions: Tensor, hit: Hit
) -> Callable[[Tensor], Tensor]:
    """Return where the points that were hit appear, as a function of time: (N,) -> (2, N)."""
    is_sky = torch.isinf(hit.distance)
    point = _planes(origins + directions * torch.where(is_sky, 1.0, hit.distance))
    sky = _planes(directions)
    levels = tracer.levels_of(hit.body)
    glass = tracer.lens(size)
    own, _ = into(levels, torch.zeros_like(hit.distance), point, sky)

    def path(time: Tensor) -> Tensor:
        moved = place(levels, time, own)
        return torch.stack(project(tracer.camera_levels, glass, time, moved, sky, is_sky))

    return path


def _image_motion(path: Callable[[Tensor], Tensor], now: Tensor) -> tuple[Tensor, Tensor]:
    """Return first and second derivative of N paths, (2, N) each.

    Each path depends on its own time alone, so the gradient of a sum has them all.
    """
    velocity, acceleration = [], []
    with torch.enable_grad():
        time = now.clone().requires_grad_()
        for coordinate in path(time).unbind(0):
            (speed,) = torch.autograd.grad(coordinate.sum(), time, create_graph=True)
            (change,) = torch.autograd.grad(speed.sum(), time, retain_graph=True)
            velocity.append(speed.detach())
            acceleration.append(change)
    return torch.stack(velocity), torch.stack(acceleration)


def _planes(vectors: Tensor) -> Vec:
    return vectors[0], vectors[1], vectors[2]


def _pixel_centers(size: tuple[int, int], device: torch.device) -> tuple[Tensor, Tensor]:
    rows, columns = (torch.arange(n, dtype=torch.float64, device=device) + 0.5 for n in size)
    return columns.repeat(size[0]), rows.repeat_interleave(size[1])


def _image(layer: Tensor, size: tuple[int, int]) -> Tensor:
    return layer.reshape(1, -1, *size).float()


def _check(size: tuple[int, int], spp: int, name: str, frame: float) -> None:
    if not (isinstance(size, Sequence) and len(size) == 2 and all(_is_count(n) for n in size)):
        raise ConfigError(
            f"`size` must be (height, width), two integers of at least 1 px, got {size!r}"
        )
    if not _is_count(spp):
        raise ConfigError(f"`{name}` must be an integer of at least 1, got {spp!r}")
    if not math.isfinite(frame):
        raise ConfigError(f"`frame` must be a finite number, got {frame!r}")


def _is_count(value: object) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and value >= 1
