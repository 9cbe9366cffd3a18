"""How likely are recordings under given dynamics, and which parameters fit best?

Imports `siq.dynamics` and what it may import.

===================  ===========================================================================
`measurements`       what was measured, and what drove the system?
`linearisation`      what do small changes of states and parameters do to what is measured?
`kernels`            the same sample after sample, compiled
`innovations`        what does a filter not foresee?
`closure`            what does the spread of a state do to its mean?
`noise`              how strong are the sensors' noise and random forces?
`stretches`          which parts of long recordings are enough to begin with?
`noise_kernel`       the likelihood of both, compiled
`score_kernel`       what does it say of formulas of the noise, compiled?
`budget`             how much work may it take?
`expectations`       what does a card say of parameters that recordings do not tell?
`first_states`       with which states does a fit begin?
`shooting`           where does one step of a fit lead?
`fit`                what is known of a fit?
`estimation`         which parameters, states and noise fit best?
`unknown_forces`     and where nobody knows how strong random forces are?
`noise_uncertainty`  how well is the noise known, and what does that leave open?
`trajectories`       the same, where trajectories may not leave their equations
`trajectory_kernel`  whole trajectories, compiled
`jumps`              how finely must a jump of f be followed?
`process_noise`      does a model need random forces to explain recordings?
`recalibration`      which values of its own parameters make a simulation fit best?
`free_runs`          how far is a simulation off that runs freely?
===================  ===========================================================================
"""
