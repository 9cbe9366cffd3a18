"""Simulated laboratories: noisy, hopping records whose barriers, and how well they can be known, are known.

    make laboratories

=============  ===============================================================================
`models`       which laboratories are there, and what do they measure?
`polynomials`  what are drift and noise at a state, in machine code?
`records`      what does a laboratory record?
`truths`       which wells and barriers does it have, and how do barriers follow the parameters?
`information`  how much does a record say of the parameters, at best?
`bounds`       how well can its barriers be known at best?
`answers`      what does `siq` say of a record?
`others`       and what do other methods say of it?
`fit_by_sfi`   the same for StochasticForceInference, in an environment of its own
`one`          one record, from its seed to a file
`__main__`     many of them
`summary`      errors, coverage and false certificates as a table
`figure`       and as a picture
`coverage`     do the estimator's standard errors cover, whatever the ratio of the two noises?
=============  ===============================================================================

Truths and bounds share nothing with the method but, in more than one state, the path of least action.
"""
