"""A second generator of concealed cases: random systems that lack random functions, and coarse sensors.

The first generator, `benchmarks.proof.concealment`, conceals what the dictionary of the diagnosis has names
for. Here no list and no formula is shared, and no code with `siq`; with the first generator only how a case
is written (`benchmarks.proof.cases`). Systems and functions are drawn; sensors round, lose samples, and have
clocks that jitter.

============  ===========================================================================
`formulas`    how is a formula evaluated?
`systems`     which random systems are there, and what is done to them?
`effects`     which function is missing, of which coordinates, and where?
`motion`      what does a system do?
`sensors`     what is recorded of it?
`cases`       which cases are there, what is written of each, and what does its key say?
============  ===========================================================================
"""
