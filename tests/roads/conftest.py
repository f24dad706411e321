"""The fixture `crossing`, a map that is small enough to check by hand."""

from tests.support.crossing import crossing

__all__ = ["crossing"]
