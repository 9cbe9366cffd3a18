"""When simulation and recordings differ: locate the mismatch, name the physics left out, model it."""
