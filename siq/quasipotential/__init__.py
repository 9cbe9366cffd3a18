"""The quasipotential: V about attractors, paths, rates, densities, landscapes, and their certificate."""
