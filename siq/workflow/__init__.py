"""Studies and the steps that answer them: typed functions from settings and inputs to results."""
