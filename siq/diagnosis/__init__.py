"""Diagnosis: where a simulation and recordings differ, and which physics was left out."""
