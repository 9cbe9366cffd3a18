"""Orthogonal decomposition f = -D∇V + g by two tanh networks (paper, section 2.2).

=============  ==========================================================
`options`      what a training is told
`data`         which pairs train, which are held out, which batch comes when
`networks`     V_θ and g_θ, with the gradient by hand
`initial`      the networks before training
`matching`     how a vector field is held against the pairs
`loss`         the two terms of the loss
`training`     Adam, the held-out loss, resuming
`checkpoint`   interrupted trainings as files
`trained`      the networks after training, without torch; as files
`regression`   sparse formulas of V, g and f from the networks
=============  ==========================================================

Imports `siq.reference` and what it may import.
"""
