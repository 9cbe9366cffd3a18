"""Which drift and which noise do recordings show?

======================  ===========================================================================
`identification`        which terms has f?
`selection`             which terms does noise allow for?
`rival_terms`           which others would do nearly as well, and what do they make of f?
`stability`             in how many resampled recordings would each term be chosen?
`flow_regression`       which coefficients of given terms make f lead from X0 to Xh?
`identified_field`      what is known of the f that was found, errors included?
`given_field`           and of one that was given?
`library`               which candidate functions are there, with which derivatives and constraints?
`flow`                  where does f lead within the step of a pair?
`diffusion`             which D, where nobody gave it?
`random_forces`         how strong are the random forces behind residuals of a whole step?
`noisy_sensor`          which f do recordings show whose sensor is noisy?
`filtered_terms`        which terms does the likelihood of a filter ask for?
`hidden_velocities`     which f(x, v) do recordings of positions alone show?
`inertia`               do positions have inertia: is velocity a state of its own?
`velocities`            how are velocities told that nobody measured?
`seen_states`           how do samples show the states?
`filtered_states`       what does such an f say of held-out recordings, and of the states themselves?
`exposure`              what does a sample tell that is a mean over its step?
`residuals`             what do its residuals say: no noise, process noise, noise of the measurement?
`lagged_pairs`          which f, where recordings remember for some steps?
`memory`                and what has to be said of that?
`rounding`              were values rounded when they were written, and does it matter?
`prediction`            where does f lead in the long run?
`noise_formula`         what is known of a D that is a formula of the states, errors included?
`noise_regression`      does the noise depend on the state, and by which formula?
`noise_selection`       and with which terms?
`noise_beside_sensor`   the same, where the sensor is noisy
`weighted_regression`   which f, where the noise is stronger here than there?
`storage`               how is it kept in a file?
======================  ===========================================================================

Imports `siq.estimation` and what it may import.
"""
