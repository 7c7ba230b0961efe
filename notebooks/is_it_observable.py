# %% [markdown]
# # Is it observable?
#
# A filter gives a number for every state that it is asked for, also for those that its sensors say nothing about: there
# it repeats what it was told at the start. Which states are these, with which sensors, over which manoeuvre? We go from
# two states to the fifteen errors of an inertial navigation system, and to laws that are not linear.
#
# Open this file in Jupyter (with jupytext) or in an editor that knows `# %%` cells, or run it as a script.

# %%
import math

import torch
from matplotlib.figure import Figure

from torchfilt.models import control, landing
from torchfilt.models.attitude import from_rotation_vector


def matrix(*rows):
    return torch.tensor(rows, dtype=torch.float64)


# %% [markdown]
# ## Two states
# Position and velocity, nothing else moves. Whoever measures the position sees the velocity in its change. Whoever
# measures the velocity knows how far it went, but not from where.

# %%
a = matrix([0, 1], [0, 0])
names = ("position", "velocity")
for sensor, c in (("position measured", matrix([1, 0])), ("velocity measured", matrix([0, 1]))):
    report = control.observability_report(control.obsv(a, c), names, title=sensor)
    print(report.table(), "\n")
    modes = control.pbh(a, c)
    print(f"undetectable modes: {modes.eigenvalues[modes.undetectable].real.tolist()}\n")
assert report.unobserved == ("position",) and report.rank == 1

# %% [markdown]
# ## A bias
# The velocity comes from an accelerometer with a bias. From positions all three are seen. A velocity shows the bias
# too, and still no position.

# %%
chain = matrix([0, 1, 0], [0, 0, -1], [0, 0, 0])
chain_names = ("position", "velocity", "bias")
reports = [
    control.observability_report(control.obsv(chain, c), chain_names, title=title)
    for title, c in (
        ("position", matrix([1, 0, 0])),
        ("velocity", matrix([0, 1, 0])),
        ("accelerometer", matrix([0, 0, 1])),
    )
]
for report in reports:
    print(f"{report.title:14s} rank {report.rank}, not observed: {', '.join(report.unobserved) or '-'}")
assert [report.rank for report in reports] == [3, 2, 1]

# %% [markdown]
# ## The trap of units
# A wall of seven layers, each following its neighbour within an hour; a thermometer on the last one. All seven
# temperatures are seen. Counted in seconds the powers of the matrix fall by 3600 each, the last ones drown in rounding,
# and the rank is wrong. A time scale as long as the observation, an hour, puts it right. Never ask for the rank alone:
# look where the singular values stop.

# %%
layers = 7
wall = (torch.diag(torch.ones(layers - 1), -1) - torch.eye(layers)).double() / 3600
thermometer = torch.eye(layers, dtype=torch.float64)[-1:]
found = {}
for scale_s in (1.0, 3600.0):
    found[scale_s] = control.rank(control.obsv(wall, thermometer, time_scale=scale_s))
    values = ", ".join(f"{value:.0e}" for value in found[scale_s].singular_values)
    print(f"time scale {scale_s:6.0f} s: rank {int(found[scale_s].rank)}, singular values {values}")
assert int(found[1.0].rank) < layers == int(found[3600.0].rank)
# The Popov-Belevitch-Hautus test takes no powers, but this matrix has one eigenvalue seven times.
print(f"worst mode by itself: {float(control.pbh(wall * 3600, thermometer).singular_values.min()):.2f}")

# %% [markdown]
# States have units too: a position in metres beside a gyro bias in rad/s. Give the sizes that the states have,
# `control.INS_ERROR_SCALE` for the errors below: a heading error of 0.01 rad then weighs as much as one of 10 m.
#
# ## Inertial navigation
# Fifteen errors: attitude, velocity, position, biases of gyros and accelerometers. Seen from axes that turn with the
# heading, each steady manoeuvre is a linear system with constant matrices, and a flight is one after the other.

# %%
gravity, speed, rate = 9.80665, 30.0, 0.1
level = matrix([0, 0, gravity])[0]
climbing = from_rotation_vector(matrix([0.2, 0, 0])[0])


def pieces(*flown, sensors=("position",)):
    """Matrices of each manoeuvre."""
    all_of_them = {
        "level": (level, 0.0, None),
        "faster": (matrix([0, 2, gravity])[0], 0.0, None),
        "turn": (matrix([-speed * rate, 0, gravity])[0], rate, None),
        "climb": (level, 0.0, climbing),
    }
    return [control.ins_error_pair(f, w, sensors, q) for f, w, q in (all_of_them[name] for name in flown)]


both = ("position", "heading")
flights = {
    "velocity, level": pieces("level", sensors=("velocity",)),
    "position, level": pieces("level"),
    "position + heading, level": pieces("level", sensors=both),
    "position, level + faster": pieces("level", "faster"),
    "position, level + climb": pieces("level", "climb"),
    "position, turn": pieces("turn"),
    "position, level + turn": pieces("level", "turn"),
    "position, all four": pieces("level", "faster", "turn", "climb"),
}
reports = []
for title, flown in flights.items():
    # 20 s each; the matrix is exact for these times.
    total = control.total_observability(flown, [20.0] * (len(flown) - 1), time_scale=20.0)
    reports.append(
        control.observability_report(total, control.INS_ERROR_NAMES, title=title, scale=control.INS_ERROR_SCALE)
    )
    values = reports[-1].singular_values
    kept = reports[-1].rank
    dropped = f"{values[kept]:.0e}" if kept < 15 else "-"
    print(f"{title:26s} rank {kept}: smallest counted {values[kept - 1]:.1e}, largest not counted {dropped}")
assert [report.rank for report in reports] == [8, 11, 13, 14, 13, 12, 15, 15]

# %% [markdown]
# A turn that never begins is one constant system too, and not much better than level flight: it is the change of
# manoeuvre that shows the biases. In level flight four directions are hidden, and the table says which: the heading;
# the bias of the gyro that turns it; and the two tilts, each with the accelerometer bias that looks the same: a tilt of
# 1 rad pulls as 9.8 m/s^2.

# %%
print(reports[1].table())
assert reports[1].directions.shape == (4, 15)

# %%
ins_map = control.heat_map(reports)
ins_map.set_title("errors of an INS: what is observed")
ins_map.figure.canvas.draw()  # ins_map.figure.savefig("ins.png") keeps it

# %% [markdown]
# The stripped matrix leaves the motion between the pieces out and may stand in for the total one where nothing moves
# that a piece doesn't see. In level flight the unseen gyro bias turns the unseen heading, so that condition fails; here
# the ranks agree all the same. It is sufficient, not necessary.

# %%
for title, flown in flights.items():
    stripped = control.rank(control.stripped_observability(flown, time_scale=20.0), scale=control.INS_ERROR_SCALE)
    defect = control.stripping_defect(flown, time_scale=20.0, scale=control.INS_ERROR_SCALE)
    print(f"{title:26s} stripped rank {int(stripped.rank)}, defects {', '.join(f'{value:.1g}' for value in defect)}")
    assert int(stripped.rank) == next(report.rank for report in reports if report.title == title)

# %% [markdown]
# ## Observed, but how well?
# A rank says "in principle". The Gramian, whitened by the noise, is the information that measurements carry about the
# state at the start. With that of the prior, inverted and carried on to the end, it bounds what any filter can know
# then. Positions to 2 m once a second, 60 s of flight, biases that stay:


# %%
def known_sd(flown, duration_s, noise_m):
    """Bound of the deviation of each error at the end, with a prior of the sizes above."""
    information = torch.diag(control.INS_ERROR_SCALE**-2)
    past = torch.eye(15, dtype=torch.float64)
    for a, c in flown:
        step = control.observability_gramian(a, c / noise_m, duration_s / len(flown))
        information = information + past.mT @ step @ past
        past = torch.linalg.matrix_exp(a * duration_s / len(flown)) @ past
    return (past @ torch.linalg.inv(information) @ past.mT).diagonal().sqrt()


heading, gyro_up, push_right = (
    control.INS_ERROR_NAMES.index(name) for name in ("attitude up", "gyro bias up", "accelerometer bias right")
)
bounds = {}
for title in ("position, level", "position, level + faster", "position, level + turn"):
    bounds[title] = sd = known_sd(flights[title], 60.0, 2.0)
    print(
        f"{title:26s} heading to {math.degrees(sd[heading]):.3f} deg, gyro bias up to {sd[gyro_up] * 1e3:.2f} mrad/s, "
        f"accelerometer bias right to {sd[push_right] * 1e3:.0f} mm/s^2"
    )
straight, faster, turned = (float(sd[heading]) for sd in bounds.values())
assert turned < faster < straight / 1.5
assert bounds["position, level + turn"][push_right] < bounds["position, level + faster"][push_right] / 3

# %% [markdown]
# Rank 15 and rank 14 are closer than they look: after 30 s of turning the heading is known to a degree, where level
# flight has let it run away to three, and speeding up helps almost as much.

# %% [markdown]
# ## Laws that are not linear
# A multirotor lands on a beacon: the state holds an orientation, a camera sees the pad's direction, a barometer the
# height. There are no matrices to stack, so we try: each of the fifteen errors of the start is put in, up and down, all
# thirty runs at once, and the measurements answer. In units of their noise and of the prior's deviations a singular
# value says how much is learned: above one, more than was known before.

# %%
model = landing.landing_model(gauge=False)
start = model.prior().mean.clone()
start[7:10] = matrix([2, -1, 10])[0]  # beside the pad
steps, dt = 200, 0.2
clock = dt * torch.arange(steps, dtype=torch.float64)


def fly(east_m_s2, north_m_s2, turn_rad_s):
    """Increments (t, 6) of a flight with these accelerations that turns about the vertical."""
    none = torch.zeros_like(clock)
    turn = turn_rad_s + none
    heading = turn.cumsum(0) * dt - turn * dt  # when the step begins
    east, north = east_m_s2 + none, north_m_s2 + none
    right = heading.cos() * east + heading.sin() * north
    forward = heading.cos() * north - heading.sin() * east
    return torch.stack([none, none, turn, right, forward, gravity + none], -1) * dt


sway = 0.8 * (0.6 * clock).cos()  # goes 4.4 m to and fro
manoeuvres = {
    "hover": fly(0.0, 0.0, 0.0),
    "sway": fly(sway, 0.0, 0.0),
    "spin": fly(0.0, 0.0, 0.3),
    "hover, then spin": fly(0.0, 0.0, 0.3 * (clock >= 20)),
    "sway + spin": fly(sway, 0.8 * (0.5 * clock).cos(), 0.3),
}
deviations = model.prior().scale_tril
parts = ("attitude", "velocity", "position", "gyro bias", "accelerometer bias")
landing_names = [f"{part} {axis}" for part in parts for axis in "xyz"]
flown = {}
for title, u in manoeuvres.items():
    tried = control.empirical_gramian(model, start, u, dt)
    flown[title] = control.observability_report(
        tried.sensitivity, landing_names, title=title, scale=deviations, tolerance=1.0
    )
    values = flown[title].singular_values
    print(f"{title:16s} learned {flown[title].rank} of 15; singular values {values[0]:.0f} to {values[-1]:.0e}")

# %%
print(flown["sway + spin"].table())

# %% [markdown]
# As with the INS, it is not the spin but its beginning that tells the biases from the tilts. Swaying and spinning
# together, each at a pace of its own, never is one constant system.
#
# One direction is never seen, whatever is flown: a turn of everything, attitude, velocity and position, about the
# vertical through the pad. That is the symmetry that `landing.HeadingGauge` takes out.

# %%
whole_turn = torch.zeros(15, dtype=torch.float64)
whole_turn[2], whole_turn[6], whole_turn[7] = 1.0, -start[8], start[7]  # e_z, and e_z x position; the start is at rest
sensitivity = control.empirical_gramian(model, start, manoeuvres["sway + spin"], dt).sensitivity
seen, beside = (sensitivity @ whole_turn).norm(), (sensitivity[:, 2]).norm()
print(f"a radian of that turn changes the measurements by {seen:.1e} deviations, of attitude alone by {beside:.0f}")
assert seen < 1e-4 * beside
ranks = {title: report.rank for title, report in flown.items()}
assert ranks["hover"] == ranks["spin"] < ranks["hover, then spin"] < 15 and ranks["hover"] < ranks["sway + spin"] < 15

# %%
figure = Figure(figsize=(6.5, 5.5), layout="constrained")
landing_map = control.heat_map(list(flown.values()), figure.subplots())
landing_map.set_title("landing on a beacon: what 40 s teach")
figure.canvas.draw()

# %% [markdown]
# ## Next
# What a filter makes of states that it can't see, and how a symmetry is taken out: `docs/landing.md`.
