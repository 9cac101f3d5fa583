from torchblur.filters.guertin2014 import Guertin2014Blur, guertin2014
from torchblur.testing.contract import FilterContract


class TestGuertin2014(FilterContract):
    filter_class = Guertin2014Blur
    function = staticmethod(guertin2014)
    plain = {"noise": "none"}
    acts_with = {
        "soft_depth_extent": {"depth_compare": "absolute"},
        "early_out": {"tile_size": 2},
        "tau": {"tile_size": 8},
        "stochastic_tiles": {"tile_size": 8},
        "neighbor_culling": {"tile_size": 8},
    }
