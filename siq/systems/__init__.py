"""Systems: drift and noise as one object, from cards to simulations, escapes, cycles and bifurcations."""
