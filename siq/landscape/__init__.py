"""What is the landscape as a whole: U in and between the wells, the ways out, and how long they take?

========================  ====================================================================================
`options`                 what is asked?
`paths`                   which path leads from an attractor to a saddle at least action?
`discretised_paths`       what is the action of a chain of points?
`chain_spacing`           how are its points laid along a curve?
`first_chains`            from which first chains is a path sought, and which minima are rivals?
`chain_descent`           how is the action of a chain made minimal?
`path_nodes`              which momenta and actions has it then?
`hamiltonian_paths`       and which paths are most likely where noise acts on some states only?
`hamiltonian_problem`     which boundary conditions have they, and how are they solved?
`followed_solutions`      from which first guess does a solution get there?
`reversed_motion`         what is the way up of particles, nearly, where the way down is known?
`tubes`                   where does a path leave a cycle, or arrive at one?
`cycle_ways`              which ways lead out of cycles, over cycles, and into them?
`turnover`                do states that turn about a well leave it as the law of escape says?
`rates`                   how often is a well left, prefactor included?
`prefactor_errors`        how sure is that prefactor?
`dwell_times`             how long does a well last, and how sure is that?
`transitions`             which barriers part the wells, how sure are they, and what does a way out look like?
`global_quasipotential`   what is U over all wells?
`landscape`               all of this of one vector field: what can be asked of it?
`finding`                 how is it found, and what is it put together from?
`refusal`                 why is there none, and what is known all the same?
`storage`                 how is it kept in a file?
`block_quadrature`        what is the integral of exp(-U/ε) over a box?
`invariant_distribution`  which density follows from one formula of U?
`density_of_wells`        and which from several wells, where U is known in part?
`ensembles`               where are walkers after a long time?
`predicted_visits`        how long do visits to wells last, core to core, and where are states meanwhile?
`record_test`             does the record hop, and spread, as what was identified foresees?
`reference`               what do methods say of it that share no code with ours?
`comparison`              how far is it from them?
`beside_equations`        and from the landscape of the equations behind the trajectories?
========================  ====================================================================================

Imports `siq.certificate` and what it may import.
"""
