"""The published method: orthogonal decomposition f = -D∇V + g by two tanh networks (paper, section 2).

- `siq.networks.networks`: the two networks and their loss (section 2.2).
- `siq.networks.training`: scales, batches, Adam, checkpoints, blocks of runs (section 2.2, Appendix B).
- `siq.networks.decomposition`: options of a training, and the networks of one run after it.
- `siq.networks.regression`: sparse formulas of V, g and f by constrained SR3 (section 2.3, Appendix A).
"""
