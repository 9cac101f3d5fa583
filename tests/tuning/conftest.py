"""What the tests of the fits share: a cache of their own, and problems with a known answer."""

import os

import pytest
from planted import FIXED, PLANTED, planted_case, write_planted
from planted_sequences import Recall

import torchblur.filters.parts.registry
from torchblur.filters import get_filter
from tuning.config.objective import ObjectiveSpec
from tuning.objective.problem import Problem
from tuning.objective.windows import make_samples


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
    """The data of a configuration that fits two planted cases on disk."""
    return write_planted(tmp_path / "frames")


@pytest.fixture
def recall(monkeypatch):
    """The stand-in filter with a memory, by its name "recall"."""
    monkeypatch.setitem(torchblur.filters.parts.registry._REGISTRY, Recall.name, Recall)
    return Recall
