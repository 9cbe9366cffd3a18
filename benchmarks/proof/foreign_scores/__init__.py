"""How right is a diagnosis of a case from the second generator, `benchmarks.proof.foreign`?

What a diagnosis says is held against an oracle that shares no estimator with it: scipy's least squares with
the true function in place, through an integrator of its own.

=============  ==========================================================================
`integrator`   what does a model say of recordings, and how does it depend on parameters?
`oracle`       how well does the true simulation do, and the card's?
`places`       could the recordings tell another place from the true one?
`scores`       how near is what was named, how much of the gain was had? One row a case
=============  ==========================================================================
"""
