# %% [markdown]
# # A first filter
#
# A satellite is followed by the radar of another one, 400 m away. We write the model as three laws, hand it to several
# filters without changing a line, look at a stream, and ask whether the errors are as large as the filter says.
#
# Open this file in Jupyter (with jupytext) or in an editor that knows `# %%` cells, or run it as a script.

# %%
import torch

import torchfilt as tf
from torchfilt.metrics import chi_square_band, nees
from torchfilt.models import relative_motion as rm

# %% [markdown]
# ## Truth and measurements
# Two satellites under J2, J3, J4 and drag, a tenth of a revolution; the radar's errors are drawn for 50 runs at once.

# %%
settings = rm.FormationSettings()
truth = rm.simulate_formation(settings, 10.0 * torch.arange(61, dtype=torch.float64))
states = truth.relative_m_m_s
radar = rm.RendezvousRadar(settings.semi_major_axis_m)
generator = torch.Generator().manual_seed(0)
noise = torch.randn(60, 50, 3, generator=generator, dtype=torch.float64)
measurements = radar(states[1:]).mean.unsqueeze(1) + radar.standard_deviation * noise
measurements[30:36] = torch.nan  # the radar is silent for a minute

# %% [markdown]
# ## A model is three laws
# The motion is Clohessy and Wiltshire's, with white acceleration noise for all that it leaves out.

# %%
deviation = torch.tensor([1.0, 1.0, 1.0, 0.01, 0.01, 0.01], dtype=torch.float64)
start = states[0] + deviation * torch.randn(50, 6, generator=generator, dtype=torch.float64)
prior = tf.Gaussian(start, torch.diag(deviation))
model = tf.StateSpaceModel(prior, rm.ClohessyWiltshire(settings.mean_motion_rad_s, 3e-9, dt_s=10.0), radar)

# %% [markdown]
# ## Any filter
# `nees` is the error measured in the filter's own covariance. Averaged over runs it should lie inside the band.

# %%
band = chi_square_band(6, 50)
filters = {
    "EKF": tf.ExtendedKalmanFilter(model),
    "UKF": tf.UnscentedKalmanFilter(model),
    "cubature": tf.CubatureKalmanFilter(model),
    "UPF, 50 particles": tf.UnscentedParticleFilter(model, particles=50),
}
results = {name: run(measurements, dt=10.0) for name, run in filters.items()}
for name, history in results.items():
    error = history.mean - states[1:].unsqueeze(1)
    rmse = error[..., :3].square().sum(-1).mean(1).sqrt()
    consistency = nees(history.mean, states[1:].unsqueeze(1), history.covariance).mean(1)
    print(
        f"{name:18s} position error at the end {rmse[-1]:.3f} m, NEES {consistency[-1]:.1f} "
        f"(95 % band {band.low:.1f} to {band.high:.1f}), log-likelihood {history.log_likelihood.mean():.1f}"
    )

# %% [markdown]
# ## The same filter as a stream
# `step` gives the same bits as the whole series.

# %%
ukf = filters["UKF"]
state = ukf.init((50,))
for y in measurements:
    state, info = ukf.step(state, y, dt=10.0)
assert torch.equal(state.belief.mean, results["UKF"].mean[-1])

# %% [markdown]
# ## A picture

# %%
from matplotlib.figure import Figure

figure = Figure(figsize=(7, 3), layout="constrained")
axes = figure.subplots()
history = results["UKF"]
time_s = 10.0 * torch.arange(1, 61)
sigma = history.covariance[:, 0, 0, 0].sqrt()
axes.fill_between(time_s, -3 * sigma, 3 * sigma, color="0.85", lw=0, label="3 sigma")
axes.plot(time_s, history.mean[:, 0, 0] - states[1:, 0], label="radial error of one run")
axes.set_xlabel("time, s")
axes.set_ylabel("m")
axes.legend()
figure
