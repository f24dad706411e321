"""Benchmarks that are run beside the package, one file each; `python -m benchmarks` lists them.

They stand on `cavmarl` and are no part of its wheel. What users and papers need is in
`cavmarl bench`.
"""
