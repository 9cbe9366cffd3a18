"""Records whose truth is not what a certificate would claim of them, and honest ones that look alike.

python -m benchmarks.hostile [--kinds NAME ...] [--seeds 0 1 ...] [--strengths 0.2 0.5 1]
"""
