"""What is V about each attractor, and over a region, as a formula?

==================  ==============================================================================
`bases`             in which functions is V written?
`hamilton_jacobi`   which V in a basis solves the Hamilton–Jacobi equation?
`well`              what is V about an attractor, up to which level, and where may it be believed?
`local_route`       what is V about one attractor, from f alone?
`local_wells`       of which degree is it?
`raised_wells`      and where the depth of the well is known beforehand?
`global_route`      what is V over the whole region, from what the networks found?
`orthogonal_fit`    which V and g together fit f best under noise?
`refinement`        how do these become the formulas of a run?
`refined_formulas`  how do their coefficients and errors read as formulas?
`uncertainty`       how far does what is not known of f carry V off?
`training_check`    would refinement succeed from these networks?
`symbolic`          what do formulas of V, g and f evaluate to?
`storage`           how are they kept in a file?
==================  ==============================================================================

Imports `siq.networks` and what it may import.
"""
