"""Everything that ships passes the public conformance suite, and the suite catches what is broken.

A new law, rule, filter, resampler or space is one line in a registry below.
"""

import inspect

import pytest
import symmetry_problem
import torch
from torch import nn

import torchfilt as tf
from torchfilt import moments, resampling
from torchfilt.gp import GPTransition
from torchfilt.gp.regression import GPRegression
from torchfilt.io.starry_night import Camera
from torchfilt.kernels import Regularize
from torchfilt.missions.airship import direct
from torchfilt.missions.airship import navigation as airship_navigation
from torchfilt.missions.attitude import descent, imu_mag, stars
from torchfilt.models import airship, landing, relative_motion
from torchfilt.models.attitude import ATTITUDE_SPACE, GyroTransition, VectorMeasurement, kinematics
from torchfilt.models.control import ContinuousLinear, ContinuousTransition, continuous, ss
from torchfilt.models.inertial import error_model, navigation
from torchfilt.models.inertial.earth import LocalMetres
from torchfilt.models.inertial.error_model import InertialErrorFixes, InertialErrorTransition
from torchfilt.models.inertial.flight import fly, reconnaissance
from torchfilt.models.inertial.imu import MEMS, MEMS_START
from torchfilt.models.inertial.navigation import NavigationFixes, StrapdownTransition
from torchfilt.models.inertial.strapdown import Navigation, increments
from torchfilt.models.relative_motion import (
    BiasedRanging,
    ClohessyWiltshire,
    FormationSettings,
    HarmonicForce,
    LinearTimeVarying,
    RendezvousRadar,
    TwoBody,
    WithConstant,
    chief_controls,
    phase,
    simulate_formation,
)
from torchfilt.models.sensors import barometer, magnetometer, ranges, ultrasonic
from torchfilt.moves import MetropolisHastings
from torchfilt.resampling import Resampler, ess_below, kld_adaptive
from torchfilt.spaces import Angle, Euclidean, Product, UnitQuaternion
from torchfilt.testing import check_filter, check_law, check_resampler, check_rule, check_space, check_symmetry

DOUBLE = torch.float64


def normal(*shape, seed=0, scale=1.0):
    return scale * torch.randn(shape, generator=torch.Generator().manual_seed(seed), dtype=DOUBLE)


def spd(size, seed=0):
    a = normal(size, size, seed=seed, scale=0.3)
    return a @ a.mT + 0.5 * torch.eye(size, dtype=DOUBLE)


# ----------------------------------------------------------------------------------------------------------------------
# Laws

CHIEF, RELATIVE = simulate_formation(FormationSettings(eccentricity=0.01), 10 * torch.arange(6, dtype=DOUBLE))
CONTROLS = chief_controls(CHIEF)
RADIUS = torch.linalg.vector_norm(CHIEF.position_m[0])
NEAR = RELATIVE[0] + normal(5, 6, seed=1) * torch.tensor([20.0, 20, 20, 0.02, 0.02, 0.02]).double()
BIASED = torch.cat([NEAR, normal(5, 1, seed=2)], -1)

ORIGIN = LocalMetres(0.6, 1.9, 2000.0)
FLOWN = fly(reconnaissance(), 100 + 0.01 * torch.arange(101, dtype=DOUBLE))
SINS_ERRORS = error_model.start_law(MEMS_START, MEMS).sample(normal(5, 15, seed=12))
SINS = error_model.sins_inputs(
    error_model.add_error(Navigation(*(part[0] for part in FLOWN.navigation)), SINS_ERRORS, ORIGIN),
    FLOWN.dtheta_rad.unsqueeze(1),
    FLOWN.dvelocity_m_s.unsqueeze(1),
    0.01,
).u[0]
HOVER = normal(4, 16, seed=20) * torch.tensor([0.3] * 3 + [1.0] + [2.0] * 6 + [0.01] * 6, dtype=DOUBLE)
HOVER = torch.cat(
    [torch.nn.functional.normalize(HOVER[:, :4], dim=-1), HOVER[:, 4:9], HOVER[:, 9:10].abs() + 8, HOVER[:, 10:]], -1
)
HOVER_PUSH = torch.cat([normal(3, seed=28, scale=0.02), torch.tensor([0.0, 0.0, 0.245], dtype=DOUBLE)])
STATES = navigation.NAVIGATION_SPACE.retract(
    navigation.navigation_state(Navigation(*(part[0] for part in FLOWN.navigation)), ORIGIN),
    normal(5, 15, seed=15) * torch.tensor([0.1, 1.0, 100.0, 1e-3, 1e-2], dtype=DOUBLE).repeat_interleave(3),
)
ATTITUDES = ATTITUDE_SPACE.retract(
    torch.tensor([0.5, -0.5, 0.5, 0.5, 0.01, 0.0, -0.01], dtype=DOUBLE), normal(5, 6, seed=22)
)
POSES = stars.POSE_SPACE.retract(
    torch.tensor([0.5, -0.5, 0.5, 0.5, 1.0, 2.0, -1.0], dtype=DOUBLE), normal(5, 6, seed=25)
)
FALLING = descent.DESCENT_SPACE.retract(
    torch.tensor([900.0, -25.0, 0.3, 2.0, -1.0, 0.5, -0.5, 0.5, 0.5, 0.01, 0.0, -0.01], dtype=DOUBLE),
    normal(5, 11, seed=31),
)
AFLOAT = airship.AIRSHIP_SPACE.retract(
    torch.tensor([0.5, -0.5, 0.5, 0.5, 0.0, 1.0, 0.0, 5.0, -2.0, 3.0, 0.0, 0.1, 0.0], dtype=DOUBLE),
    normal(5, 12, seed=33, scale=0.3),
)
SWINGING = torch.cat([HOVER, normal(4, 6, seed=34)], -1)
DIRECT = direct.DirectTransition(
    0.05,
    rate_sd_rad_s=0.1,
    rate_time_s=1.0,
    acceleration_sd_m_s2=0.2,
    acceleration_time_s=2.0,
    gyro_bias_walk_rad_s_sqrt_s=1e-5,
    accel_bias_walk_m_s2_sqrt_s=1e-4,
)
CAMERA = Camera(torch.tensor([0.5, 0.5, -0.5, 0.5], dtype=DOUBLE), normal(3, seed=26, scale=0.1), 0.24)
INCREMENTS = torch.cat(increments(FLOWN.dtheta_rad / 0.01, FLOWN.dvelocity_m_s / 0.01, 0.01, 20), -1)
IMU_WALKS = dict(
    angle_random_walk_rad_sqrt_s=1e-4,
    velocity_random_walk_m_s_sqrt_s=1e-3,
    gyro_bias_walk_rad_s_sqrt_s=1e-6,
    accel_bias_walk_m_s2_sqrt_s=1e-5,
)


def swing(x, u=None, dt=None):
    step = (0.1 if dt is None else dt) * torch.stack([x[..., 1], -x[..., 0].sin()], -1)
    return x + step if u is None else x + step + 0.1 * u


def learned(target="identity", nominal=None, context=None, kernel="ard", **options):
    """A small GP over the states near the formation, untrained: its law obeys the same rules."""
    x = normal(30, 6, seed=3) * torch.tensor([20.0, 20, 20, 0.02, 0.02, 0.02]).double() + RELATIVE[0]
    angle = torch.linspace(0, 6, 30, dtype=DOUBLE)
    circle = None if context is None else torch.stack([angle.cos(), angle.sin()], -1)
    regression = GPRegression(x, 0.01 * (x - RELATIVE[0]).roll(1, -1).sin(), circle, kernel=kernel)
    return GPTransition(regression, nominal, context=context, target=target, dt=10.0, **options)


class Heavy(nn.Module):
    """A `torch.distributions` law."""

    def __init__(self):
        super().__init__()
        self.register_buffer("scale", torch.tensor([0.3, 0.5], dtype=DOUBLE))

    def forward(self, x):
        return torch.distributions.StudentT(4.0, x.sin(), self.scale, validate_args=False)


X2 = normal(5, 2, seed=4)
LAWS = {
    "LinearGaussian": (tf.LinearGaussian(normal(2, 2), spd(2)), X2, None, None),
    "LinearGaussian control": (
        tf.LinearGaussian(normal(3, 2), spd(3), normal(3), control_matrix=normal(3, 2, seed=5), trainable=True),
        X2,
        normal(5, 2, seed=6),
        None,
    ),
    "LinearGaussian matrix a row": (tf.LinearGaussian(normal(1, 3, 2), spd(3)), X2, None, None),
    "AdditiveGaussian": (tf.AdditiveGaussian(swing, spd(2)), X2, None, 0.1),
    "AdditiveGaussian control": (tf.AdditiveGaussian(swing, spd(2), trainable=True), X2, normal(2, seed=7), 0.1),
    "AdditiveGaussian angle": (tf.AdditiveGaussian(lambda x: x.sin(), spd(2), Angle(2)), 3 * X2, None, None),
    "torch Distribution": (Heavy(), X2, None, None),
    "ClohessyWiltshire": (ClohessyWiltshire(1.1e-3, 1e-9), NEAR, None, 10.0),
    "ClohessyWiltshire held": (ClohessyWiltshire(1.1e-3, 1e-9, dt_s=10.0), NEAR, normal(5, 3, scale=1e-3), None),
    "ClohessyWiltshire dt a row": (
        ClohessyWiltshire(1.1e-3, 1e-9),
        NEAR,
        normal(3, scale=1e-3),
        torch.tensor([[10.0], [20.0], [0.5], [10.0], [1.0]], dtype=DOUBLE),
    ),
    "TwoBody": (TwoBody(1e-9), NEAR, CONTROLS[0], 10.0),
    "TwoBody J2, control a row": (TwoBody(1e-9, j2=1e-3, steps=2), NEAR, CONTROLS, 10.0),
    "LinearTimeVarying": (LinearTimeVarying(1e-9), NEAR, CONTROLS[0], 10.0),
    "LinearTimeVarying control a row": (LinearTimeVarying(1e-9, j2=1e-3), NEAR, CONTROLS, 10.0),
    "WithConstant": (WithConstant(ClohessyWiltshire(1.1e-3, 1e-9), drift_psd=1e-6), BIASED, None, 10.0),
    "WithConstant two-body": (WithConstant(TwoBody(1e-9), drift_psd=1e-6), BIASED, CONTROLS, 10.0),
    "WithConstant learned": (WithConstant(learned(), drift_psd=1e-6), BIASED, None, 10.0),
    "HarmonicForce": (
        HarmonicForce(ClohessyWiltshire(1.1e-3, 1e-9), 1, 1e-18),
        torch.cat([NEAR, normal(5, 9, seed=11, scale=1e-6)], -1),
        CONTROLS,
        10.0,
    ),
    "RendezvousRadar": (RendezvousRadar(RADIUS), NEAR, None, None),
    "BiasedRanging": (BiasedRanging(RADIUS, 0.01, 1e-3, 1e-3), BIASED, None, None),
    "InertialErrorTransition": (InertialErrorTransition(ORIGIN, 1e-4, 1e-3), SINS_ERRORS, SINS, 1.0),
    "InertialErrorTransition dt a row": (
        InertialErrorTransition(ORIGIN, 1e-4, 1e-3),
        SINS_ERRORS,
        SINS[0],
        torch.tensor([[1.0], [0.5], [2.0], [0.1], [1.0]], dtype=DOUBLE),
    ),
    "InertialErrorFixes": (InertialErrorFixes(1e-3, 10.0, 10.0), SINS_ERRORS, SINS, None),
    "InertialErrorFixes outliers": (InertialErrorFixes(1e-3, 10.0, 10.0, 0.15), SINS_ERRORS, SINS, None),
    "StrapdownTransition": (StrapdownTransition(ORIGIN, **IMU_WALKS), STATES, INCREMENTS, 0.2),
    "StrapdownTransition biases decay, dt a row": (
        StrapdownTransition(ORIGIN, **IMU_WALKS, gyro_bias_time_s=50.0, accel_bias_time_s=20.0),
        STATES,
        INCREMENTS[0],
        torch.tensor([[0.1], [0.0], [2.0], [0.5], [0.1]], dtype=DOUBLE),
    ),
    "GyroTransition": (GyroTransition(1e-3, 1e-5), ATTITUDES, normal(3, seed=23), 0.1),
    "GyroTransition dt a row": (
        GyroTransition(1e-3, 1e-5, gyro_bias_time_s=20.0),
        ATTITUDES,
        normal(5, 3, seed=23),
        torch.tensor([[0.1], [0.2], [0.0], [1.0], [0.5]], dtype=DOUBLE),
    ),
    "VectorMeasurement": (VectorMeasurement(normal(3, seed=24), 0.2), ATTITUDES, None, None),
    "VectorMeasurement of a navigation state": (VectorMeasurement(normal(3, seed=24), 0.2), STATES, None, None),
    "LandingTransition": (landing.LandingTransition(3e-4, 0.01), HOVER, HOVER_PUSH, 0.025),
    "LandingTransition walks": (landing.LandingTransition(3e-4, 0.01, 1e-5, 1e-3), HOVER, HOVER_PUSH, 0.025),
    "Barometer": (landing.Barometer(0.4), HOVER, None, None),
    "Beacon": (landing.Beacon(0.007), HOVER, None, None),
    "PoseTransition": (
        stars.PoseTransition(*normal(2, 3, seed=27).exp()),
        POSES,
        normal(5, 6, seed=28),
        torch.tensor([[0.1], [0.2], [0.5], [1.0], [0.05]], dtype=DOUBLE),
    ),
    "Sightings": (stars.Sightings(10 * normal(4, 3, seed=29), CAMERA, normal(2, seed=30).exp()), POSES, None, None),
    "RestingRate": (imu_mag._RestingRate(1e-3), ATTITUDES, None, None),
    "DescentMotion": (descent.DescentMotion(descent.DescentSettings(), 0.1), FALLING, normal(3, seed=32), None),
    "Descent Barometer": (descent.Barometer(87_000.0, 30.0, 0.05, 11), FALLING, None, None),
    "SpecificForce": (descent.SpecificForce(0.7), FALLING, None, None),
    "BarometricAltimeter": (barometer.BarometricAltimeter(sd_pa=3.0, lagged=14, offset=15), HOVER, None, None),
    "WithAltimeter": (
        barometer.WithAltimeter(landing.LandingTransition(3e-4, 0.01), 0.4, 0.05),
        torch.cat([HOVER, normal(4, 2, seed=31)], -1),
        HOVER_PUSH,
        0.025,
    ),
    "UltrasonicRange": (ultrasonic.UltrasonicRange(0.02, 0.01), HOVER, None, None),
    "Magnetometer": (magnetometer.Magnetometer(normal(3, seed=24), 0.2, hard_iron_at=13), HOVER, None, None),
    "BeaconRanges": (ranges.BeaconRanges(normal(4, 3, seed=35, scale=20.0), 0.03), HOVER, None, None),
    "AirshipTransition": (airship.AirshipTransition(), AFLOAT, torch.tensor([0.1, 0.0, 0.02], dtype=DOUBLE), 0.1),
    "DirectTransition": (DIRECT, SWINGING, None, 0.05),
    "WithAltimeter direct": (
        barometer.WithAltimeter(DIRECT, 0.4, 0.05, constants=3),
        torch.cat([SWINGING, normal(4, 5, seed=36)], -1),
        None,
        0.05,
    ),
    "InertialMeasurement": (direct.InertialMeasurement(0.05, 1e-4, 1e-3), SWINGING, None, None),
    "Mooring": (airship_navigation._Mooring(22), SWINGING, None, None),
    "NavigationFixes": (NavigationFixes(position_sd_m=2.0, heading_sd_rad=0.1), STATES, None, None),
    "NavigationFixes all, with arms": (
        NavigationFixes(
            position_sd_m=2.0,
            velocity_sd_m_s=0.1,
            height_sd_m=1.0,
            heading_sd_rad=0.1,
            body_velocity_sd_m_s=0.2,
            antenna_m=normal(3, seed=13),
            axle_m=normal(3, seed=14),
        ),
        STATES,
        INCREMENTS,
        0.2,
    ),
    "Sensors": (
        tf.Sensors(
            level=tf.LinearGaussian(normal(1, 2, seed=16), spd(1)),
            compass=tf.AdditiveGaussian(lambda x: x.sin(), spd(2), Angle(2)),
            bound=tf.PseudoMeasurement(lambda x: x[..., :1] - x[..., 1:].cos(), 1, 0.2),
        ),
        X2,
        None,
        None,
    ),
    "Sensors linear": (
        tf.Sensors(
            level=tf.LinearGaussian(normal(1, 2, seed=16), spd(1), control_matrix=normal(1, 2, seed=17)),
            bound=tf.PseudoMeasurement(normal(1, 2, seed=18), 1, 0.2, 1.0),
        ),
        X2,
        normal(5, 2, seed=6),
        None,
    ),
    "PseudoMeasurement": (
        tf.PseudoMeasurement(
            lambda x: x.sin(), 2, torch.tensor([0.1, 0.0], dtype=DOUBLE), jacobian=lambda x: torch.diag_embed(x.cos())
        ),
        X2,
        None,
        None,
    ),
    "ContinuousLinear": (
        ContinuousLinear(normal(2, 2, seed=31), spd(1), normal(2, 1, seed=32), normal(2, 1, seed=33)),
        X2,
        normal(5, 1, seed=34),
        torch.tensor([[0.1], [0.0], [2.0], [0.5], [0.1]], dtype=DOUBLE),
    ),
    "ContinuousTransition": (
        ContinuousTransition(lambda x, u: x.roll(1, -1).sin() + u, spd(1), normal(2, 1, seed=32), steps=2),
        X2,
        normal(5, 2, seed=34),
        torch.tensor([[0.1], [0.0], [2.0], [0.5], [0.1]], dtype=DOUBLE),
    ),
    "GPTransition identity": (learned(), NEAR, None, None),
    "GPTransition next state": (learned("next_state", noise="latent"), NEAR, None, 10.0),
    "GPTransition residual": (learned("residual", ClohessyWiltshire(1.1e-3, 1e-9)), NEAR, None, 10.0),
    "GPTransition centre": (learned("residual", TwoBody(1e-9), pooling="centre"), NEAR, CONTROLS, 10.0),
    "GPTransition structured": (
        learned("residual", TwoBody(1e-9), context=phase, kernel="structured"),
        NEAR,
        CONTROLS,
        10.0,
    ),
}
# Controls of an orbit in metres lose 0.5 m in float32: these laws take them in float64 beside a float32 state.
ABSOLUTE = ("TwoBody", "LinearTimeVarying", "two-body", "centre", "structured", "Harmonic")


@pytest.mark.parametrize("name", LAWS)
def test_laws(name):
    law, x, u, dt = LAWS[name]
    check_law(law, x, u, dt, tolerance=1e-9, single=not any(part in name for part in ABSOLUTE))


def test_every_law_is_registered():
    """Modules of the package whose call gives a Gaussian: none may be left out."""
    laws = {type(law) for law, *_ in LAWS.values()}
    models = (
        relative_motion,
        error_model,
        navigation,
        kinematics,
        landing,
        stars,
        descent,
        imu_mag,
        continuous,
        barometer,
        ultrasonic,
        magnetometer,
        ranges,
        airship,
        direct,
        airship_navigation,
    )
    shipped = {
        member
        for module in (tf.laws, tf.sensors, tf.gp, *models)
        for _, member in inspect.getmembers(module, inspect.isclass)
        if issubclass(member, nn.Module)
        and inspect.signature(member.forward).return_annotation in (tf.Gaussian, "Gaussian")
    }
    assert shipped and shipped <= laws, shipped - laws


# ----------------------------------------------------------------------------------------------------------------------
# Moment rules

RULES = {
    "taylor": moments.taylor(),
    "unscented": moments.unscented(),
    "unscented 0.5, 2, 0": moments.unscented(0.5, 2.0, 0.0),
    "unscented kappa 2": moments.unscented(1.0, 0.0, 2.0),
    "cubature": moments.cubature(),
    "gauss_hermite 2": moments.gauss_hermite(2),
    "gauss_hermite 3": moments.gauss_hermite(3),
    "gauss_hermite 5": moments.gauss_hermite(5),
}


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize("name", RULES)
def test_rules(name, dtype):
    check_rule(RULES[name], dtype)
    check_rule(RULES[name], dtype, size=5 if "hermite" not in name else 3)


# ----------------------------------------------------------------------------------------------------------------------
# Filters

LINEAR = tf.StateSpaceModel(
    tf.Gaussian(torch.zeros(2, dtype=DOUBLE), torch.eye(2, dtype=DOUBLE)),
    tf.LinearGaussian(torch.tensor([[1.0, 0.1], [-0.1, 0.95]], dtype=DOUBLE), 0.1 * spd(2)),
    tf.LinearGaussian(torch.eye(2, dtype=DOUBLE), 0.3 * spd(2, seed=1)),
)
SWINGING = tf.StateSpaceModel(
    tf.Gaussian(torch.tensor([0.3, 0.0], dtype=DOUBLE), 0.5 * torch.eye(2, dtype=DOUBLE)),
    tf.AdditiveGaussian(swing, 0.1 * spd(2)),
    tf.AdditiveGaussian(
        lambda x: torch.stack([x[..., 0], x[..., 1] + 0.1 * x[..., 0] ** 2], -1),
        0.3 * spd(2, seed=1),
        Product(Angle(1), Euclidean(1)),
    ),
)
ATTITUDE = Product(Euclidean(1), UnitQuaternion())


def spin(x):
    turn = torch.tensor([0.05, 0.0, 0.02], dtype=x.dtype)
    return torch.cat([0.9 * x[..., :1], UnitQuaternion().retract(x[..., 1:], turn.expand(*x.shape[:-1], 3))], -1)


def sight(x):
    """Scalar part and the world's x axis in body axes."""
    q = x[..., 1:]
    axis = torch.stack(
        [
            1 - 2 * (q[..., 1] ** 2 + q[..., 2] ** 2),
            2 * (q[..., 0] * q[..., 1] - q[..., 2] * q[..., 3]),
            2 * (q[..., 0] * q[..., 2] + q[..., 1] * q[..., 3]),
        ],
        -1,
    )
    return torch.cat([x[..., :1], axis], -1)


TURNING = tf.StateSpaceModel(
    tf.Gaussian(torch.tensor([0.5, 0, 0, 0, 1], dtype=DOUBLE), 0.4 * torch.eye(4, dtype=DOUBLE), ATTITUDE),
    tf.AdditiveGaussian(spin, 0.02 * spd(4), ATTITUDE),
    tf.AdditiveGaussian(sight, 0.1 * spd(4, seed=2)),
)
MODELS = {
    "linear": (LINEAR, normal(6, 3, 2, seed=8)),
    "swinging": (SWINGING, normal(6, 3, 2, seed=9)),
    "turning": (TURNING, normal(6, 3, 4, seed=10, scale=0.5)),
}
GAUSSIAN = {
    "ExtendedKalmanFilter": tf.ExtendedKalmanFilter,
    "ExtendedKalmanFilter iterated": lambda model: tf.ExtendedKalmanFilter(model, iterations=3),
    "UnscentedKalmanFilter": tf.UnscentedKalmanFilter,
    "UnscentedKalmanFilter iterated": lambda model: tf.UnscentedKalmanFilter(model, iterations=2),
    "CubatureKalmanFilter": tf.CubatureKalmanFilter,
    "ErrorStateKalmanFilter": tf.ErrorStateKalmanFilter,
    "ErrorStateKalmanFilter open loop": lambda model: tf.ErrorStateKalmanFilter(model, feedback=False),
    "GaussHermiteKalmanFilter": tf.GaussHermiteKalmanFilter,
}
JOINT = dict(redraw="always", split=0.0, pooled=False, weights="joint")
PARTICLE = {
    "Bootstrap always": lambda m: tf.BootstrapFilter(m, 40),
    "Bootstrap never": lambda m: tf.BootstrapFilter(m, 40, resampling.never()),
    "Bootstrap adaptive stratified": lambda m: tf.BootstrapFilter(m, 40, ess_below(0.5, resampling.stratified)),
    "Bootstrap multinomial": lambda m: tf.BootstrapFilter(m, 40, resampling.multinomial),
    "Bootstrap residual": lambda m: tf.BootstrapFilter(m, 40, ess_below(0.8, resampling.residual)),
    "Bootstrap adaptive number": lambda m: tf.BootstrapFilter(m, 40, kld_adaptive(0.6, 0.3, 0.1, 10)),
    "UPF adaptive number": lambda m: tf.UnscentedParticleFilter(
        m, 40, resampler=ess_below(0.7, kld_adaptive(0.3, 0.5, minimum=10))
    ),
    "Bootstrap fast normals": lambda m: tf.BootstrapFilter(m, 40, fast_normals=True),
    "Bootstrap moved": lambda m: tf.BootstrapFilter(m, 40, move=MetropolisHastings(2)),
    "Bootstrap moved, predictive": lambda m: tf.BootstrapFilter(
        m, 40, move=MetropolisHastings(1, 0.5, target="predictive")
    ),
    "Bootstrap moved, window": lambda m: tf.BootstrapFilter(m, 40, ess_below(0.8), MetropolisHastings(2, window=3)),
    "Resample-move": lambda m: tf.ResampleMoveParticleFilter(m, 60),
    "Resample-move, window": lambda m: tf.ResampleMoveParticleFilter(m, 60, window=3),
    "Regularized": lambda m: tf.RegularizedParticleFilter(m, 60),
    "Regularized plain, adaptive": lambda m: tf.RegularizedParticleFilter(
        m, 60, Regularize("epanechnikov", 0.3, keep_moments=False), ess_below(0.5)
    ),
    "Auxiliary": lambda m: tf.AuxiliaryParticleFilter(m, 40, 0.8, ess_below(0.9)),
    "UPF pooled": lambda m: tf.UnscentedParticleFilter(m, 20),
    "UPF joint": lambda m: tf.UnscentedParticleFilter(m, 20, **JOINT),
    "UPF joint, moved": lambda m: tf.UnscentedParticleFilter(m, 20, **JOINT, move=MetropolisHastings(1)),
    "UPF literal": lambda m: tf.UnscentedParticleFilter(m, 20, **(JOINT | dict(split=None))),
    "UPF taylor": lambda m: tf.UnscentedParticleFilter(m, 20, moments.taylor(), split=0.0, pooled=False),
    "LLPF": lambda m: tf.LocallyLinearizedParticleFilter(m, 20),
    "LLPF redrawn": lambda m: tf.LocallyLinearizedParticleFilter(m, 20, split=0.3, redraw="always"),
    "LLPF redrawn on resampling": lambda m: tf.LocallyLinearizedParticleFilter(m, 20, redraw="resample", split=0.0),
    "LLPF literal": lambda m: tf.LocallyLinearizedParticleFilter(m, 20, split=None, redraw="resample"),
    "LLPF never split": lambda m: tf.LocallyLinearizedParticleFilter(m, 20, split=1.0, resampler=resampling.systematic),
    "RBPF first drawn": lambda m: tf.RaoBlackwellizedParticleFilter(m, 20, drawn=[0]),
    "RBPF all but the first": lambda m: tf.RaoBlackwellizedParticleFilter(
        m, 20, drawn=slice(1, None), rule=moments.cubature(), resampler=resampling.systematic
    ),
    "ParticleFilter": lambda m: tf.ParticleFilter(m, 20, tf.proposals.Prior(), ess_below(0.5)),
}


class Noisy(nn.Module):
    """A law with five times its noise."""

    def __init__(self, law):
        super().__init__()
        self.law = law

    def forward(self, x, u, dt):
        usual = self.law(x, u, dt) if isinstance(self.law, tf.AdditiveGaussian) else self.law(x, u)
        return usual._replace(scale_tril=5 * usual.scale_tril)


def doubtful(model, name="observation", make=lambda law: tf.MixtureLaw([law, Noisy(law)], [0.9, 0.1])):
    """A law that is now and then five times as noisy."""
    laws = {"transition": model.transition, "observation": model.observation}
    return tf.StateSpaceModel(model.initial, **(laws | {name: make(laws[name])}))


def pieces(model, count=4):
    """The prior in a row along its first component."""
    split = tf.InitialMixture(tf.split_gaussian(model.prior(), count, 0))
    return tf.StateSpaceModel(split, model.transition, model.observation, gauge=model.gauge)


CHANCES = torch.tensor([[0.9, 0.1], [0.3, 0.7]], dtype=DOUBLE)
MIXTURE = {
    "GaussianSumFilter": lambda m: tf.GaussianSumFilter(pieces(m)),
    "GaussianSumFilter merged": lambda m: tf.GaussianSumFilter(doubtful(pieces(m)), moments.taylor(), components=5),
    "GaussianSumFilter noisy motion": lambda m: tf.GaussianSumFilter(doubtful(m, "transition"), components=3),
    "InteractingMultipleModel": lambda m: tf.InteractingMultipleModel([m, doubtful(m, make=Noisy)], CHANCES),
    "InteractingMultipleModel taylor": lambda m: tf.InteractingMultipleModel(
        [m, pieces(m)], CHANCES, moments.taylor(), torch.tensor([0.8, 0.2], dtype=DOUBLE)
    ),
}


LONG = ("GaussianSumFilter merged", "InteractingMultipleModel taylor")  # on quaternions


@pytest.mark.parametrize(
    ("name", "model"),
    [
        pytest.param(name, model, marks=pytest.mark.slow if model == "turning" and name in LONG else ())
        for name in MIXTURE
        for model in MODELS
    ],
)
def test_filters_of_mixtures(name, model):
    laws, ys = MODELS[model]
    check_filter(MIXTURE[name](laws), ys)


@pytest.mark.parametrize("name", ["GaussianSumFilter", "rates"])
def test_filters_of_mixtures_with_controls_and_time_steps(name):
    filter = tf.InteractingMultipleModel([SWINGING, pieces(SWINGING)], rates_per_s=CHANCES - CHANCES.sum(-1).diag())
    filter = MIXTURE[name](SWINGING) if name in MIXTURE else filter
    ys = MODELS["swinging"][1]
    dt = torch.tensor([0.1, 0.0, 0.2, 0.1, 0.3, 0.1], dtype=DOUBLE)
    check_filter(filter, ys, normal(6, 2), dt)
    check_filter(filter, ys, normal(6, 3, 2), dt.unsqueeze(-1) * torch.tensor([1.0, 0.5, 2.0]))


@pytest.mark.parametrize(
    ("name", "model"),
    [
        pytest.param(name, model, marks=pytest.mark.slow if (name[-8:], model) == ("iterated", "turning") else ())
        for name in GAUSSIAN
        for model in MODELS
    ],
)
def test_gaussian_filters(name, model):
    laws, ys = MODELS[model]
    check_filter(GAUSSIAN[name](laws), ys)


def test_kalman_filter():
    check_filter(tf.KalmanFilter(LINEAR), MODELS["linear"][1])


def test_filters_with_a_constant_gain():
    matrix = LINEAR.transition.matrix
    plant = ss(matrix, normal(2, 1), torch.eye(2, dtype=DOUBLE), dt=0.1)
    observer = tf.LuenbergerObserver(plant, 0.3 * spd(2), LINEAR.prior(), 0.1 * spd(2), 0.3 * spd(2, seed=1))
    check_filter(observer, MODELS["linear"][1], normal(6, 1), 0.1)
    for settled in (True, False):
        check_filter(tf.SteadyStateKalmanFilter(LINEAR, settled=settled), MODELS["linear"][1])


# On quaternions each takes seconds; these few stand for the rest, which run with the slow tests.
QUICK = ("Bootstrap adaptive stratified", "UPF pooled", "LLPF redrawn")
CASES = [
    pytest.param(name, model, marks=pytest.mark.slow if model == "turning" and name not in QUICK else ())
    for name in PARTICLE
    for model in MODELS
]


@pytest.mark.parametrize(("name", "model"), CASES)
def test_particle_filters(name, model):
    laws, ys = MODELS[model]
    check_filter(PARTICLE[name](laws), ys, random=name != "LLPF never split")


@pytest.mark.parametrize("name", ["UnscentedKalmanFilter", "ExtendedKalmanFilter"])
def test_gaussian_filters_with_controls_and_time_steps(name):
    _, ys = MODELS["swinging"]
    dt = torch.tensor([0.1, 0.0, 0.2, 0.1, 0.3, 0.1], dtype=DOUBLE)
    check_filter(GAUSSIAN[name](SWINGING), ys, normal(6, 2), dt)
    check_filter(GAUSSIAN[name](SWINGING), ys, normal(6, 3, 2), dt.unsqueeze(-1) * torch.tensor([1.0, 0.5, 2.0]))


@pytest.mark.parametrize(
    "name",
    ["Bootstrap always", "Bootstrap moved", "UPF pooled", "UPF joint", "LLPF redrawn", "RBPF first drawn"],
)
def test_particle_filters_with_controls_and_time_steps(name):
    _, ys = MODELS["swinging"]
    dt = torch.tensor([0.1, 0.0, 0.2, 0.1, 0.3, 0.1], dtype=DOUBLE)
    check_filter(PARTICLE[name](SWINGING), ys, normal(6, 2), dt)
    check_filter(PARTICLE[name](SWINGING), ys, normal(6, 3, 2), dt.unsqueeze(-1) * torch.tensor([1.0, 0.5, 2.0]))


# Sensors, a constraint, gates and a symmetry; 0.999 lets some of these made-up measurements pass and some not.
SENSORS = tf.StateSpaceModel(
    SWINGING.initial,
    SWINGING.transition,
    tf.Sensors(
        swing=tf.AdditiveGaussian(lambda x: x[..., :1], 0.3 * spd(1), Angle(1)),
        rate=tf.LinearGaussian(torch.tensor([[0.1, 1.0]], dtype=DOUBLE), 0.3 * spd(1, seed=1)),
        energy=tf.PseudoMeasurement(lambda x: x[..., 1:].square() / 2 - x[..., :1].cos(), 1, 0.5, -0.5),
    ),
)
GATE = tf.robust.Gate(0.9, outlier_log_density={"swing": -2.0}, sensors=("swing", "rate"))
GUARDED = {
    "UnscentedKalmanFilter gated": lambda m: tf.UnscentedKalmanFilter(m, gate=GATE),
    "LLPF gated": lambda m: tf.LocallyLinearizedParticleFilter(m, 20, gate=GATE),
    "Reacquire": lambda m: tf.robust.Reacquire(tf.UnscentedKalmanFilter(m, gate=GATE), "swing", 0.15),
    "Reacquire LLPF": lambda m: tf.robust.Reacquire(
        tf.LocallyLinearizedParticleFilter(m, 20, gate=GATE), "swing", 0.15
    ),
    "GaussianSumFilter gated": lambda m: tf.GaussianSumFilter(pieces(m), gate=GATE),
    "InteractingMultipleModel gated": lambda m: tf.InteractingMultipleModel([m, pieces(m)], CHANCES, gate=GATE),
}
SEEN = {name: GAUSSIAN[name] for name in ("ExtendedKalmanFilter", "UnscentedKalmanFilter iterated")}
SEEN |= {"GaussianSumFilter": MIXTURE["GaussianSumFilter"]}
SEEN |= {name: PARTICLE[name] for name in ("Bootstrap moved", "Regularized", "UPF pooled", "LLPF", "RBPF first drawn")}


@pytest.mark.parametrize("name", SEEN | GUARDED)
def test_filters_of_sensors(name):
    """With dt, by which patience is counted."""
    ys = SENSORS.observation.complete(torch.cat([normal(6, 3, 2, seed=9), torch.full((6, 3, 1), torch.nan)], -1))
    check_filter((SEEN | GUARDED)[name](SENSORS), ys, None, 0.1)


TURNED = ("ExtendedKalmanFilter", "UnscentedKalmanFilter", "Bootstrap adaptive stratified", "Regularized", "LLPF")
TURNED += ("GaussianSumFilter",)


@pytest.mark.parametrize("name", TURNED)
@pytest.mark.parametrize("own", [True, False], ids=["derivative of its own", "plain"])
def test_filters_in_a_gauge(name, own):
    sensors = tf.Sensors(camera=symmetry_problem.camera(0.3), range=symmetry_problem.ranging(1.0))
    gauge = symmetry_problem.NoseEast() if own else symmetry_problem.nose_east
    model = symmetry_problem.model(gauge, sensors, symmetry_problem.Drive(0.1))
    ys = torch.cat([normal(6, 3, 2, seed=9, scale=0.4), 11 + normal(6, 3, 1, seed=10)], -1)
    check_filter(
        (GAUSSIAN | PARTICLE | MIXTURE)[name](model), ys, torch.tensor(symmetry_problem.US[:6]), symmetry_problem.DT
    )


PLANE = torch.tensor([[1.0, 2.0, 0.5], [-3.0, 1.0, -2.5], [0.3, -4.0, 3.0]], dtype=DOUBLE)
SYMMETRIES = {
    "plane": (
        symmetry_problem.model(symmetry_problem.NoseEast(), symmetry_problem.camera(0.1)),
        PLANE,
        normal(3, 2, seed=19),
        0.5,
    ),
    "landing": (landing.landing_model(), HOVER, normal(4, 6, seed=21, scale=0.1), 0.025),
    "landing, unknown pad height": (
        landing.landing_model(landing.LandingStart(pad_height_sd_m=5.0)),
        torch.cat([HOVER, normal(4, 1, seed=22)], -1),
        normal(6, seed=21, scale=0.1),
        0.025,
    ),
}


@pytest.mark.parametrize("name", SYMMETRIES)
def test_symmetries(name):
    check_symmetry(*SYMMETRIES[name])


@pytest.mark.parametrize("name", ["unscented", "particle"])
def test_filters_of_the_formation(name):
    """A GP law with a nominal, phase and control in the loop."""
    law = learned("residual", TwoBody(1e-9), context=phase, kernel="structured")
    deviation = torch.tensor([20.0, 20, 20, 0.02, 0.02, 0.02]).double()
    model = tf.StateSpaceModel(tf.Gaussian(RELATIVE[0], deviation, is_diagonal=True), law, RendezvousRadar(RADIUS, 1.0))
    ys = RendezvousRadar(RADIUS).measure(RELATIVE[1:]).unsqueeze(1) + normal(5, 3, 3) * torch.tensor([1.0, 3e-4, 3e-4])
    make = tf.UnscentedKalmanFilter if name == "unscented" else lambda m: tf.UnscentedParticleFilter(m, 20)
    check_filter(make(model), ys, CONTROLS, 10.0, tolerance=1e-7, single=False)


# ----------------------------------------------------------------------------------------------------------------------
# Resamplers and spaces

RESAMPLERS = [resampling.systematic, resampling.stratified, resampling.residual, resampling.multinomial]


@pytest.mark.parametrize("n", [7, 50])
@pytest.mark.parametrize(
    "resampler", [*RESAMPLERS, ess_below(0.5), kld_adaptive(1.0)], ids=lambda r: f"{r.name}-{r.threshold}"
)
def test_resamplers(resampler, n):
    check_resampler(resampler, n, keeps_equal_weights=resampler.name != "multinomial")


def unit(*shape, seed=0):
    q = normal(*shape, seed=seed)
    return q / q.norm(dim=-1, keepdim=True)


SPACES = {
    "Euclidean": (Euclidean(3), normal(5, 3)),
    "Euclidean any": (Euclidean(), normal(5, 4)),
    "Angle": (Angle(2), torch.tensor([[3.1, -3.1], [0.0, 3.14], [-2.0, 1.0]], dtype=DOUBLE)),
    "UnitQuaternion right": (UnitQuaternion(), unit(6, 4)),
    "UnitQuaternion left": (UnitQuaternion("left"), unit(6, 4, seed=1)),
    "Product": (Product(Euclidean(2), Angle(1), UnitQuaternion()), torch.cat([normal(6, 3), unit(6, 4, seed=2)], -1)),
    "Product nested": (
        Product(Product(Angle(1), Euclidean(1)), UnitQuaternion("left")),
        torch.cat([normal(6, 2), unit(6, 4)], -1),
    ),
}


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize("name", SPACES)
def test_spaces(name, dtype):
    space, points = SPACES[name]
    check_space(space, points.to(dtype))


# ----------------------------------------------------------------------------------------------------------------------
# The suite catches what is broken


class Leaky(nn.Module):
    """A law with one defect."""

    def __init__(self, defect):
        super().__init__()
        self.defect, self.calls = defect, 0
        self.register_buffer("scale", 0.5 * torch.eye(2, dtype=DOUBLE))
        self.hidden = torch.ones(2, dtype=DOUBLE)

    def forward(self, x):
        self.calls += 1
        mean, scale = x.sin(), self.scale
        if self.defect == "mixes rows":
            mean = mean + 1e-3 * mean.mean(0, keepdim=True)
        if self.defect == "spreads NaN":
            mean = mean + 0 * x.sum()
        if self.defect == "leaks float64":
            mean = mean + torch.ones(2, dtype=DOUBLE)
        if self.defect == "remembers":
            mean = mean + self.calls
        if self.defect == "draws":
            torch.rand(1)
        if self.defect == "wrong size":
            scale = torch.eye(3, dtype=x.dtype)
        if self.defect == "not triangular":
            scale = scale + 0.1
        if self.defect == "infinite":
            mean = mean / 0
        if self.defect == "raises on NaN":
            return torch.distributions.Normal(mean, 1.0, validate_args=True)
        if self.defect == "not a law":
            return mean
        if self.defect == "drops a dim":
            mean = mean[0]
        if self.defect == "state outside state_dict":
            mean = mean * 1.0
            scale = self.scale + self.hidden.diag()
            self.hidden = self.scale.diagonal()
        return tf.Gaussian(mean, scale)


class WrongForm(tf.LinearGaussian):
    """A short cut that does not agree with the law."""

    def linear_form(self, u=None, dt=None):
        return super().linear_form(u, dt)

    def forward(self, x, u=None, dt=None):
        law = super().forward(x, u, dt)
        return law._replace(mean=law.mean + 1e-6)


BROKEN_LAWS = {
    "mixes rows": "alone and in the batch",
    "spreads NaN": "row that holds NaN",
    "leaks float64": "keep the dtype",
    "remembers": "two equal calls",
    "draws": "random generator",
    "wrong size": "scale_tril must end in",
    "not triangular": "lower triangular",
    "infinite": "must be finite",
    "raises on NaN": "row that holds NaN",
    "not a law": "returns a Gaussian",
    "drops a dim": "mean must be",
    "state outside state_dict": "two equal calls",
}


@pytest.mark.parametrize("defect", BROKEN_LAWS)
def test_broken_laws_are_caught(defect):
    with pytest.raises(AssertionError, match=BROKEN_LAWS[defect]):
        check_law(Leaky(defect), X2)
    check_law(Leaky("none"), X2)


def test_a_short_cut_that_disagrees_is_caught():
    with pytest.raises(AssertionError, match="linear_form"):
        check_law(WrongForm(normal(2, 2), spd(2)), X2)


class BrokenRule:
    """A moment rule with one defect."""

    def __init__(self, defect):
        self.defect, self.rule = defect, moments.unscented()

    def linearize(self, law, belief, u, dt):
        line = self.rule.linearize(law, belief, u, dt)
        if self.defect == "forgets the noise":
            return line._replace(noise=0.5 * line.noise)
        if self.defect == "wrong slope":
            return line._replace(slope=line.slope * 1.001)
        if self.defect == "mixes rows" and line.mean.dim() > 1:
            return line._replace(mean=line.mean + 0 * line.mean.sum(0))
        return line


@pytest.mark.parametrize(
    ("defect", "message"),
    [
        ("forgets the noise", "predicted covariance"),
        ("wrong slope", "predicted covariance"),
        ("mixes rows", "rows beside a row of NaN"),
    ],
)
def test_broken_rules_are_caught(defect, message):
    with pytest.raises(AssertionError, match=message):
        check_rule(BrokenRule(defect))
    check_rule(BrokenRule("none"))


class BrokenFilter(tf.ParticleFilter):
    """A particle filter with one defect."""

    def __init__(self, defect):
        super().__init__(LINEAR, 20, tf.proposals.Prior(), ess_below(0.5))
        self.defect, self.count, self.held = defect, 0, None

    def init(self, batch_shape=(), seed=0):
        return super().init(batch_shape, 0 if self.defect == "ignores the seed" else seed)

    def draw(self, belief, step, seed):
        return super().draw(belief, step, 0 if self.defect == "ignores the seed" else seed)

    def advance(self, belief, y, u=None, dt=None, noise=None, missing="rows", predict=True):
        self.count += 1
        if self.defect == "hidden state" and self.held is not None:
            belief = belief._replace(x=belief.x + 1e-9 * self.count)
        if self.defect == "global noise":
            noise = noise._replace(proposal=torch.randn_like(noise.proposal))
        if self.defect == "ignores one gap" and torch.isnan(y).any():
            y = torch.nan_to_num(y)
        if self.defect == "changes its input":
            belief.x.add_(1e-9)
        after, info = super().advance(belief, y, u, dt, noise, missing, predict)
        self.held = after
        if self.defect == "mixes rows":
            after = after._replace(x=after.x + 1e-6 * after.x.mean(0))
        if self.defect == "weights":
            after = after._replace(log_weights=after.log_weights + 1e-9)
        if self.defect == "always well":
            info = info._replace(ok=torch.ones_like(info.ok))
        if self.defect == "shape":
            info = info._replace(ess=info.ess.unsqueeze(-1))
        return after, info


@pytest.mark.parametrize(
    ("defect", "message"),
    [
        ("hidden state", "streaming|twice"),
        ("global noise", "twice"),
        ("ignores one gap", "log-likelihood 0"),
        ("changes its input", "must not change the state"),
        ("mixes rows", "rows beside a row"),
        ("weights", "sum to one"),
        ("always well", "ok = False"),
        ("shape", "diagnostics.ess"),
        ("ignores the seed", "another seed"),
    ],
)
def test_broken_filters_are_caught(defect, message):
    ys = MODELS["linear"][1]
    generator = torch.get_rng_state()
    with pytest.raises(AssertionError, match=message):
        check_filter(BrokenFilter(defect), ys)
    torch.set_rng_state(generator)
    check_filter(BrokenFilter("none"), ys)


def broken_resampler(defect):
    def ancestors(weights, uniforms):
        good = resampling.systematic(weights, uniforms)
        n = weights.shape[-1]
        if defect == "shifted":
            return (good + 1).clamp_max(n - 1)
        if defect == "greedy":
            return weights.argmax(-1, keepdim=True).expand_as(weights)
        if defect == "out of range":
            return good + 1
        if defect == "unsorted":
            return good.flip(-1)
        if defect == "batch":
            return resampling.systematic(weights, uniforms[:1].expand_as(uniforms)) if weights.dim() > 1 else good
        if defect == "slightly biased":
            return resampling.systematic(weights**1.02, uniforms)
        if defect == "wrong dtype":
            return good.int()
        return good

    return Resampler("broken", ancestors, one_uniform=True)


@pytest.mark.parametrize(
    ("defect", "message"),
    [
        ("shifted", "copies must be n times|weight zero"),
        ("greedy", "copies must be n times"),
        ("out of range", r"lie in \[0"),
        ("unsorted", "ascend"),
        ("batch", "alone and in the batch|copies must be n times"),
        ("slightly biased", "copies must be n times"),
        ("wrong dtype", "int64"),
    ],
)
def test_broken_resamplers_are_caught(defect, message):
    with pytest.raises(AssertionError, match=message):
        check_resampler(broken_resampler(defect))
    check_resampler(broken_resampler("none"))
    if defect == "greedy":
        with pytest.raises(AssertionError, match="equal weights"):
            check_resampler(resampling.multinomial)


class BrokenSpace(Euclidean):
    """A plane with one defect."""

    def __init__(self, defect):
        object.__setattr__(self, "size", 2)
        object.__setattr__(self, "defect", defect)

    def local(self, x, y):
        return x - y if self.defect == "sign" else super().local(x, y)

    def retract(self, x, v):
        if self.defect == "mixes rows" and x.dim() > 1:
            return x + v + 0 * x.sum()
        return x + v * (1.0001 if self.defect == "scale" else 1)

    def mean(self, points, weights):
        mean = super().mean(points, weights)
        return points.mean(-2) if self.defect == "unweighted" else mean

    def carry(self, v, columns):
        return columns + v.unsqueeze(-1) if self.defect == "curved" else columns

    def carry_back(self, v, columns):
        return columns + v.unsqueeze(-1) if self.defect == "one way" else columns

    def observed(self, y):
        return torch.ones_like(y, dtype=torch.bool) if self.defect == "sees all" else super().observed(y)


@pytest.mark.parametrize(
    ("defect", "message"),
    [
        ("sign", "local"),
        ("scale", "is v"),
        ("curved", "change of chart"),
        ("one way", "undoes carry"),
        ("mixes rows", "beside a row of NaN"),
        ("unweighted", "sum to zero"),
        ("sees all", "nothing is observed"),
    ],
)
def test_broken_spaces_are_caught(defect, message):
    with pytest.raises(AssertionError, match=message):
        check_space(BrokenSpace(defect), normal(4, 2))
    check_space(BrokenSpace("none"), normal(4, 2))


def test_checks_say_how_to_be_called():
    with pytest.raises(AssertionError, match="two rows or more, got"):
        check_law(Leaky("none"), X2[0])
    with pytest.raises(AssertionError, match="t >= 4"):
        check_filter(tf.KalmanFilter(LINEAR), torch.zeros(2, 2, dtype=DOUBLE))


EYE = torch.eye(2, dtype=DOUBLE)


@pytest.mark.parametrize(
    ("offer", "message"),
    [
        ({"noise_in": slice(0, 1)}, "noise_in must name every component that noise reaches"),
        ({"first_order": lambda x, u=None, dt=None: (tf.Gaussian(x + 1e-6, EYE), EYE)}, "the law of first_order"),
    ],
)
def test_broken_offers_of_a_law_are_caught(offer, message):
    law = tf.AdditiveGaussian(lambda x: 1.0 * x, EYE)
    x = normal(3, 2)
    check_law(law, x)
    for name, value in offer.items():
        setattr(law, name, value)
    with pytest.raises(AssertionError, match=message):
        check_law(law, x)
    law.noise_in = [1, 0]
    if "noise_in" in offer:
        check_law(law, x)
