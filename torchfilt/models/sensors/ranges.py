"""Ranges to beacons at known places, such as ultrasonic ones on the walls of a hall."""

import torch
from torch import Tensor, nn
from torch.nn.functional import pad

from torchfilt.gaussian import Gaussian
from torchfilt.laws import check_finite, hold, one_number

Step = Tensor | float | None


class BeaconRanges(nn.Module):
    """Distances, m, from a position to b beacons, in the axes of the local frame.

    At a beacon itself the distance has no derivative; a nanometre from it the law is as smooth as far away.

    Args:
        beacons_m: (b, 3) places. sd_m: standard deviation of each range, number or scalar tensor (a parameter trains).
        position: index of the first of the three coordinates in the state.

    Raises:
        ValueError: shape, numbers that are not finite, a deviation that is not one positive finite number, an index
            below 4; when called, a state without the position.
    """

    beacons: Tensor
    deviation: Tensor

    def __init__(self, beacons_m: Tensor, sd_m: Tensor | float, *, position: int = 7) -> None:
        super().__init__()
        if beacons_m.dim() != 2 or beacons_m.shape[1] != 3 or len(beacons_m) == 0:
            raise ValueError(f"beacons_m must be (b, 3) with b >= 1, got {tuple(beacons_m.shape)}")
        check_finite(beacons_m, "beacons_m")
        deviation = one_number(sd_m, "sd_m", dtype=beacons_m.dtype)
        if position < 4:
            raise ValueError(f"position must be an index behind the quaternion, 4 or more, got {position}")
        self.size, self.position = len(beacons_m), position
        hold(self, "beacons", beacons_m)
        hold(self, "deviation", deviation)

    def forward(self, x: Tensor) -> Gaussian:
        """Law of the ranges (..., b) at states (..., d)."""
        return self._law(self._apart(x)[0])

    def first_order(self, x: Tensor, u: Tensor | None = None, dt: Step = None) -> tuple[Gaussian, Tensor]:
        """The law at x and its derivative (..., b, d - 1): the directions from the beacons."""
        distance, apart = self._apart(x)
        at = self.position - 1
        return self._law(distance), pad(apart / distance.unsqueeze(-1), (at, x.shape[-1] - 4 - at))

    def _law(self, distance: Tensor) -> Gaussian:
        return Gaussian(distance, self.deviation.to(distance.dtype).expand(self.size), is_diagonal=True)

    def _apart(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Distances (..., b), and vectors (..., b, 3) from the beacons."""
        if x.shape[-1] < self.position + 3:
            raise ValueError(f"the state must have {self.position + 3} numbers or more, got {tuple(x.shape)}")
        apart = x[..., None, self.position : self.position + 3] - self.beacons.to(x.dtype)
        tiny = torch.finfo(x.dtype).eps ** 2
        return (apart.square().sum(-1) + tiny).sqrt(), apart
