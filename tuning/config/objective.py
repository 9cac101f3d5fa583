"""What a fit makes small: errors of the image and of the band, over time, and what it costs."""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from torchblur.params import Config

__all__ = ["Metric", "ObjectiveSpec"]

Metric = Literal["flip", "flip_hdr", "l1", "mse", "psnr", "relative_l2", "ssim"]
Weight = Annotated[float, Field(gt=0)]


def _flip_alone() -> dict[Metric, float]:
    return {"flip": 1.0}


class ObjectiveSpec(Config):
    """A weighted sum of errors of the image and of the band at moving borders; less is better."""

    terms: dict[Metric, Weight] = Field(
        default_factory=_flip_alone,
        description="weights of the whole image's errors; flip and flip_hdr have a color space of "
        "their own, ssim is 1 - SSIM, psnr is log10(1 + MSE / 1e-6): (60 dB - PSNR) / 10 dB, "
        "flattening to 0 for images better than that",
    )
    band: dict[Metric, Weight] = Field(
        default_factory=dict,
        description="the same of the band at moving borders alone; of the whole image where "
        "nothing moves",
    )
    color_space: Literal["linear", "srgb", "log"] = Field(
        "srgb",
        description="of l1, mse, psnr, relative_l2: radiance, clipped and sRGB-encoded, or "
        "log(1 + x)",
    )
    band_weight: float = Field(
        0.0,
        ge=0,
        le=1,
        description="share of the band at moving borders in all `terms`; the rest is the image",
    )
    temporal: float = Field(
        0.0,
        ge=0,
        description="of sequences: weight of the error of the change from frame to frame, "
        "|(I_t - I_t-1) - (R_t - R_t-1)| in `color_space`",
    )
    cost: float = Field(
        0.0,
        ge=0,
        description="weight of what the filter costs, relative to Guertin 2014 with 35 taps",
    )
    reduction: Literal["mean", "cvar", "worst"] = Field(
        "mean",
        description="over the frames, windows and sequences: the mean of all, of the worst share "
        "of them (`tail`), or the worst one",
    )
    tail: float = Field(0.25, gt=0, le=1, description="of cvar: the share of the worst that counts")

    @model_validator(mode="after")
    def _is_one_sum(self) -> Self:
        if not self.terms and not self.band:
            raise ValueError("`terms` or `band` must name a metric")
        if self.band and self.band_weight > 0:
            raise ValueError("give weights of the `band`, or its share `band_weight`, not both")
        return self
