"""The measurements of `cavmarl bench`; others are in `benchmarks/` outside the package.

The package uses `evaluate` and is run by `cli`.
"""
