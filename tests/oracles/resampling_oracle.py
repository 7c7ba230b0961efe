"""Resampling by its definition: positions on the line, one search each. Exact fractions, no torch."""

from bisect import bisect_right
from fractions import Fraction
from itertools import accumulate


def ends_of(weights):
    """Cumulative weights as fractions of one."""
    exact = [Fraction(w) for w in weights]
    total = sum(exact)
    return [e / total for e in accumulate(exact)]


def at_positions(weights, positions):
    """Particle under each position in [0, 1): the first whose cumulative weight lies above it."""
    ends = ends_of(weights)
    return [bisect_right(ends, p) for p in sorted(positions)]


def systematic(weights, uniforms, m=None):
    m = len(weights) if m is None else m
    return at_positions(weights, [(i + Fraction(uniforms[0])) / m for i in range(m)])


def stratified(weights, uniforms, m=None):
    m = len(weights) if m is None else m
    return at_positions(weights, [(i + Fraction(u)) / m for i, u in enumerate(uniforms[:m])])


def multinomial(weights, uniforms, m=None):
    return at_positions(weights, [Fraction(u) for u in uniforms[: len(weights) if m is None else m]])


def residual(weights, uniforms, m=None):
    """Whole copies, then draws from the fractional parts, in the order of the particles."""
    m = len(weights) if m is None else m
    total = sum(Fraction(w) for w in weights)
    shares = [Fraction(w) * m / total for w in weights]
    counts = [int(share) for share in shares]
    rest = [share - count for share, count in zip(shares, counts, strict=True)]
    left = m - sum(counts)
    if left:
        for k in at_positions(rest, [Fraction(u) for u in uniforms[:left]]):
            counts[k] += 1
    return [k for k, count in enumerate(counts) for _ in range(count)]
