"""`python -m cavmarl`: the command line."""

from __future__ import annotations

from cavmarl.cli import main

if __name__ == "__main__":
    main()
