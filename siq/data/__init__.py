"""Which recordings are these, are they whole, and which of them are held out?

===================  =================================================================
`recordings`         which trajectories, and which pairs of states a short time apart?
`selection`          whole recordings, chosen or drawn; stretches of a single one
`tables`             from cells to checked numbers: what is read, put right, refused?
`folders`            which files are in a folder, and what did a wrong path mean?
`formats`            how is a CSV, Parquet, HDF5, MATLAB or NumPy file read?
`text_dialect`       how is a table of text written: separators, decimals, comments?
`headings`           which name and which unit are in a heading?
`layout`             which column is the time, which says the recording?
`cells`              which number, label or unit is in a cell?
`clock_times`        how many seconds are between dates?
`repairs`            what can be put right without a guess?
`checks`             is the table whole, and do its times increase?
`learnable`          can anything be learned from these recordings?
`quantum`            how finely were the numbers of a column written?
`stationarity`       how fast does a record forget, and does its background drift slowly?
`transitions`        how many states does it support by itself, and how often does it hop?
`two_state_tests`    is it pushed apart, or could a single state show as much?
`two_levels`         at which levels does it stay, over which background?
`visits`             when does it visit which state, and how long do visits last?
`record_states`      what does it say of its two states, without any formula?
`noise_floor`        how strong are the two kinds of noise, at a first look?
`lagged`             where are samples evenly spaced, and how do neighbours go together over lags?
`noise_memory`       sensor noise, an exposure, or forces with a memory?
`markov_lag`         from which lag on is a record Markovian?
`coverage`           which part of the space of states was visited?
`inspected_states`   what is known of each measured column?
`prospects`          what can be learned, in sentences?
`inspection`         what is in recordings, and what will they be good for?
`labels`             which recording has which label, and which has a copy of it?
`held_out`           which recordings does a fit not see?
`public_recordings`  what do the files of public benchmarks hold?
===================  =================================================================

Imports `siq.files` and what it may import.
"""
