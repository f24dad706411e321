"""Notices for users on standard error: each is printed once per process."""

from __future__ import annotations

import sys

_PRINTED: set[str] = set()


def print_once(notice: str) -> None:
    """Print a notice, unless this process has printed it already."""
    if notice not in _PRINTED:
        _PRINTED.add(notice)
        print(f"cavmarl: {notice}", file=sys.stderr, flush=True)
