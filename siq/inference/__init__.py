"""Inference: vector fields, diffusion and parameters from recordings."""
