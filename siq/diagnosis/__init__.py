"""Diagnosis: where a simulation and recordings differ, and which physics was left out.

- `study`, `dictionary`, `mechanisms`: what is compared; mechanisms written for roles, and built into models.
- `screening`, `search`: what a little of each term would gain, by a judge; fitting mechanisms one by one.
- `terms`, `smooth_functions`, `unnamed_models`: unknown functions, curves, surfaces and memories.
- `residual_structure`, `evidence`, `holdout`: what residuals show, likelihood and chance, prediction.
- `forecasts`: explanations judged by how well they foresee parts that were left out, in families.
- `naming`, `investigation`: which mechanisms may be named; all of it for one case.
- `statement`, `verdict`, `diagnosis`: what is stated, as data and as an object with answers.
"""
