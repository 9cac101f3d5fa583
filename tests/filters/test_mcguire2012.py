from torchblur.filters.mcguire2012 import McGuire2012Blur, mcguire2012
from torchblur.testing.contract import FilterContract


class TestMcGuire2012(FilterContract):
    filter_class = McGuire2012Blur
    function = staticmethod(mcguire2012)
    plain = {"noise": "none"}
    acts_with = {"early_out": {"tile_size": 2}, "background_depth": {"background": "revealed"}}
