"""May a formula of V be believed, and to within which error?

=================  =======================================================================
`tests`            which tests are there, and which false solution does each refuse?
`characteristics`  is V that which characteristics carry, with nothing else of its fit?
`descent`          does V fall along recordings that no fit saw, as fast as it has to?
`existence`        do stable states and saddles stay, whatever of its uncertainty f takes?
`error_bound`      how far may V be from the true one, from its own residual?
`regions`          which points lie among the recorded states that lead to an attractor?
`held_out`         which held-out states and pairs does a formula have to answer?
`common_tests`     which tests has a formula in any case, and what do all tests come to?
`certify`          which tests has one formula for the whole region, on which points?
`certify_wells`    and one formula for each attractor?
`certificates`     what does a certificate say, and when does it certify?
`caustics`         where do characteristics cross, so that no formula follows V?
=================  =======================================================================

Imports `siq.potential` and what it may import.
"""
