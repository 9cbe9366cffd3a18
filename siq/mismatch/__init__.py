"""When simulation and recordings differ: locate the mismatch, name the physics left out, model it.

`case` reads a card, recordings and a study, and answers with everything that is reported.

==================  ===========================================================================
`cards`, `model`    what does the simulation say, in symbols?
`roles`             what is each of its states: a position, a population, a level?
`measurements`      what was measured, and what drove the system?
`study`             which recordings are held out, and what counts as found?
`dictionary`        which mechanisms have a name?
`candidates`        what would each of them change in this simulation?
`linearisation`     what do small changes of states and parameters do to what is measured?
`estimation`        which parameters, states and noise fit best?
`trajectories`      the same, where trajectories may not leave their equations
`screening`         how much would each candidate gain, to first order?
`trials`            and how much in earnest?
`clusters`          does it stand, whatever errors within a recording are like?
`search`            which mechanisms are found?
`structure`         along which coordinates is something missing?
`remainder`         what do the mechanisms leave?
`steadiness`        are random forces those of surroundings?
`diagnosis`         what is the verdict?
`location`          where does it sit?
`held_out`          how well does it run on recordings that had no part in it?
`consequences`      what does it do to wells and escape times?
`verdict`           all of this as data
`report`            and as a page
==================  ===========================================================================
"""
