"""Map files: built into SUMO networks, checked, with buildings beside them.

Stands on `roads`.
"""
