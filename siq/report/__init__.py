"""Results for readers: summaries, sentences from templates, tables, figures, pages.

`summary` is what is told and drawn of a landscape; `landscape` tells it, as text and in tables; `study_page`
and `diagnosis_page` are the pages of a study and of a diagnosis, of which the latter makes its sentences;
`page` places figures and makes HTML that needs nothing else; `plots` draws; `formatting` writes numbers and
formulas. Sentences stand in `templates`.
"""
