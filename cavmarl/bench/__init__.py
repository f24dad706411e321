"""What `cavmarl bench` measures; other measurements are in `benchmarks/` beside the package.

It stands on `evaluate` and is run by `cli`.
"""
