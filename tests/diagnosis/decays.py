"""A decay of a single state, which tests add something to."""

from __future__ import annotations

from siq.systems.diffusion import Diffusion
from siq.systems.dynamics import Dynamics, Parameter, symbol

X = symbol("x")
DECAY = Dynamics(
    ("x",),
    (-symbol("k") * X,),
    Diffusion.identity(1),
    parameters=(Parameter("k", 1.2),),
    outputs=(("x", X),),
)
