"""Validation by methods that share no code with those they check: meshes, known systems."""
