"""What do methods say that share no code with ours?

=================  ===============================================================
`hamiltonian`      which flow has the characteristics as its trajectories?
`characteristics`  what is V along them?
`sheets`           where do they start, and which of their points may be believed?
`cubic_series`     the same to third powers, in many states
`power_series`     what is V near an attractor, order by order?
`mesh`             what is V on a mesh of two states, found without any ansatz?
`mesh_start`       is there room for the start about its attractor, and is V known there?
`mesh_march`       in which order do its nodes learn their values, over which segments?
`mesh_values`      what is V at its nodes, and between them?
`fokker_planck`    how long do visits last, and where are states, whatever the barriers?
`escapes`          how long does an escape take in a simulation?
`systems`          of which systems is the landscape known? (`siq.reference_systems`)
`known_barriers`   how high are their barriers, and how is that known?
`system_table`     all of it as a table (`siq.reference_table`)
=================  ===============================================================

Imports `siq.estimation` and what it may import; uses `siq.dynamics` only.
"""
