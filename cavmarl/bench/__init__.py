"""The benchmarks of `cavmarl bench`; further benchmarks are in `benchmarks/` outside the package.

The package uses `evaluate` and is run by `cli`.
"""
