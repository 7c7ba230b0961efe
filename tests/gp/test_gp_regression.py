"""Marginal likelihood, left-out errors and calibration against GPyTorch and plain numpy; the sparse form."""

import gpytorch
import numpy as np
import pytest
import torch
from gp_problem import P, outputs, queries
from oracles import gp_oracle

from torchfilt.gp.regression import GPRegression, StructuredKernel
from torchfilt.gp.sparse import SparseGPRegression

KERNELS = [("structured", False), ("structured", True), ("ard", False), ("ard", True), ("isotropic", False)]


def prior_of(regression, output):
    z = regression.standardized()[0]
    with torch.no_grad():
        covariance = regression.kernel(z).to_dense()
    return covariance[0 if regression.shared else output].numpy().astype(np.longdouble)


@pytest.mark.parametrize(("kernel", "shared"), KERNELS)
def test_loss_is_the_marginal_likelihood(make, kernel, shared):
    regression = make(kernel, shared, noise=1e-2)
    y = regression.standardized()[1].numpy()
    noise = regression.likelihood.noise.detach().flatten().expand(P).numpy()
    expected = -sum(gp_oracle.log_marginal_likelihood(prior_of(regression, i), y[:, i], noise[i]) for i in range(P))
    assert regression.loss().item() == pytest.approx(expected / len(y), rel=1e-9)
    model = regression.exact_model()
    with gpytorch.settings.fast_computations(False, False, False):
        mll = gpytorch.mlls.ExactMarginalLogLikelihood(model.likelihood, model)
        theirs = -mll(model(*model.train_inputs), model.train_targets).sum()
    assert regression.loss().item() == pytest.approx(theirs.item(), rel=1e-8)


def test_loss_on_a_subset_and_its_gradient(make):
    regression = make(noise=1e-2)
    rows = torch.tensor([1, 4, 7, 20, 33])
    other = GPRegression(regression.state[rows], regression.targets[rows], regression.context[rows])
    other.load_state_dict(
        {**regression.state_dict(), **{n: getattr(other, n) for n in ("state", "targets", "context")}}
    )
    assert regression.loss(rows).item() == pytest.approx(other.loss().item(), rel=1e-12)
    parameters = [p for p in regression.parameters() if p.requires_grad]
    assert len(parameters) == 3
    for parameter, gradient in zip(parameters, torch.autograd.grad(regression.loss(), parameters), strict=True):
        at, step = (0,) * parameter.dim(), 1e-5
        with torch.no_grad():
            parameter[at] += step
            up = regression.loss()
            parameter[at] -= 2 * step
            down = regression.loss()
            parameter[at] += step
        assert gradient[at].item() == pytest.approx(((up - down) / (2 * step)).item(), rel=1e-5, abs=1e-7)


def test_loss_is_nan_and_not_jittered_where_not_definite(make):
    regression = make()
    with torch.no_grad():  # a repeated state under a huge prior: the noise is lost in rounding
        regression.kernel.deviation = regression.kernel.deviation * 1e9
        regression.state[1::2], regression.context[1::2] = regression.state[::2], regression.context[::2]
    assert torch.isnan(regression.loss())
    dense = make("ard")
    with torch.no_grad():
        dense.kernel.outputscale = dense.kernel.outputscale * 1e16
        dense.kernel.base_kernel.lengthscale = 1e4
    with pytest.raises(ValueError, match="raise noise_floor"):
        dense.freeze()


@pytest.mark.parametrize("shared", [False, True])
def test_left_out_errors_and_calibration(make, shared):
    regression = make("structured", shared, count=20, noise=1e-2)
    y = regression.standardized()[1].numpy()
    noise = regression.likelihood.noise.detach().flatten().expand(P).numpy()
    error, variance = regression.left_out()
    for i in range(P):
        expected = gp_oracle.leave_one_out(prior_of(regression, i), y[:, i], noise[i])
        np.testing.assert_allclose(error[:, i].numpy(), expected[0].astype(float), rtol=1e-7)
        np.testing.assert_allclose(variance[:, i].numpy(), expected[1].astype(float), rtol=1e-7)
    x, phase = queries(5)
    mean, before = regression.freeze()(x, phase)
    regression.likelihood.noise = regression.likelihood.noise * 1e-2
    with torch.no_grad():
        regression.kernel.deviation = regression.kernel.deviation * 0.1
    factors = regression.calibrate()
    assert (factors > 1).all()
    error, variance = regression.left_out()
    ratio = (error.square() / variance).mean(0)
    assert (ratio.mean() if shared else ratio).numpy() == pytest.approx(1.0)
    assert (regression.calibrate() - 1).abs().max() < 1e-9
    again, after = regression.freeze()(x, phase)
    torch.testing.assert_close(again, mean, rtol=1e-8, atol=1e-8)
    torch.testing.assert_close(after / before, 0.01 * factors.expand(P) * torch.ones_like(before), rtol=1e-6, atol=0)


def test_structured_kernel_contract():
    kernel = StructuredKernel(2, torch.Size([3])).double()
    x = torch.randn(7, 4, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    dense = kernel(x).to_dense()
    assert dense.shape == (3, 7, 7)
    torch.testing.assert_close(dense, dense.mT)
    torch.testing.assert_close(kernel(x, diag=True), dense.diagonal(dim1=-2, dim2=-1))
    assert (torch.linalg.eigvalsh(dense) > -1e-12).all()
    torch.testing.assert_close(kernel(x, x[:2]).to_dense(), dense[..., :2])


def test_noise_floor_is_obeyed(make):
    regression = make()
    regression.likelihood.raw_noise.data.fill_(-100.0)
    assert regression.likelihood.noise.min().item() == pytest.approx(1e-10, rel=1e-9)
    x, phase = queries(8)
    other = GPRegression(x, outputs(x, phase), phase, noise_floor=1e-3)
    other.likelihood.raw_noise.data.fill_(-100.0)
    assert other.likelihood.noise.min().item() == pytest.approx(1e-6, rel=1e-9)


def test_condition_keeps_scales_and_hyperparameters(make):
    regression = make(count=20)
    x, phase = queries(60, seed=8)
    before = regression.freeze()
    regression.condition(x, outputs(x, phase), phase)
    after = regression.freeze()
    assert torch.equal(before.posterior.prior, after.posterior.prior)
    q, f = queries(10)
    assert (after(q, f)[1] < before(q, f)[1]).double().mean() > 0.8


def test_raw_units(make):
    x, phase = queries(10)
    regression = GPRegression(x, outputs(x, phase), phase, kernel="isotropic", standardize=False)
    z, y = regression.standardized()
    assert torch.equal(z, torch.cat([x, phase], -1)) and torch.equal(y, outputs(x, phase))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"kernel": "cubic"}, "kernel must be"),
        ({"context": None}, "context of 2 numbers"),
        ({"targets": torch.zeros(7, 3)}, "targets must be"),
        ({"state": torch.full((8, 4), torch.nan)}, "row 0"),
    ],
)
def test_refusals(arguments, message):
    x, phase = queries(8)
    given = {"state": x, "targets": outputs(x, phase), "context": phase, **arguments}
    with pytest.raises(ValueError, match=message):
        GPRegression(**given)


@pytest.mark.parametrize(("kernel", "shared"), [("ard", False), ("isotropic", True)])
def test_sparse_freezes_to_gpytorch(kernel, shared):
    x, phase = queries(60)
    global_state = torch.random.get_rng_state()
    sparse = SparseGPRegression(
        x, outputs(x, phase), phase, kernel=kernel, shared=shared, inducing=12, noise_floor=1e-2
    )
    optimizer = torch.optim.Adam(sparse.parameters(), lr=0.05)
    start = sparse.loss().item()
    for _ in range(40):
        optimizer.zero_grad()
        sparse.loss(torch.arange(0, 60, 2)).backward()
        optimizer.step()
    assert sparse.loss().item() < start
    assert torch.equal(global_state, torch.random.get_rng_state())
    q, f = queries(9, seed=4)
    mean, variance = sparse.posterior(q, f)
    got_mean, got_variance = sparse.freeze()(q, f)
    assert ((got_mean - mean) / sparse.output_scale).abs().max() < 1e-8
    assert ((got_variance - variance) / sparse.output_scale.square()).abs().max() < 1e-8


def test_sparse_bound_is_below_the_exact_likelihood():
    x, phase = queries(30)
    y = outputs(x, phase)
    sparse = SparseGPRegression(x, y, phase, inducing=30, noise_floor=1e-2)
    exact = GPRegression(x, y, phase, kernel="ard", noise_floor=1e-2)
    with torch.no_grad():
        sparse.likelihood.noise = 0.1
        exact.likelihood.noise = 0.1
    assert sparse.loss().item() > exact.loss().item()


def test_sparse_refusals():
    x, phase = queries(8)
    with pytest.raises(ValueError, match="use GPRegression"):
        SparseGPRegression(x, outputs(x, phase), phase, kernel="structured")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="between 1 and the 8"):
        SparseGPRegression(x, outputs(x, phase), phase, inducing=9)


@pytest.mark.parametrize("kernel", ["structured", "ard"])
@pytest.mark.parametrize("shared", [False, True])
def test_groups_are_left_out_together(make, kernel, shared):
    """Each group against a regression that never had it, in extended precision."""
    regression = make(kernel, shared, count=20)
    groups = torch.tensor([3, 0, 0, 7] * 5)
    error, variance = regression.left_out(groups)
    y = regression.standardized()[1].numpy()
    noise = regression.likelihood.noise.detach().flatten().expand(P).numpy()
    for i in range(P):
        prior = prior_of(regression, i)
        for name in (0, 3, 7):
            out = (groups == name).numpy()
            cross, own = prior[np.ix_(~out, out)], np.diag(prior)[out]
            mean, latent = gp_oracle.posterior(prior[np.ix_(~out, ~out)], cross, own, y[~out, i], noise[i])
            # The precision form loses digits by the condition of kernel + noise, about 1e6 to 1e7 here.
            np.testing.assert_allclose(error[out, i], y[out, i] - mean, rtol=1e-7, atol=1e-8)
            np.testing.assert_allclose(variance[out, i], latent + noise[i], rtol=1e-7)
    single = regression.left_out(torch.arange(20))
    for got, expected in zip(single, regression.left_out(), strict=True):
        assert torch.equal(got, expected)
    factors = regression.calibrate(groups)
    ratio = (error.square() / variance).mean(0)
    expected = ratio.mean() if shared else ratio
    torch.testing.assert_close(factors, expected.clamp_min(1.0).expand_as(factors))


def test_left_out_needs_no_definite_kernel_matrix():
    """Where noise is lost in the rounding of the kernel matrix, the weight-space form keeps it."""
    x, phase = queries(200, seed=2)
    regression = GPRegression(x, outputs(x, phase), phase, noise_floor=1e-8)
    regression.likelihood.noise = 1e-14
    regression.kernel.lengthscale = 10.0
    regression.kernel.deviation = 300.0 * torch.ones_like(regression.kernel.deviation)
    with pytest.raises(ValueError, match="not positive definite"):
        regression._checked_factor(regression.standardized()[0])
    error, variance = regression.left_out()
    assert torch.isfinite(error).all() and (variance > 0).all()
    frozen = regression.freeze()
    q, f = queries(50, seed=6)
    assert (frozen.mean(q, f) - outputs(q, f)).abs().max() < 1e-2
