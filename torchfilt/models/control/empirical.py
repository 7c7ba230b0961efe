"""Observability of nonlinear laws by experiment: what small changes of the state change in the measurements."""

import math
from typing import NamedTuple

import torch
from torch import Tensor

from torchfilt.gaussian import Gaussian
from torchfilt.laws import check_finite
from torchfilt.linalg import whiten
from torchfilt.model import StateSpaceModel

Step = Tensor | float | None


class Empirical(NamedTuple):
    """What the measurements of a run say about the state at its start.

    sensitivity (*batch, t * m, e): of all measurements, in their standard deviations, to the error of that state;
    gramian (*batch, e, e): its square, the empirical observability Gramian.

    Without process noise that is the information about the state at the start that the measurements carry; its inverse
    is the Cramer-Rao bound. Take the sensitivity for ranks: squares lose half of the digits.
    """

    sensitivity: Tensor
    gramian: Tensor


def empirical_gramian(
    model: StateSpaceModel,
    x0: Tensor,
    controls: Tensor | None = None,
    dt: Step = None,
    scale: Tensor | float = 1e-4,
    *,
    steps: int | None = None,
    predict_first: bool = True,
) -> Empirical:
    """Sensitivities by central differences of the means of both laws, noise left out, all 2 e runs as one batch.

    Each error of the state at the start is put in by the retraction of its space; measurements are told apart by the
    local map of theirs. Exact for linear laws, else the differences are those of the scale: to its square for small
    ones, and for large ones what a cloud of that size sees.

    Args:
        model: any laws on any spaces.
        x0: (*batch, d) state before the first measurement.
        controls: (t, *batch, k), or None for laws without.
        dt: time steps, s: number, (t,) or (t, *batch).
        scale: size of the perturbation of each error, number or (e,); positive, in the states' units.
        steps: t, where there are no controls.
        predict_first: as in the filters' call: each step moves and then measures; False leaves the first motion out.

    Returns:
        `Empirical`.

    Raises:
        TypeError: no model, no tensor, dtypes. ValueError: shapes, NaN, a scale or time step out of range, controls and
            steps that disagree, a measurement without noise, a run that leaves what is finite.

    Source: Lall, Marsden and Glavaski, A subspace approach to balanced truncation (2002), with unit rotations; Krener
        and Ide, Measures of unobservability (2009).
    """
    if not isinstance(model, StateSpaceModel):
        raise TypeError(f"model must be a StateSpaceModel, got {type(model).__name__}")
    space = model.prior().space
    sizes = _check(model, x0, controls, scale)
    count = _count(controls, steps)
    times = _times(dt, count, x0)
    e = len(sizes)
    shift = torch.diag(sizes)
    shifts = torch.cat([shift, -shift, torch.zeros_like(shift[:1])])
    x = space.retract(x0.unsqueeze(-2).expand(*x0.shape[:-1], 2 * e + 1, -1), shifts)
    move, measure = model.moments("transition"), model.moments("observation")
    blocks = []
    for k in range(count):
        u = None if controls is None else controls[k].unsqueeze(-2)
        if k or predict_first:
            x = move(x, u, times[k]).mean
        blocks.append(_differences(measure(x, u, times[k]), e) / (2 * sizes))
    sensitivity = torch.cat(blocks, -2)
    bad = ~torch.isfinite(sensitivity.detach())
    if bad.any():
        row = int(bad.nonzero()[0][-2])
        step = row * count // sensitivity.shape[-2]
        raise ValueError(
            f"sensitivities must be finite, they are not at step {step}: the run diverged, or scale is too large"
        )
    return Empirical(sensitivity, sensitivity.mT @ sensitivity)


def _differences(law: Gaussian, e: int) -> Tensor:
    """Measurements of +, - and unperturbed runs (*batch, 2 e + 1, m) as whitened differences (*batch, m, e)."""
    mean = law.mean
    centre = mean[..., -1:, :]
    apart = law.space.local(centre, mean[..., :-1, :])
    apart = apart[..., :e, :] - apart[..., e:, :]
    factor = law.scale_tril
    own = 1 if law.is_diagonal else 2
    if factor.dim() > own and factor.shape[-own - 1] > 1:  # noise that depends on the state: that of the centre
        factor = factor.narrow(-own - 1, 2 * e, 1)
    deviation = factor if law.is_diagonal else factor.diagonal(dim1=-2, dim2=-1)
    if not bool((deviation.detach() != 0).all()):
        raise ValueError("measurements must have noise in all components: sensitivities are counted in deviations")
    return whiten(factor, apart, diagonal=law.is_diagonal).mT


def _check(model: StateSpaceModel, x0: Tensor, controls: Tensor | None, scale: Tensor | float) -> Tensor:
    """Perturbations (e,)."""
    prior = model.prior()
    if not isinstance(x0, Tensor):
        raise TypeError(f"x0 must be a tensor (*batch, d), got {type(x0).__name__}")
    if x0.dtype != prior.mean.dtype:
        raise TypeError(f"x0 must have the model's dtype {prior.mean.dtype}, got {x0.dtype}")
    if x0.shape[-1:] != prior.mean.shape[-1:]:
        raise ValueError(f"x0 must be (*batch, {prior.mean.shape[-1]}), got shape {tuple(x0.shape)}")
    check_finite(x0, "x0")
    if controls is not None:
        if controls.dtype != x0.dtype:
            raise TypeError(f"controls must have the model's dtype {x0.dtype}, got {controls.dtype}")
        if controls.shape[1:-1] != x0.shape[:-1]:
            lead = ", ".join(["t", *map(str, x0.shape[:-1])])
            raise ValueError(f"controls must be ({lead}, k), got shape {tuple(controls.shape)}")
        check_finite(controls, "controls")
    sizes = torch.as_tensor(scale, dtype=x0.dtype, device=x0.device)
    e = prior.tangent_size
    if sizes.shape not in ((), (e,)) or not bool(((sizes > 0) & torch.isfinite(sizes)).all()):
        raise ValueError(f"scale must be a positive finite number or {e} of them, got {sizes.tolist()}")
    return sizes.expand(e)


def _count(controls: Tensor | None, steps: int | None) -> int:
    given = {len(controls)} if controls is not None else set()
    given |= {steps} if steps is not None else set()
    if len(given) != 1 or min(given) < 1:
        got = None if controls is None else len(controls)
        raise ValueError(f"give controls of at least one step, or steps; got {got} controls and steps={steps}")
    return given.pop()


def _times(dt: Step, count: int, x0: Tensor) -> list[Tensor | float | None]:
    """Time step of each step, with room for the points."""
    if not isinstance(dt, Tensor):
        if dt is not None and not 0 <= dt < math.inf:
            raise ValueError(f"dt must be finite and >= 0, got {dt}")
        return [dt] * count
    dt = dt.expand(count) if dt.dim() == 0 else dt
    if dt.shape not in ((count,), (count, *x0.shape[:-1])):
        raise ValueError(f"dt must be a number, ({count},) or {(count, *x0.shape[:-1])}, got {tuple(dt.shape)}")
    if not bool(((dt >= 0) & torch.isfinite(dt)).all()):
        raise ValueError(f"dt must be finite and >= 0, got {dt.tolist()}")
    return list(dt.tolist()) if dt.dim() == 1 else list(dt[..., None, None])
