"""The landscape as a whole: U in and between the wells, the ways out, and how long they take.

=============  ================================================================================
`options`      what is asked?
`local`        how does V look about each attractor, as a formula, and how far may it be believed?
`paths`        which path leads from an attractor to a saddle at least action?
`chains`       what is the action of a chain of points, and how is it made minimal?
`rates`        how often is a well left, prefactor included?
`transitions`  which barriers part the wells, how sure are they, and what does a way out look like?
`combined`     what is U over all wells?
`landscape`    all of this of one identified vector field
`storage`      landscapes as files
`mesh`         what is V on a mesh of two states, found without any ansatz?
`reference`    what do methods say that share no code with ours?
`escape`       how long does an escape take in a simulation?
=============  ================================================================================
"""
