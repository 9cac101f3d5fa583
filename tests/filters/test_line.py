from torchblur.filters.line import LineBlur, line
from torchblur.testing.contract import FilterContract


class TestLine(FilterContract):
    filter_class = LineBlur
    function = staticmethod(line)
    box_tolerance = 0.004
