"""Does the diagnosis say rightly what a simulation lacks? Cases that conceal something, and their scores.

Nothing here imports what it tests, the search and the verdict of `siq.diagnosis`; and what makes the cases,
`concealment` and `foreign`, imports nothing of `siq` at all.

=================  ===========================================================
`concealment`      what does each case conceal, and what was recorded of it?
`foreign`          which random systems lack a drawn function, and what was recorded of them?
`foreign_scores`   what did a diagnosis say rightly of those?
`batches`          which sets of cases are there, and which cases and keys does one job make?
`keys`             what does a key say?
`oracle`           how well could a diagnosis do?
`scoring`          what did a diagnosis say rightly of one case?
`targets`          and of all of them: which targets are met?
=================  ===========================================================
"""
