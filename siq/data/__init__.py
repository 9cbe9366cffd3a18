"""Which recordings are these, are they whole, and which of them are held out?

===================  =================================================================
`recordings`         which trajectories, and which pairs of states a short time apart?
`selection`          whole recordings, chosen or drawn
`formats`            how is a CSV, Parquet, HDF5 or MATLAB file read?
`cells`              which number, label or unit is in a cell?
`checks`             is the table whole, and do its times increase?
`labels`             which recording has which label, and which has a copy of it?
`held_out`           which recordings does a fit not see?
`public_recordings`  what do the files of public benchmarks hold?
`quantum`            how finely were the numbers of a column written?
`noise_floor`        how strong are the two kinds of noise, at a first look?
`inspection`         what is in a file, and what will it be good for?
===================  =================================================================

Imports `siq.files` and what it may import.
"""
