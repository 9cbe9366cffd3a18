"""An f that is given by its equations: nothing of it was estimated, and nothing of it is uncertain.

Certificates and transitions take an `AnyField`: an identified f with its uncertainty, or this.
"""

from __future__ import annotations

from dataclasses import dataclass

from siq.dynamics.diffusion import Diffusion
from siq.dynamics.dynamics import Dynamics
from siq.identify.identified_field import IdentifiedField


@dataclass(frozen=True, eq=False)
class GivenField:
    """f and D as somebody gave them."""

    dynamics: Dynamics

    @property
    def diffusion(self) -> Diffusion:
        """D."""
        return self.dynamics.diffusion


AnyField = IdentifiedField | GivenField
"""f with what is not known of it."""
