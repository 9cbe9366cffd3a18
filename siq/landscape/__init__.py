"""The landscape as a whole: V between attractors, the ways out, and how long they take.

=========  ================================================================
`local`    how does V look about each attractor, as a formula, and how far may it be believed?
`paths`    which path leads from an attractor to a saddle at least action?
`rates`    how often does a well get left, prefactor included?
`escape`   how long does it take in a simulation?
`mesh`     what is V on a mesh of two states, found without any ansatz?
=========  ================================================================
"""
