"""Small tables in ``tests/golden`` of what a known state of the code gives, and a change has to reproduce."""
