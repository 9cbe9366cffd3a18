"""What does a system do? Its drift and noise as one object, from a formula to a trajectory.

====================  ================================================================================
`dynamics`            which drift, noise, inputs and outputs has a system?
`diffusion`           what does its noise do to momenta and velocities?
`state_noise`         and if it is stronger here than there, by a formula of the states?
`cards`               what does a system card describe?
`card_writing`        how is a dynamics written as a card?
`formulas`            how does the text of a formula become a function, without being code?
`exports`             how is a formula used elsewhere: as text, in LaTeX, in sympy?
`source_code`         and as source in numpy, C and Julia?
`parametric`          how does f change with states, signals and parameters?
`tape`                and how is it written for a loop in machine code?
`simulation`          which trajectories does it have?
`sampling`            how is it simulated where nobody says it?
`equilibria`          where does it rest, and how is V curved there?
`descents`            where do its trajectories end, and what lies below a saddle?
`reach`               does noise reach every state, be it by way of others?
`recurrence`          where does what comes to rest nowhere lead: to a cycle, or to chaos?
`cycles`              which period and multipliers has a cycle, and how is V curved across it?
`cycle_search`        which cycles are there, stable ones and those that part basins?
`basins`              which recorded points lead to an attractor?
`phase_portrait`      which attractors are there, and which saddles next to each?
`equilibrium_search`  where do given equations rest in their domain?
`continuation`        and where when a parameter changes?
`bifurcations`        where do equilibria fold, begin to oscillate, or meet others?
`bifurcation_curves`  and along which curves, against two parameters?
`parameter_family`    what is f against one of its parameters?
`edge_tracking`       which saddle lies between two attractors, in many states?
`many_states`         and which attractors and saddles have equations of many states?
`domain_portrait`     and which attractors, saddles and basins have they?
====================  ================================================================================

Imports `siq.data` and what it may import.
"""
