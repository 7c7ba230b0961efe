"""Options: defaults that depend on each other, and combinations that are refused."""

import json

import pytest

from torchfilt.learning.settings import RunSettings, UsageError, different, resolve


def test_defaults_follow_the_data():
    orbital = resolve(RunSettings(), 21, 6, None)
    assert (orbital.nominal, orbital.target, orbital.kernel, orbital.psd) == (
        "two-body",
        "residual",
        "structured",
        1e-15,
    )
    assert (orbital.samples, orbital.dt, orbital.optimizer, orbital.epochs) == (500, 10.0, "lbfgs", 20)
    assert orbital.noise_floor == 1e-5
    file = resolve(RunSettings(source="a.npz", phase_column=0), 1, 2, 0.5)
    assert (file.nominal, file.target, file.kernel, file.psd) == ("none", "identity", "structured", None)
    assert (file.samples, file.dt) == (None, 0.5)
    plain = resolve(RunSettings(source="a.npz", phase=False), None, 3, None)
    assert (plain.kernel, plain.dt) == ("ard", 10.0)
    sparse = resolve(RunSettings(inducing=30), 21, 6, None)
    assert (sparse.kernel, sparse.optimizer, sparse.epochs, sparse.noise_floor) == ("ard", "adam", 300, 1e-4)
    assert resolve(RunSettings(nominal="cw"), 21, 6, None).psd == 1e-13
    free = resolve(RunSettings(target="next_state"), 21, 6, None)
    assert (free.nominal, free.target) == ("none", "next_state")


@pytest.mark.parametrize(
    ("options", "data", "message"),
    [
        ({"target": "next_state", "nominal": "cw"}, (21, 6), "--target next_state with --nominal cw"),
        ({"target": "residual", "nominal": "none"}, (21, 6), "a residual needs a nominal law"),
        ({"source": "a.npz", "nominal": "two-body"}, (3, 6), r"needs states x \(S, 6\).*6 and 3 columns"),
        ({"source": "a.npz", "nominal": "ltv"}, (None, 4), "4 and no columns"),
        ({"source": "a.npz", "nominal": "cw", "phase": False}, (3, 6), "or --mean-motion"),
        ({"mean_motion": 1e-3}, (21, 6), "belongs to --nominal cw, not two-body"),
        ({"psd": 1e-9, "nominal": "none"}, (21, 6), "--psd is the noise of a nominal law"),
        ({"source": "a.npz"}, (3, 2), "give --phase-column or --phase false"),
        ({"source": "a.npz", "phase_column": 3}, (3, 2), "column 3 of u is asked for, and u has 3"),
        ({"source": "a.npz", "phase": False, "control_columns": (-1,)}, (3, 2), "column -1 of u"),
        ({"kernel": "structured", "phase": False}, (21, 6), "structured takes the phase alone"),
        ({"kernel": "structured", "inducing": 5}, (21, 6), "structured takes the phase alone"),
        ({"kernel": "structured", "control_columns": (0,)}, (21, 6), "structured takes the phase alone"),
        ({"inducing": 5, "optimizer": "lbfgs"}, (21, 6), "need --optimizer adam"),
        ({"batch_size": 5}, (21, 6), "--batch-size is for the sparse GP"),
        ({"samples": 1}, (21, 6), "--samples must be at least 2, got 1"),
        ({"epochs": 0}, (21, 6), "--epochs must be at least 1"),
        ({"dt": -1.0}, (21, 6), "--dt must be positive and finite, got -1.0"),
        ({"dt": float("nan")}, (21, 6), "--dt must be positive and finite, got nan"),
        ({"noise_floor": 0.0}, (21, 6), "--noise-floor must be positive"),
        ({"psd": -1.0}, (21, 6), "--psd must be finite and not negative"),
        ({"held_out": 1.0}, (21, 6), "--held-out must lie between 0 and 1"),
        ({"held_out": 0.0}, (21, 6), "or be 0 with --test"),
        ({"seed": -1}, (21, 6), "--seed must be between"),
        ({"resume": True, "force": True}, (21, 6), "give one of them"),
        ({"test": "b.npz"}, (21, 6), "--test and --phase-column go with an NPZ file"),
        ({"source": "arcs", "samples": 55}, (21, 6), "a multiple of 10 for arcs, got 55"),
    ],
)
def test_refusals(options, data, message):
    with pytest.raises(UsageError, match=message):
        resolve(RunSettings(**options), *data, None)


def test_step_of_the_file_rules():
    assert resolve(RunSettings(source="a.npz", phase=False, dt=0.5), None, 2, 0.5).step == 0.5
    with pytest.raises(UsageError, match=r"--dt 10: the file's own step is 0\.5 s"):
        resolve(RunSettings(source="a.npz", phase=False, dt=10.0), None, 2, 0.5)
    with pytest.raises(ValueError, match="not resolved"):
        _ = RunSettings().step


def test_settings_survive_json():
    settings = resolve(RunSettings(inducing=30, control_columns=(0, 2)), 21, 6, None)
    stored = json.loads(json.dumps(settings.to_dict()))
    assert RunSettings(**{**stored, "control_columns": tuple(stored["control_columns"])}) == settings
    assert different(stored, settings.to_dict()) is None


def test_what_makes_another_run():
    first = RunSettings().to_dict()
    for name in ("out", "figures", "tensorboard", "epochs"):
        assert different(first, {**first, name: "other"}) is None
    assert different(first, {**first, "noise_floor": 0.1}) == "--noise-floor was None and is now 0.1"
    assert different({}, first) == "--source was None and is now cloud"
