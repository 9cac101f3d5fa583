"""Names of what an experiment keeps: made of all that it depends on, so that nothing goes stale."""

from __future__ import annotations

import hashlib
import json
import re
from typing import Any

from tuning.files.source import source_hash

__all__ = ["digest_of", "figures_hash", "slug"]


def slug(name: str) -> str:
    """Return a name as part of a file's name."""
    return re.sub(r"[^\w.+=-]+", "-", name).strip("-")


def digest_of(*parts: Any) -> str:
    """Return a short hash of plain data."""
    return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()[:10]


def figures_hash() -> str:
    """Return the hash of the source of filters, metrics and renderer: what figures depend on."""
    return source_hash("", "filters", "ops", "metrics", "render")
