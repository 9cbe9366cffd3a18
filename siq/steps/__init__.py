"""Steps: what does each part of the pipeline take, and what does it give?

Each step is a module with its settings, a frozen object that holds all that the step depends on, and a
function ``run(settings, data)`` that returns a frozen result. Reading and writing stand beside it: ``read``
and ``write``. The rules of the workflow add nothing but files; `siq.steps.pipeline` chains the same
functions in memory.

Import the step that you mean, ``from siq.steps import identify``: this package loads none by itself, so that
a change of one step makes nothing again that does not use it. It may import everything below it, and nothing
of `siq.report` or `siq.cli`.

======================  =================================================================================
module                  question
======================  =================================================================================
draw                    which trajectories has a run?
identify                which f do its pairs show, and does it predict recordings that were held out?
identify_beside_sensor  the same, where the sensor is noisy: when, and what is kept of it?
identify_from_earlier   the same, where the recordings remember: which samples tell, and what is kept?
identify_hidden         and where they are positions whose velocities were not recorded?
train                   which V and g do two networks find?
regress                 which sparse formulas are these (the published method)?
refine                  which V solves the Hamilton–Jacobi equation of f, and may it be believed?
ground                  what has a run to refine V by?
refined_routes          what do the routes to V make of it?
control                 and what would they have made of networks with random weights?
landscape               which wells, barriers and ways are there?
equations               what landscape have equations alone?
sweep_points            which wells and ways have they at other values of their parameters?
sweep_wells             which of their attractors are one and the same well?
sweep_rows              how deep are these, and how long do they last?
sweep_maps              along which curves do they fold in the plane of two parameters?
sweep                   and what is seen against a control parameter, or two?
tipping                 how likely has a well been left while the parameter drifts?
score                   how far is all this from exact answers, where these are known?
overview                which landscape does the page open with?
collect                 what do all runs say together?
reference               what do methods say of a card that share nothing with ours?
landscape_errors        how far are the landscapes from these references?
beside_equations        and how far from the landscape of the card's own equations?
escapes                 does a direct simulation leave the wells as the law says?
invariant               which invariant distribution follows, and is it that of a long simulation?
pipeline                all of a run, in memory
outcomes                what became of a step?
settings, of_study      what are several steps told alike, and how does a study say it?
shown                   which run stands for all of them?
training_block          how do runs train side by side, and what does a killed job go on from?
trained, landscapes     how do later steps read networks and landscapes?
record_tables           which rows does the test against the record give?
landscape_tables        which rows of tables does a landscape give?
======================  =================================================================================
"""
