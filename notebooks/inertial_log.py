# %% [markdown]
# # From a log to a track, and whether to believe it
#
# A car drove a loop with a consumer IMU and a satellite receiver (`data/car_urban_loop`). We read the log, let an
# inertial filter follow it, take the receiver away for half a minute, and ask two questions: how far off were we, and
# did the filter know?
#
# Open this file in Jupyter (with jupytext) or in an editor that knows `# %%` cells, or run it as a script.

# %%
import math

import torch

import torchfilt as tf
from torchfilt.io.car_loop import read_car_loop
from torchfilt.io.inertial import group_increments
from torchfilt.metrics import consistency
from torchfilt.models import attitude
from torchfilt.models.inertial.earth import LocalMetres
from torchfilt.models.inertial.navigation import NAVIGATION_SPACE, NavigationFixes, StrapdownTransition
from torchfilt.models.inertial.strapdown import compensate, join

# %% [markdown]
# ## The log
# The reader turns units and axes (body: right, forward, up; world: east, north, up) and refuses what cannot be true:
# time stamps that repeat or run backward, gaps, NaN, rates in degrees. Nothing below has to think of that again.

# %%
log = read_car_loop("data/car_urban_loop")
rate = 1 / log.time_s.diff().median().item()
print(f"{len(log.time_s)} inertial samples at {rate:.0f} Hz, {len(log.gnss.time_s)} fixes in {log.time_s[-1]:.0f} s")

# %% [markdown]
# ## Steps of the filter
# A quarter of a second each, from 9.5 s, when the car is about to start. Within a step the car turns: `compensate`
# refers each sample to the axes it began in, `join` puts them together as rotations. Fixes come every half second:
# every second step has one, the others are NaN, *not measured*.

# %%
start_s, step_s = 9.5, 0.25
times = start_s + step_s * torch.arange(1521, dtype=torch.float64)
steps = group_increments(log, times_s=times)
span = steps.sample_dt_s.unsqueeze(-1)
samples = (steps.gyro_rad_s * span, steps.accel_m_s2 * span)
controls = torch.cat(join(*compensate(*(part.unsqueeze(-2) for part in samples))), -1)

first = torch.searchsorted(log.gnss.time_s, start_s)
place = (log.gnss.latitude_rad, log.gnss.longitude_rad, log.gnss.height_m)
origin = LocalMetres(*(float(part[first]) for part in place))
position, velocity = origin.to_metres(*place), log.gnss.velocity_m_s
row = ((log.gnss.time_s - start_s) / step_s).round().long() - 1
used = (row >= 0) & (row < len(times) - 1)

# %% [markdown]
# ## A model is three laws
# The state is attitude (a quaternion), velocity, position and the two sensors' biases: 16 numbers, 15 dimensions of
# error. Where it starts comes from the standstill: gravity gives the tilt, the mean rate the gyro's bias. The heading
# is what the receiver's course will be once the car moves; half a radian of doubt, and the filter finds the rest.

# %%
still = log.time_s < 8.0
force, bias = log.accel_m_s2[still].mean(0), log.gyro_rad_s[still].mean(0)
pitch = torch.atan2(force[1], force[[0, 2]].norm())
roll = torch.atan2(-force[0], force[2])
moving = (log.gnss.time_s > start_s) & (velocity.norm(dim=-1) > 3.0)
east, north, _ = velocity[moving][0]
quaternion = attitude.from_euler(torch.atan2(east, north), pitch, roll)
zero = torch.zeros(3, dtype=torch.float64)
mean = torch.cat([quaternion, zero, zero, bias, zero])
deviation = torch.tensor([0.03, 0.03, 0.5, 0.3, 0.3, 0.3, 1, 1, 2, *[1e-3] * 3, *[0.2] * 3], dtype=torch.float64)

motion = StrapdownTransition(
    origin,
    angle_random_walk_rad_sqrt_s=2e-4,
    velocity_random_walk_m_s_sqrt_s=0.045,
    gyro_bias_walk_rad_s_sqrt_s=1e-5,
    accel_bias_walk_m_s2_sqrt_s=1e-3,
)


def navigator(position_sd_m, velocity_sd_m_s):
    """An error-state filter whose receiver has these standard deviations."""
    prior = tf.Gaussian(mean, deviation, NAVIGATION_SPACE, is_diagonal=True)
    fixes = NavigationFixes(position_sd_m=position_sd_m, velocity_sd_m_s=velocity_sd_m_s)
    return tf.ErrorStateKalmanFilter(tf.StateSpaceModel(prior, motion, fixes))


# %% [markdown]
# ## Take the receiver away
# Two rows of one batch: row 0 has every fix, row 1 none from 200 to 230 s. The withheld fixes are the truth here.

# %%
filter = navigator(0.3, 0.2)
fix = torch.full((len(times) - 1, 2, 6), torch.nan, dtype=torch.float64)
fix[row[used]] = torch.cat([position, velocity], -1)[used].unsqueeze(1)
gap = (times[1:] > 200) & (times[1:] <= 230)
fix[gap, 1] = torch.nan
history = filter(fix, controls, step_s)

in_gap = used & (log.gnss.time_s > 200) & (log.gnss.time_s <= 230)
error = history.mean[row[in_gap], 1, 7:9] - position[in_gap, :2]
claimed = history.covariance[row[in_gap], 1][:, 6:8, 6:8].diagonal(dim1=-2, dim2=-1).sum(-1).sqrt()
for seconds in (10, 20, 30):
    k = 2 * seconds - 1
    print(f"after {seconds} s without fixes: off by {error[k].norm():.1f} m, the filter says {claimed[k]:.1f} m")

# %% [markdown]
# ## Does the filter know how good it is?
# The normalised innovation squared (NIS) compares each fix with what the filter expected, in units of what it claims.
# Its mean should be the number of measured components, six. The receiver hands out *smoothed* fixes, which scatter far
# less than they are wrong, so a filter with honest deviations looks too careful, and one that is tuned until the NIS
# fits believes in millimetres. The test tells; what to believe is still ours to say: the fixes share an error of about
# a metre that no innovation can show.

# %%
for label, deviations in {"honest": (0.3, 0.2), "tuned": (torch.tensor([6e-3, 6e-3, 2e-2]).double(), 0.055)}.items():
    run = navigator(*deviations)(fix[:, :1], controls, step_s)
    nis = run.diagnostics.nis[row[used]]
    print(f"{label}: {consistency(nis, 6, effective_steps=len(nis), name='NIS')}")

# %% [markdown]
# ## A picture

# %%
from matplotlib.figure import Figure

figure = Figure(figsize=(9, 4), layout="constrained")
path, growth = figure.subplots(1, 2)
path.plot(*position[used, :2].mT, ".", ms=2, color="0.6", label="fixes")
path.plot(*history.mean[:, 1, 7:9].mT, lw=1.0, color="#0072B2", label="filter")
path.plot(*history.mean[gap, 1, 7:9].mT, lw=2.0, color="#D55E00", label="without fixes")
path.set_aspect("equal")
path.set_xlabel("east, m")
path.set_ylabel("north, m")
path.legend(fontsize=8)
elapsed = log.gnss.time_s[in_gap] - 200
growth.plot(elapsed, error.norm(dim=-1), color="#D55E00", label="error")
growth.plot(elapsed, claimed, "--", color="0.3", label="claimed")
growth.set_xlabel("time without fixes, s")
growth.set_ylabel("horizontal, m")
growth.legend(fontsize=8)
figure.canvas.draw()  # figure.savefig("track.png") keeps it

# %% [markdown]
# ## Next
# Constrain the car to its wheels (`NavigationFixes(body_velocity_sd_m_s=...)`), which cuts the error after a minute
# without fixes about ten times, or fly: `scripts/run_inertial.py --help`.
heading = math.degrees(attitude.to_euler(history.mean[-1, 0, :4])[0])
print(f"the drive ends with a heading of {heading % 360:.1f} deg")
