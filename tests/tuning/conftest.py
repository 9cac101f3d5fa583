"""What the tests of the fits share: a cache of their own, and problems with a known answer."""

import os

import pytest
from planted import FIXED, PLANTED, planted_case

from torchblur.filters import get_filter
from torchblur.io import write_frame, write_image
from tuning.config import ObjectiveSpec
from tuning.data import make_samples
from tuning.problem import Problem


@pytest.fixture(autouse=True)
def _own_cache(tmp_path_factory, monkeypatch):
    """Keep rendered frames of tests out of the user's cache, but share them between tests."""
    root = tmp_path_factory.getbasetemp() / "torchblur_cache"
    monkeypatch.setenv("TORCHBLUR_CACHE", os.fspath(root))


@pytest.fixture
def planted_problem():
    """The objective whose minimum is at PLANTED, over two frames."""
    blur = get_filter("guertin2014")(**FIXED).requires_grad_(False)
    samples = make_samples([planted_case(1), planted_case(2)], None, tile_size=12, seed=0)
    objective = ObjectiveSpec(terms={"mse": 1.0}, color_space="linear")
    return Problem(blur, samples, objective, tuple(PLANTED))


@pytest.fixture
def planted_folders(tmp_path):
    """Write two planted cases as EXR; return the data of a configuration that fits them."""
    for seed, name in ((1, "first"), (2, "second")):
        folder = tmp_path / "frames" / name
        folder.mkdir(parents=True)
        case = planted_case(seed)
        write_frame(folder / "sharp.exr", case.frame, half=False)
        write_image(folder / "reference.exr", case.reference, half=False)
    return {
        "filter": {"kind": "guertin2014", "params": dict(FIXED), "free": list(PLANTED)},
        "data": {
            "root": str(tmp_path / "frames"),
            "train": [{"kind": "exr", "path": "first", "shutter": 1.0}],
            "holdout": [{"kind": "exr", "path": "second", "shutter": 1.0}],
        },
        "objective": {"terms": {"mse": 1.0}, "color_space": "linear"},
        "methods": [
            {"kind": "gradient", "steps": 6, "starts": 2},
            {"kind": "blackbox", "sampler": "tpe", "trials": 8},
        ],
        "seed": 5,
        "device": "cpu",
    }
