# %% [markdown]
# # A filter on a sphere of orientations
#
# An orientation is four numbers of length one, and q and -q are the same orientation. A filter that takes them for four
# plain numbers averages, adds noise and inverts covariances where none of these means what it should. We measure what
# goes wrong, then do the same on the space itself, and filter a gyro, an accelerometer and a magnetometer on it.
#
# Open this file in Jupyter (with jupytext) or in an editor that knows `# %%` cells, or run it as a script.

# %%
import math

import torch

import torchfilt as tf
from torchfilt.models import attitude
from torchfilt.spaces import EUCLIDEAN, transport

generator = torch.Generator().manual_seed(1)
space = tf.UnitQuaternion("left")  # errors are rotation vectors in world axes
identity = torch.tensor([0.0, 0.0, 0.0, 1.0]).double()  # order x y z w


def normal(*shape):
    return torch.randn(*shape, generator=generator, dtype=torch.float64)


def apart_deg(one, other):
    """Angle of the rotation from one orientation to the other."""
    return space.local(one, other).norm(dim=-1).rad2deg()


# %% [markdown]
# ## Averages that go wrong
# A thousand clouds of 20 orientations, 10 deg per axis around one truth, each quaternion with the sign that it happens
# to have. The plain average takes q and -q for opposite points: they cancel, and what is left points anywhere.

# %%
truth = space.project(normal(4))
cloud = space.retract(truth, math.radians(10) * normal(1000, 20, 3))
signs = torch.where(torch.rand(1000, 20, 1, generator=generator, dtype=torch.float64) < 0.5, -1.0, 1.0)
equal = torch.full((20,), 1 / 20, dtype=torch.float64)

plain = (cloud * signs).mean(-2)
intrinsic = space.mean(cloud * signs, equal)
plain_error, intrinsic_error = apart_deg(space.project(plain), truth), apart_deg(intrinsic, truth)
print(f"plain average: length {plain.norm(dim=-1).median():.2f}, off by {plain_error.median():.1f} deg (median)")
print(f"               and by more than 30 deg in {(plain_error > 30).double().mean():.0%} of the clouds")
print(f"intrinsic mean: off by {intrinsic_error.median():.1f} deg, at most {intrinsic_error.max():.1f} deg")
assert (plain_error > 30).sum() > 100 and intrinsic_error.max() < 15
# The mean of 20 draws scatters by 10 deg / sqrt(20) per axis; the root mean square of 1000 is good to 2 %.
expected = 10 * math.sqrt(3 / 20)
assert abs(intrinsic_error.square().mean().sqrt() - expected) < 0.1 * expected

# %% [markdown]
# Euler angles have a cut: headings of 179 and -179 deg are two degrees apart and average to zero, the opposite way.

# %%
headings = torch.tensor([179.0, -179.0]).double().deg2rad()
level = torch.zeros_like(headings)
pair = attitude.from_euler(headings, level, level)
half = torch.full((2,), 0.5, dtype=torch.float64)
middle = space.mean(pair, half)
by_angles = attitude.from_euler(headings.mean(), level[0], level[0])
print(
    f"mean of the angles {headings.mean().rad2deg():.0f} deg, {apart_deg(by_angles, middle):.0f} deg from the right one"
)
assert abs(apart_deg(by_angles, middle) - 180) < 1e-6
assert (apart_deg(pair, middle) - 1).abs().max() < 1e-6

# %% [markdown]
# Even with the right signs four numbers are one too many. A cloud lies on the unit sphere: across it there is almost no
# spread, and the condition of the four numbers' covariance grows as 1 / spread^2: what a filter inverts there is the
# curvature of the sphere, in the end rounding.

# %%
for spread_deg in (10.0, 1.0, 0.01):
    points = space.retract(truth, math.radians(spread_deg) * normal(20_000, 3))
    eigenvalues = torch.linalg.eigvalsh(points.mT.cov())
    error_values = torch.linalg.eigvalsh(space.local(truth, points).mT.cov())
    print(
        f"spread {spread_deg:5g} deg: condition {eigenvalues[-1] / eigenvalues[0]:8.1e} (four numbers), "
        f"{error_values[-1] / error_values[0]:.2f} (rotation vectors)"
    )
assert eigenvalues[-1] / eigenvalues[0] > 1e6 and error_values[-1] / error_values[0] < 1.1

# %% [markdown]
# ## The same on the space
# A belief is a mean on the sphere and a Gaussian of rotation vectors about it: three errors for three degrees of
# freedom. Sigma points walk from the mean along the columns of the factor, so they *are* orientations. What they
# foretell, here where a tilted camera looks, can be checked with 200,000 draws; four-number sigma points, made of the
# draws' own mean and covariance, leave the sphere.

# %%
deviations = torch.tensor([5.0, 20.0, 40.0]).double().deg2rad()
belief = tf.Gaussian(truth, deviations, space, is_diagonal=True)
steps = math.sqrt(3) * torch.cat([belief.factor(), -belief.factor()])  # e = 3: six points of weight 1/6, none central
sigma = space.retract(truth, steps)
looks = torch.tensor([1.0, 0.0, 0.0]).double()
draws = belief.sample(normal(200_000, 3))
seen = attitude.rotate(draws, looks)
by_sigma, by_draws = attitude.rotate(sigma, looks).mean(0), seen.mean(0)

four_mean = (draws * torch.copysign(torch.ones(()).double(), draws @ truth).unsqueeze(-1)).mean(0)
four_factor = torch.linalg.cholesky((draws - four_mean).mT @ (draws - four_mean) / len(draws))
four = four_mean + 2 * torch.cat([four_factor.mT, -four_factor.mT])
print(f"where it looks on average: sigma points off by {(by_sigma - by_draws).norm():.4f}")
print(
    f"lengths of sigma points: {sigma.norm(dim=-1).min():.3f} on the space, "
    f"up to {four.norm(dim=-1).max():.2f} in four numbers"
)
print(f"taking the mean orientation instead: off by {(attitude.rotate(truth, looks) - by_draws).norm():.4f}")
assert (by_sigma - by_draws).norm() < 0.01 < 0.2 < (attitude.rotate(truth, looks) - by_draws).norm()
assert (sigma.norm(dim=-1) - 1).abs().max() < 1e-14 and four.norm(dim=-1).max() > 1.1

# %% [markdown]
# ## The covariance goes along to the new mean
# A large correction moves the mean, and rotation vectors about the old mean are not rotation vectors about the new one.
# `transport` carries the covariance there, by the exact derivative of the change of chart. It is a derivative, so it is
# right for *small* covariances; how small, the draws tell, to about 0.5 %. The errors have deviations (s, s/2, s/5),
# the correction is 120 deg. Filters do this after each update, by themselves.

# %%
turn = torch.tensor([0.3, 1.0, 0.5]).double()
turn = turn / turn.norm()
shape = torch.tensor([1.0, 0.5, 0.2]).double()


def carried_and_left(angle_deg, spread_deg):
    """Relative error of the covariance about the new mean, carried and as it was, against 200,000 draws."""
    v = turn * math.radians(angle_deg)
    factor = torch.diag(shape * math.radians(spread_deg))
    after = space.retract(truth, v)
    errors = space.local(after, space.retract(truth, v + normal(200_000, 3) @ factor.mT))
    drawn = errors.mT @ errors / len(errors)
    carried = transport(space, v, factor)
    return [float((square - drawn).norm() / drawn.norm()) for square in (carried @ carried.mT, factor @ factor.mT)]


angles = (0, 30, 60, 90, 120, 150)
by_angle = torch.tensor([carried_and_left(angle, 2.0) for angle in angles])
spreads = (1, 2, 5, 10, 20, 40)
by_spread = torch.tensor([carried_and_left(120, spread) for spread in spreads])
for spread, (carried, left) in zip(spreads, by_spread, strict=True):
    print(f"spread {spread:2d} deg: covariance off by {carried:.1%} when carried, {left:.0%} when left as it was")
assert (by_spread[:4, 0] < 0.02).all() and (by_spread[:, 1] > 1).all()
assert by_spread[-1, 0] > by_spread[0, 0]  # of a wide belief even the carried one is an approximation

# %% [markdown]
# ## A filter
# A hand turns a sensor for 20 s: a gyro with a bias at 25 Hz, five times a second an accelerometer and a magnetometer.
# The filters start 150 deg off, about three axes and with the bias unknown, each as a row of one batch.
#
# The vectors are precise to two degrees and the start is not to a hundred: linearised once, at the start, the first
# pair makes a filter sure of a wrong attitude. So each measurement is linearised five times, about its own posterior;
# one filter does it once, to show the price.

# %%
dt, count, rows = 0.04, 500, 3
gravity, field = torch.tensor([0.0, 0.0, 9.81]).double(), torch.tensor([0.0, 18.0, -40.0]).double()
bias = torch.tensor([0.01, -0.02, 0.015]).double()
times = dt * torch.arange(1, count + 1).double()
rate = torch.stack([1.2 * (0.9 * times).sin(), 0.8 * (1.3 * times).cos(), 0.5 + 0.6 * (0.4 * times).sin()], -1)
attitudes = [truth]
for turned in attitude.from_rotation_vector(rate * dt):
    attitudes.append(attitude.multiply(attitudes[-1], turned))
attitudes = torch.stack(attitudes)[1:]

noise_rad_sqrt_s = 0.002
gyro = rate + bias + noise_rad_sqrt_s / math.sqrt(dt) * normal(count, 3)
back = attitude.inverse(attitudes)
vectors = torch.cat(
    [attitude.rotate(back, gravity) + 0.3 * normal(count, 3), attitude.rotate(back, field) + normal(count, 3)], -1
)
vectors = torch.where((torch.arange(count) % 5 == 4).unsqueeze(-1), vectors, torch.nan)  # NaN: not measured
vectors = vectors.unsqueeze(1).expand(-1, rows, -1)

off = torch.tensor([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [1.0, 1.0, 1.0]]).double()
off = math.radians(150) * off / off.norm(dim=-1, keepdim=True)
start = torch.cat([space.retract(truth, off), torch.zeros(rows, 3).double()], -1)
deviation = torch.tensor([1.8] * 3 + [0.03] * 3).double()

sensors = tf.Sensors(
    accelerometer=attitude.VectorMeasurement(gravity, 0.3), magnetometer=attitude.VectorMeasurement(field, 1.0)
)
prior = tf.Gaussian(start, deviation, attitude.ATTITUDE_SPACE, is_diagonal=True)
model = tf.StateSpaceModel(prior, attitude.GyroTransition(noise_rad_sqrt_s, 1e-5), sensors)

# %% [markdown]
# The naive filter has the same laws with the quaternion as four plain numbers: half the angle is the noise of a number,
# in all four directions so that nothing becomes singular, and each law normalises the numbers that it is given. There
# are kinder forms of it; each mends, by hand, one of the things that are not there on the space.


# %%
def plain_motion(x, u, dt):
    """The same motion for seven plain numbers."""
    law = model.transition(torch.cat([space.project(x[..., :4]), x[..., 4:]], -1), u, dt)
    return tf.Gaussian(law.mean, four_noise * dt**0.5, EUCLIDEAN, is_diagonal=True)


def plain_sight(x):
    """The same sensors for seven plain numbers."""
    return sensors(torch.cat([space.project(x[..., :4]), x[..., 4:]], -1))


four_noise = torch.tensor([noise_rad_sqrt_s / 2] * 4 + [1e-5] * 3).double()
plain_prior = tf.Gaussian(start, torch.tensor([0.9] * 4 + [0.03] * 3).double(), EUCLIDEAN, is_diagonal=True)
plain_model = tf.StateSpaceModel(plain_prior, plain_motion, plain_sight)

# %%
filters = {
    "unscented": tf.UnscentedKalmanFilter(model, iterations=5),
    "error state": tf.ErrorStateKalmanFilter(model, iterations=5),
    "unscented, once": tf.UnscentedKalmanFilter(model),
    "naive unscented": tf.UnscentedKalmanFilter(plain_model, iterations=5),
}
errors, late_rms, lengths = {}, {}, {}
for name, tracker in filters.items():
    history = tracker(vectors, gyro, dt)
    lengths[name] = history.mean[..., :4].norm(dim=-1)
    errors[name] = apart_deg(history.mean[..., :4], attitudes.unsqueeze(1))
    late_rms[name] = errors[name][times > 10].square().mean(0).sqrt()
    last = [dt * (int((error > 10).nonzero()[-1]) + 1) for error in errors[name].mT]
    print(
        f"{name:15s}: last above 10 deg at {', '.join(f'{t:.1f}' for t in last)} s; "
        f"rms after 10 s {', '.join(f'{rms:.1f}' for rms in late_rms[name])} deg; "
        f"lengths {lengths[name].min():.2f} to {lengths[name].max():.2f}"
    )

for name in ("unscented", "error state"):
    assert (errors[name][times > 1] < 10).all() and (late_rms[name] < 1.5).all()
    assert (lengths[name] - 1).abs().max() < 1e-12
for name in ("unscented, once", "naive unscented"):
    assert late_rms[name].max() > 3 * late_rms["unscented"].max()
assert lengths["naive unscented"].min() < 0.5

# %% [markdown]
# From one of its three starts the naive filter is as good as the others; from another its numbers shrink to a third of
# their length or grow to several times it, and the angle that a deviation stands for shrinks and grows against them.
#
# ## A picture

# %%
from matplotlib.figure import Figure

figure = Figure(figsize=(12, 3.6), layout="constrained")
averages, charts, run = figure.subplots(1, 3)
bins = torch.linspace(0, 180, 37).tolist()
averages.hist(plain_error.tolist(), bins, color="#D55E00", alpha=0.7, label="plain average")
averages.hist(intrinsic_error.tolist(), bins, color="#0072B2", alpha=0.7, label="intrinsic mean")
averages.set_yscale("log")
averages.set_xlabel("error of the mean, deg")
averages.set_ylabel("clouds")
charts.semilogy(angles, by_angle[:, 1], "o-", color="#D55E00", label="left as it was")
charts.semilogy(angles, by_angle[:, 0], "o-", color="#0072B2", label="carried")
charts.set_xlabel("correction, deg")
charts.set_ylabel("relative error of the covariance")
for (name, error), colour in zip(errors.items(), ("#0072B2", "#009E73", "#CC79A7", "#D55E00"), strict=True):
    for row, line in enumerate(("-", "--", ":")):
        run.semilogy(times, error[:, row], line, lw=0.8, color=colour, label=None if row else name)
run.set_xlabel("time, s")
run.set_ylabel("attitude error, deg")
for ax in (averages, charts, run):
    ax.legend(fontsize=8)
figure.canvas.draw()  # figure.savefig("orientations.png") keeps it

# %% [markdown]
# ## Next
# A bank of such filters starts from anywhere, `docs/attitude_filters.md`; a real sensor in a real hand is in
# `docs/attitude_imu_mag.md`.
