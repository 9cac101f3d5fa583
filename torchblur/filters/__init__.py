"""Motion-blur filters, one file or folder each; `parts` has what they share.

Every module of this package is imported here, so that a new file registers its filter by itself.
"""

from importlib import import_module
from pkgutil import iter_modules

from torchblur.filters.parts.base import BlurFilter, FilterConfig, History, TemporalBlur
from torchblur.filters.parts.registry import (
    PLUGINS,
    get_filter,
    list_filters,
    load_plugin,
    register_filter,
)
from torchblur.filters.parts.registry import registered_filters as registered_filters
from torchblur.filters.two_pass import TwoPassBlur

for _module in iter_modules(__path__):
    import_module(f"{__name__}.{_module.name}")

__all__ = [
    "PLUGINS",
    "BlurFilter",
    "FilterConfig",
    "History",
    "TemporalBlur",
    "TwoPassBlur",
    "get_filter",
    "list_filters",
    "load_plugin",
    "register_filter",
]
