"""The loss of the decomposition (paper, Eq. loss), one value for every run."""

from __future__ import annotations

from siq.errors import needs_extra
from siq.networks.networks import Components

with needs_extra("networks"):
    import torch
    from torch import Tensor


def dynamics_loss(
    predicted: Tensor, observed: Tensor, precision: Tensor, *, slow: Tensor | None = None
) -> Tensor:
    """Mean square of the mismatch of velocities, measured in the metric of the noise.

    Parameters
    ----------
    predicted, observed
        Velocities, shape ``(runs, n, d)``.
    precision
        D⁻¹, shape ``(d, d)``; the paper has D = 1.
    slow
        Square of the speed, shape ``(runs, 1)``, below which a pair counts as slow. If given, every mismatch
        is divided by the square of its observed speed plus this; the paper does not.

    Returns
    -------
    torch.Tensor
        Shape ``(runs,)``.
    """
    mismatch = predicted - observed
    square = ((mismatch @ precision) * mismatch).sum(dim=-1)
    if slow is not None:
        square = square / (((observed @ precision) * observed).sum(dim=-1) + slow)
    return square.mean(dim=-1)


def orthogonality_loss(
    components: Components, diffusion: Tensor, precision: Tensor, *, asymmetry: float
) -> Tensor:
    """Mean of w(z, δ), z being the cosine of the angle between ∇V and g.

    The angle is taken in the metric of the noise: ``z = ∇V·g / sqrt(∇V·D∇V  g·D⁻¹g)``, which does not
    change when the states change their units. ``w(z, δ) = z²`` for z ≥ 0 and ``δ z²`` for z < 0.

    Parameters
    ----------
    components
        The decomposition on the representative points.
    diffusion, precision
        D and D⁻¹, shape ``(d, d)``.
    asymmetry
        δ.

    Returns
    -------
    torch.Tensor
        Shape ``(runs,)``.
    """
    gradient, circulatory = components.gradient, components.circulatory
    product = (gradient * circulatory).sum(dim=-1)
    downhill_square = ((gradient @ diffusion) * gradient).sum(dim=-1)
    circulatory_square = ((circulatory @ precision) * circulatory).sum(dim=-1)
    # Both vectors may vanish (g does everywhere in a gradient system): no angle, no penalty.
    # The roots are taken apart, for the product of the squares would underflow in single precision.
    tiny = torch.finfo(product.dtype).tiny
    lengths = downhill_square.clamp_min(tiny).sqrt() * circulatory_square.clamp_min(tiny).sqrt()
    cosine = product / lengths
    return (torch.where(cosine < 0, asymmetry * cosine, cosine) * cosine).mean(dim=-1)
