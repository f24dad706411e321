"""A crossing small enough to check by hand, as a fixture."""

from tests.support.crossing import crossing

__all__ = ["crossing"]
