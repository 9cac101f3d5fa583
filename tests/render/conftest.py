"""Small scenes that several tests share."""

import pytest

from torchblur.params import build
from torchblur.render import Scene

CAMERA = {"position": [0, 0, 4], "focal": 1.0}


@pytest.fixture
def make_scene():
    """Return a function that builds a scene from bodies, with a camera at z = 4 unless told."""

    def make(*bodies: dict, **others) -> Scene:
        return build(Scene, {"camera": CAMERA, "bodies": list(bodies)} | others)

    return make


@pytest.fixture
def glow():
    """Return a function that gives the fields of a body in one unlit color."""

    def fields(*color: float, **others) -> dict:
        return {"texture": {"kind": "solid", "color": color}, "emissive": True} | others

    return fields
