"""Helpers of tests of several packages."""

import pytest


def refused(kind, match, call, *arguments, **options):
    """Check that a call raises an error of a kind whose one line matches; return it."""
    with pytest.raises(kind, match=match) as caught:
        call(*arguments, **options)
    assert "\n" not in str(caught.value)
    return caught.value
