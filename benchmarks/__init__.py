"""Benchmarks outside the package, one file each; `python -m benchmarks` lists them.

They use `cavmarl` but are not part of its wheel. Benchmarks for users and papers are commands of
`cavmarl bench`.
"""
