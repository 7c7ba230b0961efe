"""The indirect form, measurement laws that see the control, and first-order short cuts."""

import numpy as np
import pytest
import torch

import torchfilt as tf
from torchfilt.moments import taylor

F64 = torch.float64


def tensor(values):
    return torch.as_tensor(np.asarray(values, dtype=float))


def swing(x, u, dt):
    """A pendulum pushed by u."""
    angle, rate = x.unbind(-1)
    return torch.stack([angle + dt * rate, rate + dt * (u[..., 0] - 9.81 * angle.sin())], -1)


Q, R, P0 = np.diag([1e-6, 1e-4]), np.array([[4e-4]]), np.diag([0.04, 0.09])


def pendulum(start=(0.0, 0.0)):
    sensor = tf.AdditiveGaussian(lambda x: x[..., :1].sin(), tensor(R))
    prior = tf.Gaussian(tensor(start), torch.linalg.cholesky(tensor(P0)))
    return tf.StateSpaceModel(prior, tf.AdditiveGaussian(swing, tensor(Q)), sensor)


def linearised_once(ys, us, dt):
    """NumPy: F and H at zero for ever, f(0) with the control as the offset."""
    F, H = np.array([[1, dt], [-9.81 * dt, 1]]), np.array([[1.0, 0.0]])
    m, P, means = np.zeros(2), P0, []
    for y, u in zip(ys, us, strict=True):
        m, P = F @ m + np.array([0, dt * u[0]]), F @ P @ F.T + Q
        S = H @ P @ H.T + R
        K = P @ H.T @ np.linalg.inv(S)
        m, P = m + K @ (y - H @ m), P - K @ S @ K.T
        means.append(m)
    return np.array(means), P


def data(steps=40):
    rng = np.random.default_rng(0)
    return rng.normal(0, 0.1, (steps, 1)), rng.normal(0, 1, (steps, 1))


def test_without_feedback_the_law_is_linearised_once():
    ys, us = data()
    mean, P = linearised_once(ys, us, 0.05)
    history = tf.ErrorStateKalmanFilter(pendulum(), feedback=False)(tensor(ys), tensor(us), 0.05)
    # Forty steps of a stable recursion of condition below 1e3.
    np.testing.assert_allclose(history.mean, mean, rtol=0, atol=1e-12)
    np.testing.assert_allclose(history.covariance[-1], P, rtol=1e-10)


def test_with_feedback_it_is_the_extended_filter():
    ys, us = data()
    one = tf.ErrorStateKalmanFilter(pendulum((0.4, 0.0)), iterations=2)(tensor(ys), tensor(us), 0.05)
    other = tf.ExtendedKalmanFilter(pendulum((0.4, 0.0)), iterations=2)(tensor(ys), tensor(us), 0.05)
    assert torch.equal(one.mean, other.mean)


def test_feedback_is_an_explicit_correction_of_a_reference():
    """Attitude from vector measurements: reference, error angle and reset written out in NumPy."""
    dt, steps = 0.1, 30
    rng = np.random.default_rng(1)
    rates, up = rng.normal(0, 0.5, (steps, 3)), np.array([0.0, 0.0, 1.0])
    ys = rng.normal(0, 0.3, (steps, 3)) + up

    def exponential(v):
        angle = np.linalg.norm(v)
        k = np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]]) / angle
        return np.eye(3) + np.sin(angle) * k + (1 - np.cos(angle)) * k @ k

    def cross(v):
        return np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])

    reference, P = np.eye(3), 0.2 * np.eye(3)
    for rate, y in zip(rates, ys, strict=True):
        turn = exponential(rate * dt)
        reference, P = reference @ turn, turn.T @ P @ turn + 1e-3 * np.eye(3)
        seen = reference.T @ up  # the error is on the body's side: C = reference exp(e), so H = [seen x]
        H = cross(seen)
        K = P @ H.T @ np.linalg.inv(H @ P @ H.T + 0.09 * np.eye(3))
        e = K @ (y - seen)
        a = np.linalg.norm(e)
        # The reset: what is left of the error is seen from the new reference.
        G = np.eye(3) - (1 - np.cos(a)) / a**2 * cross(e) + (a - np.sin(a)) / a**3 * cross(e) @ cross(e)
        reference, P = reference @ exponential(e), G @ (P - K @ H @ P) @ G.T

    import roma

    space = tf.UnitQuaternion("right")
    move = tf.AdditiveGaussian(lambda x, u, dt: space.retract(x, u * dt), 1e-3 * torch.eye(3, dtype=F64), space)
    down = tensor(up)

    def seen_in_body(x):
        return roma.quat_action(roma.quat_conjugation(x), down.expand(*x.shape[:-1], 3))

    sensor = tf.AdditiveGaussian(seen_in_body, 0.09 * torch.eye(3, dtype=F64))
    identity = tensor([0, 0, 0, 1])
    prior = tf.Gaussian(identity, 0.2**0.5 * torch.eye(3, dtype=F64), space)
    history = tf.ErrorStateKalmanFilter(tf.StateSpaceModel(prior, move, sensor))(tensor(ys), tensor(rates), dt)
    np.testing.assert_allclose(roma.unitquat_to_rotmat(history.mean[-1]), reference, atol=1e-12)
    np.testing.assert_allclose(history.covariance[-1], P, atol=1e-13)


def test_wrong_use_is_refused():
    with pytest.raises(ValueError, match="iterations must be 1, got 2"):
        tf.ErrorStateKalmanFilter(pendulum(), feedback=False, iterations=2)
    wide = tf.StateSpaceModel(
        tf.Gaussian(torch.zeros(3, 2).double(), torch.eye(2).double()), pendulum().transition, pendulum().observation
    )
    with pytest.raises(ValueError, match=r"the prior's mean must be one point for all rows, got \(3, 2\)"):
        tf.ErrorStateKalmanFilter(wide, feedback=False)
    with pytest.raises(TypeError, match="model must be a StateSpaceModel"):
        tf.ErrorStateKalmanFilter(None, feedback=False)
    with pytest.raises(ValueError, match="about must be one finite point of d numbers"):
        taylor(torch.tensor([0.0, float("nan")]))
    with pytest.raises(ValueError, match="about must be one finite point of d numbers"):
        taylor(torch.zeros(2, 2))


class Offered(torch.nn.Module):
    """A law that gives its own first order, and counts how often it is asked."""

    def __init__(self, law, jacobian):
        super().__init__()
        self.law, self.jacobian, self.asked = law, jacobian, 0

    def forward(self, x, u=None, dt=None):
        return self.law(x, u, dt)

    def first_order(self, x, u=None, dt=None):
        self.asked += 1
        return self.law(x, u, dt), self.jacobian(x, u, dt)


def test_a_law_may_offer_its_first_order():
    def jacobian(x, u, dt):
        one = torch.ones_like(x[..., 0])
        rows = [torch.stack([one, dt * one], -1), torch.stack([-9.81 * dt * x[..., 0].cos(), one], -1)]
        return torch.stack(rows, -2)

    model = pendulum((0.4, 0.0))
    law = Offered(model.transition, jacobian)
    ys, us = (tensor(part).unsqueeze(1).expand(-1, 3, -1) for part in data())
    one = tf.ExtendedKalmanFilter(tf.StateSpaceModel(model.initial, law, model.observation))(ys, us, 0.05)
    other = tf.ExtendedKalmanFilter(model)(ys, us, 0.05)
    assert law.asked == len(ys)
    assert torch.allclose(one.mean, other.mean, rtol=0, atol=1e-12)
    assert torch.allclose(one.covariance, other.covariance, rtol=1e-10)


FEED = {
    "taylor": tf.ExtendedKalmanFilter,
    "unscented": tf.UnscentedKalmanFilter,
    "bootstrap": lambda m: tf.BootstrapFilter(m, 100),
    "local": lambda m: tf.UnscentedParticleFilter(m, 20),
    "joint": lambda m: tf.UnscentedParticleFilter(m, 20, split=0.0, pooled=False, weights="joint"),
    "auxiliary": lambda m: tf.AuxiliaryParticleFilter(m, 100),
    "moved": lambda m: tf.BootstrapFilter(m, 50, move=tf.moves.MetropolisHastings()),
}


@pytest.mark.parametrize("name", FEED)
def test_measurement_laws_see_control_and_time_step(name):
    """y = x + 2 u + dt is the same as measuring y - 2 u - dt without them; rows have controls of their own."""
    move = tf.LinearGaussian(torch.eye(2, dtype=F64), 0.1 * torch.eye(2, dtype=F64))
    prior = tf.Gaussian(torch.zeros(2, dtype=F64), torch.eye(2, dtype=F64))
    noise = 0.3 * torch.eye(2, dtype=F64)
    feeding = tf.AdditiveGaussian(lambda x, u, dt: x + 2 * u + dt, noise)
    plain = tf.AdditiveGaussian(lambda x: 1.0 * x, noise)
    generator = torch.Generator().manual_seed(0)
    ys, us = torch.randn(2, 6, 3, 2, generator=generator, dtype=F64)
    dt = torch.tensor([0.1, 0.2, 0.0, 0.3, 0.1, 0.4], dtype=F64)
    filter = FEED[name](tf.StateSpaceModel(prior, move, feeding))
    one = filter(ys, us, dt, seed=1)
    other = FEED[name](tf.StateSpaceModel(prior, move, plain))(ys - 2 * us - dt[:, None, None], seed=1)
    assert torch.allclose(one.mean, other.mean, rtol=0, atol=1e-11)
    assert torch.allclose(one.log_likelihood, other.log_likelihood, rtol=0, atol=1e-10)
    state = filter.init((3,), seed=1)
    for y, u, step in zip(ys, us, dt.tolist(), strict=True):
        state, _ = filter.step(state, y, u, step)
    belief = state.belief
    assert torch.equal(belief.mean, one.mean[-1])


def test_linear_measurements_take_controls_by_their_matrix():
    """Feed-through D u, exact in the Kalman filter."""
    eye = torch.eye(1, dtype=F64)
    feed = tf.LinearGaussian(eye, eye, control_matrix=3 * eye)
    prior, walk = tf.Gaussian(torch.zeros(1).double(), eye), tf.LinearGaussian(eye, eye)
    ys, us = torch.randn(2, 5, 1, generator=torch.Generator().manual_seed(0), dtype=F64)
    one = tf.KalmanFilter(tf.StateSpaceModel(prior, walk, feed))(ys, us)
    other = tf.KalmanFilter(tf.StateSpaceModel(prior, walk, tf.LinearGaussian(eye, eye)))(ys - 3 * us)
    assert torch.allclose(one.mean, other.mean, rtol=0, atol=1e-14)


def test_a_gate_shuts_out_what_does_not_fit():
    """One row gets a wild measurement: it keeps its prediction to the bit, its neighbour is as without a gate."""
    rng = np.random.default_rng(4)
    us = tensor(rng.normal(0, 1, (40, 1)))
    path = [tensor([0.1, 0.2])]
    for u in us:
        path.append(swing(path[-1], u, 0.05))
    ys = torch.stack(path[1:])[:, :1].sin() + tensor(rng.normal(0, 0.02, (40, 1)))
    ys, us = (part.unsqueeze(1).repeat(1, 2, 1) for part in (ys, us))
    ys[20, 1] = 5.0
    ys[30] = float("nan")
    plain, gated = (tf.GaussianFilter(pendulum(), taylor(), gate=gate) for gate in (None, 0.9999))
    free, shut = plain(ys, us, 0.05), gated(ys, us, 0.05)
    accepted = shut.diagnostics.accepted
    assert accepted.sum() == accepted.numel() - 1 and not accepted[20, 1] and free.diagnostics.accepted is None
    # With room for what may be refused the factorisation rounds in another order.
    for one, other in ((shut.mean[:, 0], free.mean[:, 0]), (shut.mean[:20], free.mean[:20])):
        torch.testing.assert_close(one, other, rtol=0, atol=1e-13)
    state = gated(ys[:20], us[:20], 0.05).final
    ahead = plain.predict(state.belief, us[20], 0.05)
    assert torch.equal(shut.mean[20, 1], ahead.mean[1])
    assert torch.equal(shut.covariance[20, 1], (ahead.scale_tril @ ahead.scale_tril.mT)[1])
    assert shut.evidence == "approximate" and free.evidence == "linearized"
    assert (shut.log_likelihood[1] - free.log_likelihood[1]) > 100


def test_the_gate_has_the_stated_rate():
    """Of 60,000 right measurements of two components, one missing now and then, 1 % are shut out: 4.5 deviations."""
    from scipy import stats

    eye = torch.eye(2, dtype=F64)
    model = tf.StateSpaceModel(
        tf.Gaussian(torch.zeros(2, dtype=F64), eye), tf.LinearGaussian(eye, eye), tf.LinearGaussian(eye, 2 * eye)
    )
    generator = torch.Generator().manual_seed(3)
    ys = 2 * torch.randn(1, 60_000, 2, generator=generator, dtype=F64)  # prior 1, step 1, noise 2: variance 4
    ys[0, ::3, 1] = float("nan")
    history = tf.GaussianFilter(model, taylor(), gate=0.99)(ys)
    rejected = int((~history.diagnostics.accepted).sum())
    assert stats.binomtest(rejected, 60_000, 0.01).pvalue > 1e-5
    nis, one = history.diagnostics.gate_nis[0], torch.arange(60_000) % 3 == 0
    for rows, freedom in ((one, 1), (~one, 2)):
        assert torch.equal(history.diagnostics.accepted[0, rows], nis[rows] <= stats.chi2.ppf(0.99, freedom))


@pytest.mark.parametrize("gate", [0.0, 1.0, float("nan")])
def test_a_gate_is_a_probability(gate):
    with pytest.raises(ValueError, match=r"gate must be a probability in \(0, 1\) or None"):
        tf.ErrorStateKalmanFilter(pendulum(), gate=gate)
