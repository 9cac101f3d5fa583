"""Fixtures that all tests share."""

import os
from pathlib import Path

import pytest
import torch

pytest_plugins = ["tiers"]

REPOSITORY = Path(__file__).resolve().parents[1]


@pytest.fixture(autouse=True)
def _seeded():
    torch.manual_seed(20140825)


@pytest.fixture(scope="session")
def repository() -> Path:
    """Root of the checkout: where configs/ lies."""
    return REPOSITORY


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Folder with the reference frames of another renderer; tests skip where it is absent.

    It is `data` in the folder that TORCHBLUR_SHARED names, or in `shared` beside the checkout.
    """
    root = Path(os.environ.get("TORCHBLUR_SHARED", REPOSITORY.parent / "shared")) / "data"
    if not root.is_dir():
        pytest.skip("the shared reference frames are not here")
    return root
