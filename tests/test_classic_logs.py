"""Classical logs with answers found by other programs (data/classic/README.md)."""

import hashlib
import json
import warnings
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.io import loadmat

import torchfilt as tf

with warnings.catch_warnings():
    warnings.simplefilter("ignore")
    from statsmodels.tsa.statespace.structural import UnobservedComponents

DATA = Path(__file__).parents[1] / "data" / "classic"


def tensor(value):
    return torch.as_tensor(np.asarray(value), dtype=torch.float64)


def linear_model(mean, covariance, transition, observation):
    return tf.StateSpaceModel(
        tf.Gaussian(tensor(mean), tf.linalg.psd_factor(tensor(covariance))), transition, observation
    )


def test_files_are_the_ones_the_answers_belong_to():
    digests = json.loads((DATA / "manifest.json").read_text())
    for name, digest in digests.items():
        assert hashlib.sha256((DATA / name).read_bytes()).hexdigest() == digest, name


FILTERS = {
    "kalman": tf.KalmanFilter,
    "extended": tf.ExtendedKalmanFilter,
    "unscented": tf.UnscentedKalmanFilter,
    "cubature": tf.CubatureKalmanFilter,
    "gauss-hermite": tf.GaussHermiteKalmanFilter,
}


@pytest.mark.parametrize("name", FILTERS)
def test_nile(name):
    """Durbin and Koopman's local level: last level, its variance, and the diffuse log-likelihoods of statsmodels."""
    flow = np.loadtxt(DATA / "nile.csv", delimiter=",", skiprows=1)[:, 1]
    one = torch.ones(1, 1, dtype=torch.float64)
    diffuse = 1e6
    model = linear_model(
        [0.0], [[diffuse]], tf.LinearGaussian(one, 1469.1 * one), tf.LinearGaussian(one, 15099.0 * one)
    )
    history = FILTERS[name](model)(tensor(flow)[:, None], predict_first=False)
    # The start is diffuse to 1e6: forgotten after 100 years to all the digits given.
    assert history.mean[-1].item() == pytest.approx(798.3703, abs=5e-5)
    assert history.covariance[-1].item() == pytest.approx(4032.158, abs=5e-4)
    likelihood = history.diagnostics.log_likelihood
    assert likelihood[1:].sum().item() == pytest.approx(-632.5377, abs=5e-5)
    witness = UnobservedComponents(flow, "llevel")
    witness.ssm.initialize_approximate_diffuse(diffuse)
    witness.ssm.tolerance = 0
    expected = witness.smooth([15099.0, 1469.1])
    np.testing.assert_allclose(history.mean[:, 0].numpy(), expected.filtered_state[0], rtol=1e-11)
    np.testing.assert_allclose(history.covariance[:, 0, 0].numpy(), expected.filtered_state_cov[0, 0], rtol=1e-10)
    np.testing.assert_allclose(likelihood[1:].numpy(), expected.llf_obs[1:], rtol=0, atol=1e-9)


def test_nile_with_an_exact_diffuse_start():
    """As the prior variance grows, log-likelihood + log(kappa) / 2 tends to the exact diffuse one."""
    flow = np.loadtxt(DATA / "nile.csv", delimiter=",", skiprows=1)[:, 1]
    one = torch.ones(1, 1, dtype=torch.float64)
    kappa = 1e14
    model = linear_model([0.0], [[kappa]], tf.LinearGaussian(one, 1469.1 * one), tf.LinearGaussian(one, 15099.0 * one))
    history = tf.KalmanFilter(model)(tensor(flow)[:, None], predict_first=False)
    assert history.log_likelihood.item() + 0.5 * np.log(kappa) == pytest.approx(-633.4646, abs=5e-5)


def clark():
    """Trend, drift and cycle of output, two lags; unemployment's own level: six states as Kim and Nelson have them."""
    deviation_v, deviation_e, deviation_w, deviation_vl, deviation_ec, phi_1, phi_2, *alpha = (
        0.004863, 0.00668, 0.000295, 0.001518, 0.000306, 1.43859, -0.517385, -0.336789, -0.163511, -0.072012,
    )  # fmt: skip
    transition = np.zeros((6, 6))
    transition[0, [0, 4]] = 1  # trend of output with drift
    transition[1, [1, 2]] = phi_1, phi_2  # cycle
    transition[2, 1] = transition[3, 2] = 1
    transition[4, 4] = transition[5, 5] = 1
    noise = np.diag(np.square([deviation_v, deviation_e, 0, 0, deviation_w, deviation_vl]))
    design = np.array([[1, 1, 0, 0, 0, 0], [0, alpha[0], alpha[1], alpha[2], 0, 1]], dtype=float)
    return transition, noise, design, np.diag([0, deviation_ec**2])


@pytest.mark.parametrize("name", FILTERS)
def test_clark_1989_with_a_missing_tail(name):
    """One-step predictions of the six states as the R package prints them, and its log-likelihood."""
    raw = np.loadtxt(DATA / "clark1989.csv", delimiter=",")
    ys = np.stack([np.log(raw[:, 0]), raw[:, 1] / 100], -1)[4:]
    ys[-51:, 1] = np.nan
    transition, noise, design, covariance = clark()
    # Its start is the state at the first row.
    model = linear_model(
        np.zeros(6),
        100 * transition @ transition.T,
        tf.LinearGaussian(tensor(transition), tensor(noise)),
        tf.LinearGaussian(tensor(design), tensor(covariance)),
    )
    history = FILTERS[name](model)(tensor(ys), predict_first=False)
    expected = np.loadtxt(DATA / "results_clark1989_R.csv", delimiter=",", skiprows=1)[:, 1:]
    predicted = history.mean.numpy() @ transition.T
    assert expected.shape == predicted.shape == (191, 6)
    # Printed to 15 digits; values up to 10, a start of variance 100 against exact measurements costs the rest.
    np.testing.assert_allclose(predicted, expected, rtol=0, atol=1e-10)
    assert history.log_likelihood.item() == pytest.approx(1232.11346, abs=5e-6)


@pytest.mark.parametrize("name", FILTERS)
def test_robot(name):
    """The filtered moments of another program for a model with an offset that changes in time (as a control)."""
    data = loadmat(DATA / "robot.mat")
    five = torch.eye(5, dtype=torch.float64)
    model = linear_model(
        data["x0"][:, 0],
        data["P_0"],
        tf.LinearGaussian(tensor(data["A"]), tensor(data["Q"]), control_matrix=five),
        tf.LinearGaussian(tensor(data["C"]), tensor(data["R"]), tensor(data["d"][:, 0])),
    )
    history = FILTERS[name](model)(tensor(data["y"].T.copy()), tensor(data["b"].T.copy()))
    covariance = np.stack(list(data["Vfilt"][0]))
    np.testing.assert_allclose(history.mean.numpy(), data["xfilt"].T[1:], rtol=0, atol=1e-11)
    np.testing.assert_allclose(history.covariance.numpy(), covariance[1:], rtol=0, atol=1e-11)
    assert history.log_likelihood.item() == pytest.approx(-3189.4525180, abs=5e-8)


def test_simulated_linear_gaussian():
    """X0 belongs to the first datum."""
    ys = np.loadtxt(DATA / "simulated_linGauss_T100_varX1_varY.04_rho.9.txt")
    one = torch.ones(1, 1, dtype=torch.float64)
    model = linear_model([0.0], [[1 / 0.19]], tf.LinearGaussian(0.9 * one, one), tf.LinearGaussian(one, 0.04 * one))
    for build in FILTERS.values():
        history = build(model)(tensor(ys)[:, None], predict_first=False)
        assert history.log_likelihood.item() == pytest.approx(-149.3812412, abs=5e-8)
