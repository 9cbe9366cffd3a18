"""The diagnosis beside what others would do, on the same concealed cases and within the same time.

    make discrepancies

=============  ===============================================================================
`cases`        which cases are there, and how are their keys made again?
`answers`      what does a method say of a case?
`added`        what can a method add to the equations of a card?
`states`       which states, and which derivatives, can be had from what was measured?
`regression`   which terms of a library explain what a card leaves over?
`refit`        of what was found, what is kept?
`sindy`        sparse regression of derivatives, plain and in its weak form
`gaussian`     Gaussian processes of what is left over
`segments`     recordings in short segments, for training through an integrator
`universal`    a universal differential equation: a network within the equations
`ours`         `siq` itself
`methods`      all of them by name, and how one is run within its time
`asking`       every method asked about every case
`simulation`   how does a card with something added run freely?
`truth`        what is concealed, as a polynomial, and what does an oracle do?
`scores`       what of an answer is right? One row a case and method
`summary`      the table of all of them
`figure`       and a picture
`__main__`     the command
=============  ===============================================================================

Methods see the files of a case and nothing else: keys are made again when every method has answered.
"""
