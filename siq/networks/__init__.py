"""The published method: orthogonal decomposition f = -D∇V + g by two tanh networks (paper, section 2.2)."""
