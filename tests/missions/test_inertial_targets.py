"""What the SINS/SAR study must reach, 8 runs of 1000 s each: honest Kalman filters, particles beside them, what fails.

Everything here takes minutes. Numbers are after the start has settled; ratios are to the Kalman filter on the same
data.
"""

from functools import cache

import pytest

from torchfilt.missions.inertial import InertialSettings, make_scene, run_filter, summarize

pytestmark = [pytest.mark.slow, pytest.mark.timeout(1800)]


@cache
def scene(settings):
    return make_scene(settings)


@cache
def numbers(name, **change):
    settings = InertialSettings(**change)
    measured = 3 if settings.scenario == "heading-unknown" else 4
    flown = InertialSettings(scenario=settings.scenario, seed=settings.seed)
    return summarize(run_filter(name, scene(flown), settings), measured)


@pytest.mark.parametrize("name", ["es-kf", "ckf"])
def test_kalman_filters_are_effectively_optimal(name):
    """Published for this flight's kind: 2.9 m, 0.055 m/s, 0.26', 0.46', NIS 4 of 4, NEES 15 of 15."""
    found = numbers(name)
    assert found["position_m"] == pytest.approx(2.9, abs=0.4)
    assert found["velocity_m_s"] == pytest.approx(0.055, abs=0.008)
    assert found["tilt_arcmin"] == pytest.approx(0.26, abs=0.04)
    assert found["heading_arcmin"] == pytest.approx(0.46, abs=0.08)
    assert found["nis"] * 4 == pytest.approx(4.0, abs=0.2)
    assert 13 < found["nees"] * 15 < 17


@pytest.mark.parametrize("name", ["rpf", "mpf"])
@pytest.mark.parametrize("seed", [0, 100])
def test_shrinkage_comes_close(name, seed):
    """2000 particles: within 1.2 times the Kalman filter's error; the aim of 1.1 is met as well."""
    found, best = numbers(name, seed=seed), numbers("es-kf", seed=seed)
    assert found["position_m"] < 1.1 * best["position_m"]
    assert found["nees_end"] < 2 and found["failed"] == 0


@pytest.mark.parametrize("name", ["rpf", "mpf"])
def test_many_particles_are_as_good(name):
    assert numbers(name, particles=10_000)["position_m"] < 1.03 * numbers("es-kf")["position_m"]


@pytest.mark.parametrize("name", ["rbpf", "rbpf-shared"])
def test_rao_blackwell_comes_close(name):
    """In metres; with an attitude that is drawn and 1000 particles, what it claims is far too little."""
    assert numbers(name)["position_m"] < 1.1 * numbers("es-kf")["position_m"]


def test_the_reversible_kernel_is_accepted():
    """Five measurements at once refuse more than one."""
    assert numbers("mpf")["acceptance"] > 0.9
    assert numbers("mpf-window")["acceptance"] > 0.75
    assert numbers("mpf-window")["position_m"] < 1.2 * numbers("es-kf")["position_m"]


def test_the_printed_filter_is_a_plain_one():
    """Noise of rank 6 in 15 dimensions: no move is ever accepted, all descend from one particle, and it is lost."""
    for name in ("sir", "mpf-literal"):
        found = numbers(name)
        assert found["roots"] == 1 and found["position_m"] > 100
    assert numbers("mpf-literal")["acceptance"] == 0


def test_the_plain_kernel_diverges():
    found, best = numbers("rpf-plain"), numbers("es-kf")
    assert found["tilt_arcmin"] > 20 * best["tilt_arcmin"]


def test_unknown_heading_is_where_particles_help():
    """5000 particles: 4 m at most, where the single Kalman filter loses some runs; a bank of 36 does as well.

    In every run for the moved particles and the bank, over all runs for the regularised ones: the worst run is hard.
    """
    change = dict(scenario="heading-unknown", particles=5000)
    for name in ("rpf", "mpf", "bank-36"):
        found = numbers(name, **change)
        assert found["worst_position_m" if name != "rpf" else "position_m"] <= 4.0 and found["nees_end"] < 2, name
    single = numbers("es-kf", **change)
    assert single["worst_position_m"] > 20 and single["nees"] > 20


def test_outliers():
    """A law that knows of them, or a gate: at most 3.5 m; a Kalman filter that knows nothing is three times as far."""
    for name in ("rpf", "mpf", "es-kf-gated"):
        assert numbers(name, scenario="outliers")["position_m"] < 3.5, name
    assert numbers("es-kf", scenario="outliers")["position_m"] > 8


def test_cheap_sensors():
    """MEMS: linearising once is overconfident; particles are weaker than the Kalman filter here."""
    best, once = numbers("es-kf", scenario="mems"), numbers("es-kf-open", scenario="mems")
    assert 0.8 < best["nees"] < 1.3 and once["nees"] > 2 * best["nees"]
    assert numbers("rpf", scenario="mems")["position_m"] < 1.5 * best["position_m"]
