"""Results for readers: summaries, sentences from templates, tables, figures, pages.

`summary` is what is told and drawn of a landscape; `landscape` tells it, as text and in tables; `study_page`
and `diagnosis_page` are the pages of a study and of a diagnosis; `figures` are those of a study, `plots` what
they are drawn by; `page` makes HTML that needs nothing else; `formatting` writes numbers and formulas, and
`remarks` the sentences of codes. Sentences stand in `templates`.
"""
