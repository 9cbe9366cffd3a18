"""Outputs of a known state of the code as small tables, in ``tests/golden``, that a change has to reproduce.

`table` says how they are written and compared, `landscapes` what of a landscape; other modules are groups.
"""
