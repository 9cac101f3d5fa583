"""Sharp G-buffers, stochastic streams and motion-blurred references of a scene.

All come from the same rays. The layers of G-buffer and stream are computed in float64; their
motion vectors are the derivative of where a surface point appears, through the transforms of body
and camera.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import torch
from torch import Tensor

from torchblur.errors import ConfigError
from torchblur.frame import Frame, Shutter
from torchblur.render.compiling import Engine, check_engine
from torchblur.render.sampling import spread_positions
from torchblur.render.scene import Scene
from torchblur.render.stream import random_planes, trace_stream
from torchblur.render.surface import pixel_centers, surface_layers
from torchblur.render.trace import CHUNK, Tracer

__all__ = [
    "PixelFilter",
    "Reference",
    "Renderer",
    "render_frame",
    "render_reference",
    "render_stream",
]

PixelFilter = Literal["box", "center"]
"""Where in a pixel its samples lie: anywhere, or all at its center."""

_WORTH_COMPILING = 1e8  # rays times bodies: half a minute of eager work on one core


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
        images: How many images of a kind will be asked for; with more, "auto" compiles sooner.

    Raises:
        ConfigError: if the engine has another name.
    """

    def __init__(
        self,
        scene: Scene,
        *,
        engine: Engine = "auto",
        device: torch.device | str = "cpu",
        images: int = 1,
    ) -> None:
        check_engine(engine)
        self._images = images
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
        x, y = pixel_centers(size, self.device)
        now = torch.zeros_like(x)
        layers = surface_layers(tracer, size, x, y, now, acceleration=True)
        if color_spp == 1:
            color = tracer.image(size, x, y, now)
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
        pixel: PixelFilter = "box",
    ) -> Reference:
        """Return the motion-blurred reference; see `render_reference`."""
        _check(size, spp, "spp", frame)
        if pixel not in get_args(PixelFilter):
            raise ConfigError(f"`pixel` must be 'box' or 'center', got {pixel!r}")
        interval = (shutter or Shutter()).interval
        mean, variance = self._sampled(size, spp, interval, frame, seed, pixel)
        return Reference(mean=_image(mean, size), variance=_image(variance, size), spp=spp)

    def stream(
        self,
        size: tuple[int, int],
        *,
        frame: float = 0.0,
        shutter: Shutter | None = None,
        spp: int = 1,
        seed: int = 0,
        jitter: bool = False,
    ) -> list[Frame]:
        """Return the frames of a stochastic stream; see `render_stream`."""
        _check(size, spp, "spp", frame)
        return [
            self.stream_sample(size, k, frame=frame, shutter=shutter, seed=seed, jitter=jitter)
            for k in range(spp)
        ]

    @torch.no_grad()
    def stream_sample(
        self,
        size: tuple[int, int],
        sample: int,
        *,
        frame: float = 0.0,
        shutter: Shutter | None = None,
        seed: int = 0,
        jitter: bool = False,
    ) -> Frame:
        """Return one sample of a stream, from 0: that of `stream` at its place in the list."""
        _check(size, 1, "spp", frame)
        if not _is_count(sample + 1):
            raise ConfigError(f"`sample` must be an integer of at least 0, got {sample!r}")
        compiled = self._compiles(size, 1)
        tracer = Tracer(
            self.scene, frame, dtype=torch.float64, device=self.device, compiled=compiled
        )
        shape = (3 if jitter else 1, size[0] * size[1])
        planes = random_planes(seed, frame, sample, shape).to(self.device)
        shift = planes[1:].double() - 0.5 if jitter else None
        return trace_stream(tracer, size, shutter or Shutter(1.0), planes[0], shift)

    def _compiles(self, size: tuple[int, int], spp: int) -> bool:
        work = size[0] * size[1] * spp * self._num_bodies * self._images
        return self.engine == "compiled" or (self.engine == "auto" and work > _WORTH_COMPILING)

    def _sampled(
        self,
        size: tuple[int, int],
        spp: int,
        interval: tuple[float, float],
        frame: float,
        seed: int,
        pixel: PixelFilter = "box",
    ) -> tuple[Tensor, Tensor]:
        """Return mean and variance of the mean, (3, H*W) each."""
        height, width = size
        compiled = self._compiles(size, spp)
        tracer = Tracer(self.scene, frame, device=self.device, compiled=compiled)
        generator = torch.Generator().manual_seed(seed)
        block = max(1, CHUNK // spp)
        means, variances = [], []
        for first in range(0, height * width, block):
            pixels = torch.arange(first, min(first + block, height * width))
            samples = _samples(pixels, width, spp, interval, generator, pixel)
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
    pixel: PixelFilter = "box",
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
        pixel: "box": the mean over the pixel, without aliasing. "center": all samples at the
            pixel's center; what a stream of `render_stream` converges to.

    Returns:
        Mean and variance of the mean.

    Raises:
        ConfigError: a bad size, number of samples, time or pixel filter.

    Differentiable: no.

    Reference: the references of Oberberger 2022, section 5 (4096 samples with random times). We
        differ: stratified, so that fewer samples do.
    """
    return Renderer(scene).reference(
        size, spp=spp, shutter=shutter, frame=frame, seed=seed, pixel=pixel
    )


def render_stream(
    scene: Scene,
    size: tuple[int, int],
    *,
    frame: float = 0.0,
    shutter: Shutter | None = None,
    spp: int = 1,
    seed: int = 0,
    jitter: bool = False,
) -> list[Frame]:
    """Render a stochastic stream: every pixel as it is at a random time of its own.

    The times are uniform over the shutter, and independent from pixel to pixel, frame to frame
    and sample to sample. The mean of many streams is ``render_reference(..., pixel="center")``
    (with `jitter`: "box") with the same shutter.

    Args:
        scene: The scene.
        size: Height and width in px, each at least 1.
        frame: The time of the frame, in frames; any finite number. Consecutive ones make a
            sequence.
        shutter: When the shutter is open around `frame`; a whole frame, centered, if left out, so
            that the shutters of successive frames touch.
        spp: Samples per pixel, at least 1.
        seed: Of the times; any integer. A frame has the same times whatever was rendered before,
            and sample k is the same whatever `spp` is.
        jitter: Take each sample at a random position in the pixel instead of its center.

    Returns:
        `spp` frames of one, each with one sample of every pixel: `time` over the shutter (0 the
        opening, 1 the closing), and at that time: `color`; `albedo`, the color of the texture
        without light (of the sky and of emissive bodies: their radiance); planar `depth` (+inf
        for the sky); `normal` (in the world, facing the camera; 0 for the sky); `object_id` (0
        for the sky); and `velocity`, px/frame. What is seen at (x, y) at time t is at time s, to
        first order, at ``(x, y) + shutter.open * velocity * (s - t)``.

    Raises:
        ConfigError: a bad size, number of samples or time.

    Differentiable: no.

    Reference: the input of Oberberger 2022, section 3. We differ: no shadows or reflections, and
        velocity is the derivative, not the displacement over the shutter.
    """
    return Renderer(scene).stream(
        size, frame=frame, shutter=shutter, spp=spp, seed=seed, jitter=jitter
    )


def _samples(
    pixels: Tensor,
    width: int,
    spp: int,
    interval: tuple[float, float],
    generator: torch.Generator,
    pixel: PixelFilter,
) -> tuple[Tensor, Tensor, Tensor]:
    """Return x, y and time of all samples of some pixels, (spp, pixels) each, float32."""
    count = pixels.shape[0]
    shift = torch.rand((2, count), generator=generator)
    jitter = torch.rand((spp, count), generator=generator)
    index = torch.arange(spp, dtype=torch.float64)[:, None]
    x, y = spread_positions(spp, shift)
    if pixel == "center":
        x, y = torch.full_like(x, 0.5), torch.full_like(y, 0.5)
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
