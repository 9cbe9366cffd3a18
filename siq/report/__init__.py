"""How do people read the results? Sentences, typeset formulas, figures, pages.

=======================  ======================================================================
`formatting`             how is a formula written for a reader?
`landscape_text`         how does a landscape read, as text and in a notebook?
`diagnosis_report`       and a diagnosis?
`sentences`              what do all runs say together, in words?
`said_landscape`         how is a landscape told: letters, units, errors, times?
`landscape_answer`       what is the answer in one sentence?
`certificate_text`       what does the certificate promise, in plain words?
`answer`                 and as plain data, for a terminal?
`drawn_landscape`        what of a landscape is drawn?
`interactive`            how is U turned and cut in a page?
`projection`             what of many states is drawn on a plane?
`page`                   what is a page made from, that needs nothing else?
`rendering`              how does it become HTML?
`settings`               what do figures and pages of a study depend on?
`study_page`             what does the page of a study say, in which order?
`equations_page`         and that of given equations?
`sweep_section`          and what does it say of a control parameter?
`inspection_section`     what is in the recordings, first of all?
`study_results`          what did a study leave behind, and what of it is shown?
`formula_section`        what does its page say of the formulas?
`evidence_section`       and of how far they can be trusted?
`workings_section`       and of how they were worked out?
`study_sections`         and in each of its other parts?
`study_formulas`         which formulas?
`study_runs`             which tables of several runs?
`study_captions`         what do its figures show, and where do they stand?
`study_figures`          and which figures has it?
`landscape_tables`       what does it say of the landscape?
`beside_equations`       and of that of the card's own equations?
`landscape_figures`      and which figures of it?
`record_answer`          what does it say of the record's own hops?
`invariant_tables`       what does it say of the invariant distribution?
`reproduction_page`      what does the page say that lists a publication's results beside ours?
`mismatch_page`          what does the page of a diagnosis say?
`largest_difference`     where do a simulation and held-out recordings differ most?
`mismatch_first_screen`  and what does it open with?
`mismatch_formulas`      which formulas are missing?
`mismatch_evidence`      how sure is it?
`mismatch_sections`      and which other sections has it?
`mismatch_captions`      what do its figures show?
`mismatch_findings`      what is it made from?
`mismatch_answer`        and what does a terminal print at its end?
`official_tests`         and what do official tests of benchmarks say, in one table?
`plots`                  the figures themselves
=======================  ======================================================================

Imports everything below `siq.cli`.
"""
