"""What is asked of which data, how well was it answered, and what was published?

===================  ==============================================================
`study`              what does a study ask, with which parameters at every step?
`study_system`       which system has it, and does what it asks fit that system?
`sweep`              which values does a study give a control parameter?
`scoring`            how close are the formulas to exact answers?
`published_figures`  which numbers did somebody publish, to be set beside ours?
`published`          what did somebody publish, as formulas and on a mesh?
`reproduction`       which numbers has a publication, and what are ours?
`tables`             how are tables kept in files?
===================  ==============================================================

Imports `siq.mismatch` and what it may import.
"""
