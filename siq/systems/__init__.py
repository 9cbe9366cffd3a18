"""Systems: drift and noise as one object, from cards to simulations, equilibria, cycles and bifurcations."""
