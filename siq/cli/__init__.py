"""The command ``siq``: how are a study, recordings or a folder of cases answered with one line in a terminal?

===========  ===============================================================================
`main`       what can be written after ``siq``, and with which code does it end?
`run`        how does a file, a study or a folder become a page?
`workflow`   where is the workflow, is all installed that it needs, and how is it started?
`progress`   what is it doing, how much is left, and why did it stop?
`answers`    what came of it, in one sentence?
`studies`    which study belongs to a file of recordings?
`examples`   what can be tried without recordings of one's own?
===========  ===============================================================================

The only package that knows of Snakemake and of the folder ``results``. Imports `siq.report` and what it may
import.
"""
