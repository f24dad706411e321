"""Benchmarks outside the package, one file each; `python -m benchmarks` lists them.

They use `cavmarl` but are no part of its wheel. The benchmarks that users and papers need are in
`cavmarl bench`.
"""
