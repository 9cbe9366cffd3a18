"""How are things computed that every package needs?

====================  ==========================================================================
`integration`         how do many trajectories take a step of order eight at once, each its own?
`machine_code`        how does a loop become machine code?
`randomness`          where do the random numbers of a study come from?
`normal_draws`        which parameters are as likely as those that were found?
`thinning`            which points represent a region evenly?
`triangle`            what do all least-squares fits to very many rows depend on?
`density_comparison`  how far are samples from a density on a plane of two states?
`number_text`         how is a number written for a reader?
`measured_text`       and a measured value, with its error and its unit?
`share_text`          and a share, or a p-value?
`word_text`           and words, in a sentence?
====================  ==========================================================================

Imports `siq.errors`.
"""
