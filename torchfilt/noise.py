"""Random numbers as tensors, a pure function of (seed, step, purpose)."""

import math
from functools import lru_cache
from typing import NamedTuple

import torch
from torch import Tensor

_MASK = (1 << 64) - 1
_WORD = (1 << 32) - 1

STREAMS = 16
"""Purposes a step can tell apart, numbered from 0."""


def _mix(value: int) -> int:
    """SplitMix64 finaliser: neighbouring inputs give unrelated seeds. Source: Steele, Lea, Flood, OOPSLA 2014."""
    value = (value + 0x9E3779B97F4A7C15) & _MASK
    value = ((value ^ (value >> 30)) * 0xBF58476D1CE4E5B9) & _MASK
    value = ((value ^ (value >> 27)) * 0x94D049BB133111EB) & _MASK
    return value ^ (value >> 31)


def _permute(word: int, key: int) -> int:
    """One of many shuffles of the 32-bit numbers, chosen by a 64-bit key: no two words meet.

    Source: the finaliser of MurmurHash3 (Appleby, 2011), a chain of invertible steps.
    """
    for part in (key & _WORD, key >> 32):
        word ^= part
        word = ((word ^ (word >> 16)) * 0x85EBCA6B) & _WORD
        word = ((word ^ (word >> 13)) * 0xC2B2AE35) & _WORD
        word ^= word >> 16
    return word


@lru_cache(maxsize=64)
def _keys(seed: int) -> tuple[int, int]:
    key = _mix(seed & _MASK)
    return key, _mix(key)


# Fewer numbers than this are drawn by torch itself in fewer calls; so many fit in the processor's cache.
_FEW, _BLOCK = 2048, 1 << 15


def _normals(shape: tuple[int, ...], generator: torch.Generator, dtype: torch.dtype, device: torch.device) -> Tensor:
    """Standard normals; in double precision on a processor by Box and Muller's transform, half the time of torch's own.

    Source: Box and Muller, A note on the generation of random normal deviates, Ann. Math. Statist. 29 (1958).
    """
    count = math.prod(shape)
    if dtype != torch.float64 or device.type != "cpu" or count < _FEW:
        return torch.randn(shape, generator=generator, dtype=dtype, device=device)
    half = (count + 1) // 2
    normals = torch.empty(2, half, dtype=dtype)
    for start in range(0, half, _BLOCK):
        part = normals[:, start : start + _BLOCK]
        uniform = torch.rand(part.shape, generator=generator, dtype=dtype)
        radius = uniform[0].neg_().log1p_().mul_(-2).sqrt_()  # 1 - u is never zero
        angle = uniform[1].mul_(2 * math.pi)
        torch.cos(angle, out=part[0])
        torch.sin(angle, out=part[1])
        part.mul_(radius)
    return normals.view(-1)[:count].view(shape)


class NoiseSource(NamedTuple):
    """Stateless source: the same (seed, step, stream) gives the same numbers, in any order, whatever the thread count.

    ``fast_normals`` draws float64 normals as float32 and casts them: another 2.7 times cheaper, 24-bit resolution.
    """

    seed: int = 0
    fast_normals: bool = False

    def generator(self, step: int, stream: int, device: torch.device) -> torch.Generator:
        """A fresh generator for this step and purpose; the global generator is never touched."""
        return torch.Generator(device).manual_seed(self.seed_of(step, stream))

    def seed_of(self, step: int, stream: int) -> int:
        """Seed for a sampler that draws by itself, in [0, 2^63).

        The generator of the CPU reads the low 32 bits only: of 80,000 seeds taken at random two would be equal more
        often than not. Here all steps below 2^28 and all streams of one seed differ in them.

        Raises:
            ValueError: stream outside [0, 16).
        """
        if not 0 <= stream < STREAMS:
            raise ValueError(f"stream must be in [0, {STREAMS}), got {stream}")
        key, shuffle = _keys(self.seed)
        low = _permute((step * STREAMS + stream) & _WORD, shuffle)
        return (_mix(_mix(key ^ (step & _MASK)) ^ stream) >> 33) << 32 | low

    def normal(self, shape: tuple[int, ...], step: int, stream: int, like: Tensor) -> Tensor:
        """Standard normals of ``shape`` (*batch, n, d), laid out component by component in memory."""
        return self.next_normal(shape, self.generator(step, stream, like.device), like)

    def next_normal(self, shape: tuple[int, ...], generator: torch.Generator, like: Tensor) -> Tensor:
        """The same from a generator of this source that other draws may have used before."""
        draw_dtype = torch.float32 if self.fast_normals else like.dtype
        draws = _normals((shape[-1], *shape[:-1]), generator, draw_dtype, like.device)
        return draws.to(like.dtype).movedim(0, -1) if draws.dim() != 2 else draws.to(like.dtype).mT

    def uniform(self, shape: tuple[int, ...], step: int, stream: int, like: Tensor) -> Tensor:
        """Uniforms in [0, 1) of ``shape``, float64: resampling positions need the resolution."""
        generator = self.generator(step, stream, like.device)
        return torch.rand(shape, generator=generator, dtype=torch.float64, device=like.device)
