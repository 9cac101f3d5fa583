"""What is in a file, what torchblur makes of it, and what looks wrong."""

from __future__ import annotations

import dataclasses
import math
import warnings
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchblur.errors import TorchblurError
from torchblur.frame import Frame, Shutter
from torchblur.io.channels import Catalog, Plane, views_of
from torchblur.io.conventions import (
    CHANNEL_FIELDS,
    Convention,
    ConventionOverrides,
    resolve_convention,
)
from torchblur.io.exr import ExrPart, Window, read_exr
from torchblur.io.frames import read_frame, read_image
from torchblur.io.motioncheck import (
    BlurCheck,
    SignMatch,
    VelocityInfo,
    check_blur,
    check_speed,
    compare_signs,
)
from torchblur.io.timecheck import TimeInfo, about_time, check_time
from torchblur.params import build

__all__ = ["ChannelInfo", "Inspection", "PartInfo", "inspect_file"]

_SAME_DB = 0.05
_TYPE_NAMES = {"float16": "half", "float32": "float", "uint32": "uint"}


@dataclass(frozen=True)
class ChannelInfo:
    """Values of one channel; minimum, mean and maximum are of the finite ones."""

    name: str
    type: str
    minimum: float
    mean: float
    maximum: float
    num_nan: int
    num_inf: int


@dataclass(frozen=True)
class PartInfo:
    """One part of a file."""

    name: str
    view: str
    compression: str
    data_window: Window
    display_window: Window
    attributes: Mapping[str, Any]
    channels: tuple[ChannelInfo, ...]


@dataclass(frozen=True)
class Inspection:
    """Plain data about a file, for a person or a program.

    Args:
        path: The file.
        parts: Its parts with their channels.
        metadata: torchblur's own metadata, if it wrote the file.
        views: Stereo views, the default one first.
        convention: Name of the convention that fits, or "" (then `warnings` say why).
        evidence: How sure the entry of the table is: verified, documentation or memory.
        recognized: Channels by role: color, depth, velocity …
        velocity: Speeds, if there is a velocity.
        time: Times of the pixels, if there is a time: a stream, if they differ.
        blur: Whether the color is blurred already.
        signs: Match with the reference per change of the velocity, best first.
        warnings: What looks wrong, one sentence each; empty if nothing does.
        notes: What is worth knowing: how zeros were read, what a reference cannot show.
    """

    path: str
    parts: tuple[PartInfo, ...]
    metadata: Mapping[str, Any]
    views: tuple[str, ...]
    convention: str
    evidence: str
    recognized: Mapping[str, tuple[str, ...]]
    velocity: VelocityInfo | None
    time: TimeInfo | None
    blur: BlurCheck | None
    signs: tuple[SignMatch, ...]
    warnings: tuple[str, ...]
    notes: tuple[str, ...]

    def as_dict(self) -> dict[str, Any]:
        """Return nested dicts, lists and scalars, as JSON can hold them."""
        return dataclasses.asdict(self)


def inspect_file(
    path: str | Path,
    reference: str | Path | None = None,
    *,
    convention: str = "auto",
    layer: str | None = None,
    view: str | None = None,
    shutter: Shutter | None = None,
    **overrides: Any,
) -> Inspection:
    """Look at an OpenEXR file: channels, values, convention, and what looks wrong.

    Args:
        path: The file.
        reference: The same frame with motion blur: then the signs and axes of the velocity are
            tried out, and the best match is named.
        convention: As in `read_frame`.
        layer: As in `read_frame`.
        view: As in `read_frame`.
        shutter: Of the reference; half a frame, centered, if left out.
        **overrides: As in `read_frame`.

    Returns:
        The findings. That a file fits no convention or holds bad values is a finding.

    Raises:
        FileFormatError: if a file is missing or damaged, or has no such view or layer.
        ConfigError: unknown convention or override.
    """
    file = read_exr(path)
    catalog = Catalog.of(file, view, layer)
    changed = build(ConventionOverrides, overrides, "inspect_file")
    findings = _Findings([])
    chosen, frame = None, None
    try:
        chosen = resolve_convention(catalog, convention, changed)
        frame = _read(path, chosen, layer, view)
    except TorchblurError as error:
        if convention != "auto" and chosen is None:
            raise
        findings.warnings.append(str(error))
    roles = {} if chosen is None else _recognized(catalog, chosen)
    findings.warnings[:0] = _bad_values(catalog.planes, roles.get("depth", ()))
    blur, times, signs = None, None, []
    if chosen is not None and frame is not None:
        blur = check_blur(frame.color, frame.velocity)
        findings.about_values(roles, chosen, frame, blur)
        if frame.time is not None:
            times = check_time(frame.time)
            findings.warnings += about_time(roles["time"][0].label, times)
        if reference is not None:
            signs = findings.about_signs(reference, frame, shutter or Shutter())
    return Inspection(
        path=str(path),
        parts=tuple(_part_info(part) for part in file.parts),
        metadata=file.metadata,
        views=tuple(views_of(file)),
        convention="" if chosen is None else chosen.name,
        evidence="" if chosen is None else chosen.evidence,
        recognized={role: tuple(p.label for p in planes) for role, planes in roles.items()},
        velocity=None if frame is None else check_speed(frame.velocity),
        time=times,
        blur=blur,
        signs=tuple(signs),
        warnings=tuple(findings.warnings),
        notes=tuple(findings.notes),
    )


# -- what is there -----------------------------------------------------------------------------


def _part_info(part: ExrPart) -> PartInfo:
    return PartInfo(
        name=part.name,
        view=part.view,
        compression=part.compression,
        data_window=part.window,
        display_window=part.image_window,
        attributes=part.attributes,
        channels=tuple(_channel_info(name, array) for name, array in part.channels.items()),
    )


def _channel_info(name: str, array: NDArray[Any]) -> ChannelInfo:
    finite = _finite(array).astype(np.float64)
    low, mean, high = (
        (float(f(finite)) if finite.size else math.nan) for f in (np.min, np.mean, np.max)
    )
    return ChannelInfo(
        name=name,
        type=_TYPE_NAMES[array.dtype.name],
        minimum=low,
        mean=mean,
        maximum=high,
        num_nan=int(np.isnan(array).sum()),
        num_inf=int(np.isinf(array).sum()),
    )


def _read(path: str | Path, convention: Convention, layer: str | None, view: str | None) -> Frame:
    with warnings.catch_warnings():  # bad values are counted in the findings
        warnings.simplefilter("ignore")
        return read_frame(path, convention, layer=layer, view=view, on_invalid="mask")


def _recognized(catalog: Catalog, convention: Convention) -> dict[str, tuple[Plane, ...]]:
    roles = {}
    for role in CHANNEL_FIELDS:
        groups = [(g,) if isinstance(g, str) else g for g in getattr(convention, role)]
        planes = catalog.find_group(groups)
        if planes is not None:
            roles[role] = planes
    return roles


# -- what looks wrong --------------------------------------------------------------------------


def _bad_values(planes: Iterable[Plane], depth: Iterable[Plane]) -> Iterable[str]:
    depth_labels = {plane.label for plane in depth}
    for plane in planes:
        array = plane.part.channels[plane.key]
        infinite = np.isinf(array)
        if plane.label in depth_labels and array.dtype != np.float16:
            infinite &= array < 0  # +inf is a background; in half float it may be an overflow
        num_nan, num_inf = int(np.isnan(array).sum()), int(infinite.sum())
        if num_nan or num_inf:
            y, x = (int(i) for i in np.argwhere(infinite | np.isnan(array))[0])
            what = " and ".join(
                f"{count} {kind}" for count, kind in ((num_nan, "NaN"), (num_inf, "inf")) if count
            )
            half = array.dtype == np.float16 and num_inf > 0
            hint = "; half float overflows at 65504: write it as float" if half else ""
            yield f"channel `{plane.label}` has {what}, the first at x={x}, y={y}{hint}"


@dataclass
class _Findings:
    """What looks wrong, and what is worth knowing, while it is being collected."""

    warnings: list[str]
    notes: list[str] = dataclasses.field(default_factory=list)

    def about_values(
        self,
        roles: Mapping[str, tuple[Plane, ...]],
        convention: Convention,
        frame: Frame,
        blur: BlurCheck,
    ) -> None:
        self.warnings += _about_velocity(roles, convention, frame)
        self.warnings += _about_color(roles.get("color", ()), roles.get("alpha", ()))
        for plane in roles.get("depth", ()):
            self.about_depth(plane, convention)
        if blur.blurred:
            self.warnings.append(
                "the color seems to hold motion blur already: along the motion it is smoother "
                f"({blur.along:.2f}) than across ({blur.across:.2f}); a filter needs a sharp image"
            )
        if convention.evidence != "verified":
            self.warnings.append(
                f"convention `{convention.name}` is known from {convention.evidence} only: check "
                "sign and unit against a reference"
            )
        if convention.note:
            self.notes.append(f"{convention.program}: {convention.note}")

    def about_depth(self, plane: Plane, convention: Convention) -> None:
        array = plane.part.channels[plane.key]
        zeros, negative = int((array == 0).sum()), int((array < 0).sum())
        if negative and convention.depth_scale > 0:
            self.warnings.append(
                f"the depth `{plane.label}` has {negative} negative values: depth_scale=-1 or "
                "another depth_kind may fit"
            )
        if zeros and convention.depth_kind == "planar":
            text = f"the depth `{plane.label}` has {zeros} zeros"
            if convention.depth_zero == "background":
                self.notes.append(f"{text}, which are read as infinitely far")
            else:
                self.warnings.append(
                    f'{text}; depth_zero="background" reads them as infinitely far'
                )
        if array.dtype == np.float16:
            self.warnings.append(
                f"the depth `{plane.label}` is half float: 11 bits, and far values overflow; "
                "write it as float"
            )

    def about_signs(self, reference: str | Path, frame: Frame, shutter: Shutter) -> list[SignMatch]:
        image = read_image(reference)
        if image.shape != frame.color.shape:
            (h, w), (rh, rw) = frame.size, image.shape[-2:]
            self.warnings.append(f"the reference {reference} is {rw}x{rh}, the frame {w}x{h}")
            return []
        if not bool((frame.velocity != 0).any()):
            return []
        signs = compare_signs(frame.color, frame.velocity, image, shutter)
        psnr = {match.change: match.psnr for match in signs}
        best = signs[0]
        if best.change == "not blurred":
            self.warnings.append(
                "no sign or order of axes of the velocity brings the color "
                f"({best.psnr:.2f} dB) closer to the reference (as read: {psnr['as read']:.2f} dB)"
            )
        elif best.psnr > psnr["as read"] + _SAME_DB:
            self.warnings.append(
                f"the reference is met best with {best.change} ({best.psnr:.2f} dB; as read: "
                f"{psnr['as read']:.2f} dB): the signs or axes of the velocity seem wrong"
            )
        alike = [match.change for match in signs if match.psnr > best.psnr - _SAME_DB]
        if len(alike) > 1:
            self.notes.append(
                f"the reference cannot tell apart: {'; '.join(alike)}. A centered shutter never "
                "shows the direction of time, and motion along one axis not the other's sign"
            )
        return signs


def _about_velocity(
    roles: Mapping[str, tuple[Plane, ...]], convention: Convention, frame: Frame
) -> Iterable[str]:
    height, width = frame.size
    fastest = float(frame.velocity.norm(dim=1).max())
    names = ", ".join(
        p.label for role in ("velocity", "velocity_previous") for p in roles.get(role, ())
    )
    if fastest == 0:
        yield f"the velocity ({names}) is zero everywhere; was the pass rendered?"
    elif _biased(roles) and convention.velocity_bias == 0:
        yield f"the velocity ({names}) centers on 0.5 within [0, 1]: velocity_bias=0.5 may fit"
    elif convention.velocity_unit == "px" and fastest < 2:
        yield (
            f"the velocity is at most {fastest:.3g} px/frame: if things move faster, it is stored "
            'as a fraction of the image: velocity_unit="uv" or "ndc"'
        )
    elif fastest > math.hypot(height, width):
        yield (
            f"the velocity reaches {fastest:.3g} px/frame, more than the image's diagonal: is "
            f"the unit `{convention.velocity_unit}` right?"
        )


def _biased(roles: Mapping[str, tuple[Plane, ...]]) -> bool:
    planes = roles.get("velocity") or roles.get("velocity_previous") or ()
    arrays = [p.part.channels[p.key].astype(np.float64) for p in planes]
    inside = all(a.min() >= 0 and a.max() <= 1 for a in arrays)
    return bool(arrays) and inside and all(abs(np.median(a) - 0.5) < 0.1 for a in arrays)


def _about_color(color: Iterable[Plane], alpha: Iterable[Plane]) -> Iterable[str]:
    arrays = [_finite(plane.part.channels[plane.key]) for plane in color]
    if arrays and all(array.size for array in arrays):
        highest = max(float(array.max()) for array in arrays)
        at_one = max(float((array == 1).mean()) for array in arrays)
        if highest == 1 and at_one > 0.001:
            yield (
                f"the color stops at 1, which {at_one:.1%} of the pixels have: it seems clipped "
                "or tone-mapped; scene-linear values are needed"
            )
        if min(float(array.min()) for array in arrays) < 0:
            yield "the color has negative values"
    for plane in alpha:
        array = plane.part.channels[plane.key]
        other = float((array != 1).mean())
        if other > 0:
            yield (
                f"alpha `{plane.label}` is not 1 in {other:.1%} of the pixels; it is not used: "
                "the color is taken as premultiplied, over black"
            )


def _finite(array: NDArray[Any]) -> NDArray[Any]:
    finite: NDArray[Any] = array[np.isfinite(array)]
    return finite
