"""The named terms that rewards and evaluation read.

Kernels over rows; `sensors` calls them where it senses.
"""
