"""Ranges to beacons: distances by hand, directions by autodiff, refusals."""

import math
import re

import numpy as np
import pytest
import torch

from torchfilt.models.sensors.ranges import BeaconRanges
from torchfilt.testing import check_law

DOUBLE = torch.float64
BEACONS = torch.tensor([[0.5, 0.5, 7.0], [39.5, 0.5, 7.8], [20.0, 19.5, 7.2]], dtype=DOUBLE)


def states(rows=4, size=18):
    x = torch.tensor(np.random.default_rng(0).standard_normal((rows, size)))
    x[:, :4] = torch.nn.functional.normalize(x[:, :4], dim=-1)
    return x


@pytest.mark.parametrize("position", [7, 13])
def test_ranges_are_distances(position):
    law, x = BeaconRanges(BEACONS, 0.03, position=position), states()
    for row, found in zip(x, law(x).mean, strict=True):
        place = row[position : position + 3].tolist()
        np.testing.assert_allclose(found, [math.dist(place, beacon) for beacon in BEACONS.tolist()], rtol=1e-14)
    _, slope = law.first_order(x)
    for row, found in zip(x, slope, strict=True):
        whole = torch.func.jacfwd(lambda v: law(v).mean)(row)
        np.testing.assert_allclose(found, whole[:, 1:], atol=1e-14)  # no range looks at the quaternion
    assert law.size == 3 and law(x).scale_tril.tolist() == [0.03] * 3
    check_law(law, x)


def test_at_a_beacon_nothing_is_lost():
    law, x = BeaconRanges(BEACONS, 0.03), states(1, 16)
    x[0, 7:10] = BEACONS[1]
    found, slope = law.first_order(x)
    assert found.mean[0, 1] < 1e-15 and torch.isfinite(slope).all() and (slope[0, 1] == 0).all()


def test_single_precision_and_a_trained_deviation():
    sd = torch.nn.Parameter(torch.tensor(0.1))
    law = BeaconRanges(BEACONS.float(), sd)
    law(states().float()).scale_tril.sum().backward()
    assert law(states().float()).mean.dtype == torch.float32 and sd.grad == 3


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ((BEACONS[0], 0.1), "beacons_m must be (b, 3) with b >= 1, got (3,)"),
        ((BEACONS[:0], 0.1), "beacons_m must be (b, 3) with b >= 1, got (0, 3)"),
        ((BEACONS * math.nan, 0.1), "beacons_m must be finite"),
        ((BEACONS, 0.0), "sd_m must be one positive finite number, got 0.0"),
        ((BEACONS, torch.ones(3)), "sd_m must be one positive finite number"),
    ],
)
def test_refusals(given, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        BeaconRanges(*given)


def test_refuses_states_and_places():
    with pytest.raises(ValueError, match="behind the quaternion, 4 or more, got 3"):
        BeaconRanges(BEACONS, 0.1, position=3)
    with pytest.raises(ValueError, match=re.escape("10 numbers or more, got (4, 9)")):
        BeaconRanges(BEACONS, 0.1)(states(size=9))
