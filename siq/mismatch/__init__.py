"""When simulation and recordings differ: locate the mismatch, name the physics left out, model it.

`siq.diagnose` takes a simulation and recordings, and answers with everything that is reported. Imports
`siq.estimation`, `siq.landscape` and what they may import.

===================  ========================================================================
`diagnosis`          what does a simulation lack? (`siq.diagnose`)
`case`               what is compared with what?
`study`              which recordings are held out, what is known of their noise?
`search_options`     what counts as found?
`dictionary`         which mechanisms have a name?
`roles`              what is each state: a position, a population, a level?
`assignments`        who can fill the roles of a mechanism?
`building`           what does a mechanism become in this simulation?
`recalibrations`     which mechanisms are no more than other values of its parameters?
`candidates`         what would each mechanism change in this simulation?
`units`              in which units are its parameters?
`places`             at which values of a shape does a search begin?
`probes`             what does a little of each do to what is measured?
`screening`          how much would each candidate gain, to first order?
`promises`           and which promise most, wherever their shapes may be?
`tried`              what came of one that was tried?
`trials`             how much do they explain in earnest?
`clusters`           does it stand, whatever errors within a recording are like?
`found`              what has a search found?
`acceptance`         which of the mechanisms that were tried count as found?
`on_top`             what does a mechanism become on top of others?
`search`             and in which order are they looked for?
`structure`          along which coordinates is something missing?
`remainder`          what do the mechanisms leave?
`rounded`            do the steps in which sensors read explain it?
`steadiness`         are random forces those of surroundings?
`function_places`    where may a function without a name stand?
`evidence`           is a mechanism likelier than such a function?
`matches`            how often do mechanisms explain as much by chance?
`naming`             which of the mechanisms found may be named?
`functions`          what is a function without a name, as a formula?
`nameless_models`    what is a model of what has no name, and how likely?
`likely_places`      where is a function likeliest, and which powers does it need?
`fitted_parts`       what does a part of a description explain, fitted in earnest?
`grounds`            where may a smooth function stand?
`smooth_functions`   what is a smooth function, and what is expected of it?
`product_functions`  what is a product of two of them?
`smoothness`         over which lengths does it change, and how large is it?
`fitted_smooth`      which smooth function fits best, of one coordinate or of two?
`fitted_functions`   which functions, as formulas or smooth, fit best?
`memories`           does what is missing depend on what was?
`beside`             is a mechanism likelier where a function models the rest?
`described`          which of these models are candidates for the new card?
`names`              what is named, and what models the rest?
`possible_verdicts`  what may a diagnosis end with?
`investigation`      what is the verdict, and which fits does it rest on?
`location`           where does the mismatch sit?
`runs_alike`         how are several simulations run, so that their errors compare?
`left_out`           does a model foresee what was left out of its fit?
`held_out_errors`    which of two simulations foresees recordings better?
`adoption`           which model of what has no name becomes a part of the new card?
`held_out`           how well does it run on recordings that had no part in it?
`withdrawal`         does a name mislead there?
`verdict`            what is the verdict?
`stated_parts`       what is stated of a part of what is missing?
`statement`          what is stated, and as data?
`stated_functions`   what is stated of a model without a name?
`part_words`         how is a part of what is missing called?
`error_sentences`    what is said of the error on recordings held out?
`sentences`          and how would a colleague say it?
`augmented`          what is the simulation with what was found?
`tables`             which tables are figures drawn from?
`scores`             how large are errors in the recordings' own units?
`official_tests`     and in the official tests of benchmarks, beside those of others?
`consequences`       what does it do to wells and escape times?
===================  ========================================================================
"""
