"""May a formula of V be believed, and to within which error?

=============  =================================================================
`tests`        which tests are there, and which false solution does each refuse?
`error_bound`  how far may V be from the true one, from its own residual?
`certify`      which tests apply to the formulas of a run, on which points?
=============  =================================================================

Imports `siq.potential` and what it may import.
"""
