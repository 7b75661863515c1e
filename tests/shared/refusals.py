"""What is refused, and by which words."""

import pytest


def refused(said, read, *given, **more):
    """`read(*given)` raises a `ValueError` of one line that says so."""
    with pytest.raises(ValueError, match=said) as caught:
        read(*given, **more)
    assert "\n" not in str(caught.value)
