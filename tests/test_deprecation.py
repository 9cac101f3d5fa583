import warnings

import pytest

import torchblur
from torchblur.deprecation import deprecated


@deprecated(since="0.2", use="new()")
def old(value):
    """Return the value.

    Args:
        value: Any.
    """
    return value


@deprecated(since="0.2", use="New")
class Old:
    """A class."""


def test_a_deprecated_name_works_and_warns_where_it_is_called():
    with pytest.warns(
        DeprecationWarning, match=r"`old` is deprecated since torchblur 0\.2; use `n"
    ):
        assert old(3) == 3
    with pytest.warns(DeprecationWarning, match="`Old` is deprecated") as caught:
        assert isinstance(Old(), Old)
    assert caught[0].filename == __file__


def test_the_docstring_says_so():
    assert old.__doc__ == (
        "Return the value.\n\nArgs:\n    value: Any.\n\nDeprecated: since 0.2; use `new()`."
    )
    assert old.__name__ == "old"


def test_one_warning_for_each_line_that_calls():
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("default")
        for _ in range(3):
            old(1)
        old(2)
    assert len(caught) == 2


def test_old_names_of_the_library():
    with pytest.warns(DeprecationWarning, match=r"use `torchblur\.FrameSequence`"):
        assert torchblur.Sequence is torchblur.FrameSequence
    with pytest.warns(DeprecationWarning, match=r"use `list_filters\(\)`"):
        assert torchblur.registered_filters() == torchblur.list_filters()
    with pytest.raises(AttributeError, match="module 'torchblur' has no attribute 'Secuence'"):
        _ = torchblur.Secuence
