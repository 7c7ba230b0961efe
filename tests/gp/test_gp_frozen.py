"""The frozen posterior against GPyTorch, against plain numpy, and under torch's transforms."""

import json
import subprocess
import sys

import numpy as np
import pytest
import torch
from gp_problem import D, P, phase_of, queries
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from oracles import gp_oracle
from torch.utils.flop_counter import FlopCounterMode

from torchfilt.gp import FrozenGP, IntegrityError
from torchfilt.storage import manifest_path

KERNELS = [("structured", False), ("structured", True), ("ard", False), ("ard", True), ("isotropic", False)]


@pytest.mark.parametrize(("kernel", "shared"), KERNELS)
def test_equals_gpytorch(make, kernel, shared):
    regression = make(kernel, shared)
    frozen = regression.freeze()
    x, phase = queries(25)
    mean, variance = regression.posterior(x, phase)
    for got_mean, got_variance in (frozen(torch.cat([x, phase], -1)), frozen(x, phase)):
        assert ((got_mean - mean) / regression.output_scale).abs().max() < 1e-8
        assert ((got_variance - variance) / regression.output_scale.square()).abs().max() < 1e-8
    torch.testing.assert_close(frozen.mean(x, phase), frozen(x, phase)[0], rtol=1e-13, atol=1e-13)


def oracle_posterior(regression, x, phase):
    z, y = (t.detach().numpy() for t in regression.standardized())
    query = regression.inputs(x, phase).numpy()
    means, variances = [], []
    noise = regression.likelihood.noise.detach().flatten().numpy()
    for i in range(P):
        if regression.kernel_name == "structured":
            scale = regression.kernel.deviation[i, 0].detach().numpy()
            length = regression.kernel.lengthscale[i].item()

            def kernel(a, b, scale=scale, length=length):
                return gp_oracle.structured_kernel(a, b, scale, length)
        else:
            amplitude = regression.kernel.outputscale[i].item()
            length = regression.kernel.base_kernel.lengthscale[i, 0].detach().numpy()

            def kernel(a, b, amplitude=amplitude, length=length):
                return gp_oracle.se_kernel(a, b, amplitude, length)

        own = np.diag(kernel(query, query))
        mean, variance = gp_oracle.posterior(kernel(z, z), kernel(z, query), own, y[:, i], noise[i])
        means.append(mean)
        variances.append(variance)
    return np.stack(means, -1), np.stack(variances, -1)


@pytest.mark.parametrize("noise", [1e-2, 1e-5])
def test_structured_keeps_the_digits_of_small_variances(make, noise):
    """Against 80-bit arithmetic: errors stay at the noise floor's scale, where GPyTorch's difference loses digits."""
    regression = make(noise=noise, count=60)
    x, phase = queries(20)
    mean, variance = regression.freeze()(x, phase)
    expected_mean, expected_variance = oracle_posterior(regression, x, phase)
    # eps / noise is the condition number of the ridge regression solved by QR.
    tolerance = 1e3 * 2.2e-16 / noise
    got = ((mean - regression.output_mean) / regression.output_scale).numpy()
    np.testing.assert_allclose(got, expected_mean, atol=tolerance)
    got = (variance / regression.output_scale.square()).numpy()
    np.testing.assert_allclose(got, expected_variance, rtol=max(1e-9, 10 * tolerance))


def test_dense_equals_numpy(make):
    regression = make("ard")
    x, phase = queries(20)
    mean, variance = regression.freeze()(x, phase)
    expected_mean, expected_variance = oracle_posterior(regression, x, phase)
    scale = regression.output_scale
    np.testing.assert_allclose(((mean - regression.output_mean) / scale).numpy(), expected_mean, atol=1e-9)
    np.testing.assert_allclose((variance / scale.square()).numpy(), expected_variance, atol=1e-12)


def test_collapse_and_broadcasting(make):
    frozen = make().freeze()
    x, phase = queries(12)
    # one phase for all, one a batch row, one a query: same numbers
    for xs, phases in ((x, phase[0]), (x.view(3, 4, D), phase[:3].unsqueeze(1)), (x, phase), (x[0], phase[0])):
        lead = torch.broadcast_shapes(xs.shape[:-1], phases.shape[:-1])
        mean, variance = frozen(xs, phases)
        assert mean.shape == variance.shape == (*lead, P)
        flat = torch.cat([xs.expand(*lead, D), phases.expand(*lead, 2)], -1).reshape(-1, D + 2)
        expected_mean, expected_variance = frozen(flat)
        torch.testing.assert_close(mean.reshape(-1, P), expected_mean, rtol=1e-12, atol=1e-12)
        torch.testing.assert_close(variance.reshape(-1, P), expected_variance, rtol=1e-9, atol=0)
        collapsed = frozen.collapse(phases)
        torch.testing.assert_close(collapsed.mean(xs), mean, rtol=1e-12, atol=1e-12)
        torch.testing.assert_close(collapsed.variance(xs), variance, rtol=1e-9, atol=0)
    assert frozen.collapse(phase[0]).weights.shape == (P, 1 + D)
    with pytest.raises(ValueError, match="variance=False"):
        frozen.collapse(phase[0], variance=False).variance(x)


def test_dense_broadcasts_and_does_not_collapse(make):
    frozen = make("ard").freeze()
    x, phase = queries(12)
    mean, variance = frozen(x.view(3, 4, D), phase[:3].unsqueeze(1))
    expected = frozen(x, phase[:3].repeat_interleave(4, 0))
    torch.testing.assert_close(mean.reshape(-1, P), expected[0], rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(variance.reshape(-1, P), expected[1], rtol=1e-9, atol=1e-12)
    with pytest.raises(TypeError, match="structured"):
        frozen.collapse(phase)
    with pytest.raises(ValueError, match="state of 4 and a context of 2"):
        frozen(x[:, :3], phase)


@pytest.mark.parametrize("kernel", ["structured", "ard"])
def test_vmap_forward_mode_and_gradients(make, kernel):
    frozen = make(kernel).freeze()
    x, phase = queries(6)
    mean, variance = frozen(x, phase)
    mapped = torch.func.vmap(frozen)(x, phase)
    torch.testing.assert_close(mapped[0], mean, rtol=1e-11, atol=1e-11)
    torch.testing.assert_close(mapped[1], variance, rtol=1e-8, atol=1e-12)
    jacobian = torch.func.vmap(torch.func.jacfwd(lambda a, b: frozen(a, b)[0]))(x, phase)
    rows = [torch.autograd.functional.jacobian(lambda a, i=i: frozen(a, phase[i])[0], x[i]) for i in range(len(x))]
    torch.testing.assert_close(jacobian, torch.stack(rows), rtol=1e-9, atol=1e-11)
    unit = 0.01 * x.requires_grad_()
    assert torch.autograd.gradcheck(lambda a: frozen(100 * a, phase), (unit.detach().requires_grad_(),), atol=1e-5)


@pytest.mark.parametrize("kernel", ["structured", "ard"])
def test_compiles_whole(make, kernel):
    frozen = make(kernel).freeze()
    compiled = torch.compile(frozen, fullgraph=True, backend="aot_eager")
    x, phase = queries(6)
    for phases in (phase[0], phase):
        for got, expected in zip(compiled(x, phases), frozen(x, phases), strict=True):
            torch.testing.assert_close(got, expected, rtol=1e-10, atol=1e-12)


def flops(frozen, x, phase):
    with FlopCounterMode(display=False) as counter:
        frozen(x, phase)
    return counter.get_total_flops()


def test_structured_cost_does_not_depend_on_the_training_set(make):
    x, phase = queries(100)
    small, large = make(count=40).freeze(), make(count=320).freeze()
    assert {n: t.shape for n, t in small.state_dict().items()} == {n: t.shape for n, t in large.state_dict().items()}
    assert flops(small, x, phase[0]) == flops(large, x, phase[0])
    # Many queries share one collapse: the cost a query is that of p small products.
    collapsed = small.collapse(phase[0])
    with FlopCounterMode(display=False) as counter:
        collapsed.mean(x), collapsed.variance(x)
    assert counter.get_total_flops() == 2 * 100 * (P * (1 + D) + P * (1 + D) ** 2)


def test_variance_grows_quadratically_off_the_data(make):
    frozen = make().freeze()
    _, phase = queries(1)
    direction = torch.tensor([1.0, -0.5, 0.3, 0.8], dtype=torch.float64)
    steps = torch.arange(0.0, 6.0, dtype=torch.float64)
    variance = frozen(1000 * steps[:, None] * direction, phase[0])[1]
    second = variance.diff(dim=0).diff(dim=0)
    assert (second > 0).all()
    torch.testing.assert_close(second, second[:1].expand_as(second), rtol=1e-9, atol=0)
    distance = frozen.distance(1000 * steps[:, None] * direction)
    assert (distance.diff() > 0).all() and distance[-1] > 10


def test_dense_variance_returns_to_the_prior_off_the_data(make):
    frozen = make("ard").freeze()
    x, phase = queries(1)
    far = frozen(x + 1e5, phase)[1]
    torch.testing.assert_close(far, frozen.prior_variance(x), rtol=1e-12, atol=0)
    assert (frozen(x, phase)[1] < 0.5 * far).all()


@pytest.mark.parametrize("kernel", ["structured", "ard"])
def test_each_query_is_its_own_test_point(make, kernel):
    frozen = make(kernel).freeze()
    x, phase = queries(8)
    alone = torch.stack([frozen(x[i], phase[i])[1] for i in range(8)])
    crowd = x.clone()
    crowd[1:] = x[0] + 1e-9  # near-copies would share their noise under a joint law
    torch.testing.assert_close(frozen(x, phase)[1], alone, rtol=1e-8, atol=1e-12)
    torch.testing.assert_close(frozen(crowd, phase)[1][0], alone[0], rtol=1e-8, atol=1e-12)


def test_variance_is_never_negative(make):
    for kernel in ("structured", "ard"):
        regression = make(kernel, noise=2e-5, count=80)
        assert (regression.freeze()(regression.state, regression.context)[1] >= 0).all()


def test_single_precision(make):
    regression = make(noise=1e-4)
    double, single = regression.freeze(), regression.freeze().float()
    x, phase = queries(20)
    mean, variance = single(x.float(), phase.float())
    assert mean.dtype == variance.dtype == torch.float32
    expected_mean, expected_variance = double(x, phase)
    torch.testing.assert_close(mean.double(), expected_mean, rtol=3e-5, atol=3e-5)
    torch.testing.assert_close(variance.double(), expected_variance, rtol=1e-3, atol=0)
    trained_in_single = make(noise=1e-2, dtype=torch.float32).freeze()
    torch.testing.assert_close(
        trained_in_single(x.float(), phase.float())[0].double(),
        make(noise=1e-2).freeze()(x, phase)[0],
        rtol=1e-2,
        atol=1e-2,
    )


def test_phase_must_lie_on_the_circle(make):
    regression = make()
    regression.context *= 1.01
    with pytest.raises(ValueError, match="unit circle"):
        regression.freeze()


@pytest.mark.parametrize("kernel", ["structured", "ard"])
def test_save_and_load(make, kernel, tmp_path):
    frozen = make(kernel).freeze({"dt": 10.0, "target": "identity"})
    frozen.save(tmp_path / "gp.npz")
    loaded = FrozenGP.load(tmp_path / "gp.npz")
    x, phase = queries(5)
    for got, expected in zip(loaded(x, phase), frozen(x, phase), strict=True):
        assert torch.equal(got, expected)
    assert loaded.settings == frozen.settings
    assert loaded.settings["samples"] == 40
    assert not list(tmp_path.glob(".*"))


def test_refuses_foreign_and_cut_files(make, tmp_path):
    path = tmp_path / "gp.npz"
    with pytest.raises(FileNotFoundError, match=r"gp\.npz"):
        FrozenGP.load(path)
    np.savez(path, a=np.zeros(3))
    with pytest.raises(IntegrityError, match="manifest"):
        FrozenGP.load(path)
    make().freeze().save(path)
    path.write_bytes(path.read_bytes()[:-10])
    with pytest.raises(IntegrityError, match=r"gp\.npz.*truncated or altered"):
        FrozenGP.load(path)
    from torchfilt.storage import write_verified

    write_verified(path, b"anything", "something else")
    with pytest.raises(IntegrityError, match="something else"):
        FrozenGP.load(path)
    write_verified(path, b"anything", "torchfilt frozen Gaussian process")
    with pytest.raises(IntegrityError, match="not a frozen"):
        FrozenGP.load(path)


@settings(max_examples=200, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_no_mutation_loads(make, tmp_path, data):
    path = tmp_path / "gp.npz"
    if not path.exists():
        make(count=10).freeze().save(path)
    victim = data.draw(st.sampled_from([path, manifest_path(path)]))
    original = victim.read_bytes()
    at = data.draw(st.integers(0, len(original) - 1))
    kind = data.draw(st.sampled_from(["flip", "cut", "insert"]))
    if kind == "flip":
        changed = bytearray(original)
        changed[at] ^= data.draw(st.integers(1, 255))
    else:
        changed = original[:at] if kind == "cut" else original[:at] + b"\x00" + original[at:]
    victim.write_bytes(bytes(changed))
    try:
        with pytest.raises(IntegrityError, match=r"gp\.npz"):
            FrozenGP.load(path)
    finally:
        victim.write_bytes(original)


def test_needs_no_gpytorch():
    code = (
        "import sys, torchfilt.gp, torchfilt.gp.frozen, torchfilt.gp.transition\n"
        "heavy = {'gpytorch', 'pytorch_lightning', 'scipy', 'matplotlib'} & set(sys.modules)\n"
        "assert not heavy, heavy"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_settings_are_plain(make):
    json.dumps(make().freeze({"dt": 1.0}).settings)


def test_phase_helper_is_on_the_circle():
    assert torch.allclose(phase_of(torch.tensor([0.3])).norm(dim=-1), torch.ones(1))
