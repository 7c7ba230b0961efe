"""Training end to end: accuracy, honesty, resuming to the same bits, good manners."""

import json
import logging
import signal
import subprocess
import sys

import pytest
import torch
from learning_problem import pairs, phase

from torchfilt.gp import FrozenGP
from torchfilt.learning import GPModule, TransitionData, one_step_error, roll_out, roll_out_error, train_transition
from torchfilt.learning.checkpoint import load_checkpoint
from torchfilt.storage import IntegrityError

OPTIONS = {"dt": 1.0, "context": phase}


def test_learns_to_the_noise_and_is_honest(data):
    law, report = train_transition(*data, **OPTIONS)
    x, u, x_next = pairs(400, seed=1)
    error = one_step_error(law, x, u, x_next, 1.0)
    assert (error.rms < 2e-4).all()
    assert ((error.z > 0.7) & (error.z < 1.4)).all()
    torch.testing.assert_close(error.z, error.z_model)  # no floor without a nominal law
    assert report.samples == 60 and report.noise == pytest.approx([1e-4, 1e-4], rel=0.4)
    assert all(factor >= 1 for factor in report.inflation)
    states = roll_out(law, x[0], u[:5], 1.0)
    truth = [x[0]]
    for i in range(5):
        turned = torch.stack([-truth[-1][1], truth[-1][0]])
        truth.append(truth[-1] + 0.1 * turned * (1 + 0.5 * u[i].cos()))
    assert roll_out_error(law, torch.stack(truth), u[:5], 1.0, slice(0, 2)) < 2e-3
    assert states.shape == (6, 2)


def test_subset_for_hyperparameters_and_all_for_the_posterior(data):
    law, report = train_transition(*data, **OPTIONS, hyperparameter_samples=30, epochs=3)
    assert (report.hyperparameter_samples, report.samples) == (30, 60)
    assert law.gp.settings["samples"] == 60


def test_leaves_global_state_alone(data):
    state, dtype, threads = torch.random.get_rng_state(), torch.get_default_dtype(), torch.get_num_threads()
    levels = {name: logging.getLogger(name).level for name in ("pytorch_lightning", "lightning_fabric")}
    train_transition(*data, **OPTIONS, epochs=2)
    train_transition(*data, **OPTIONS, kernel="ard", inducing=10, batch_size=20, epochs=2)
    assert torch.equal(state, torch.random.get_rng_state())
    assert (dtype, threads) == (torch.get_default_dtype(), torch.get_num_threads())
    assert levels == {name: logging.getLogger(name).level for name in levels}


def run(folder, data, **options):
    law, report = train_transition(*data, **{**OPTIONS, "tolerance": 1e-9, **options}, run_dir=folder)
    return law, report


SPARSE = {"kernel": "ard", "inducing": 10, "batch_size": 16, "noise_floor": 1e-3}


@pytest.mark.parametrize("options", [{}, SPARSE], ids=["exact", "sparse"])
def test_resume_gives_the_same_bits(tmp_path, data, options):
    whole, _ = run(tmp_path / "whole", data, epochs=6, **options)
    run(tmp_path / "parts", data, epochs=2, **options)
    parts, report = run(tmp_path / "parts", data, epochs=6, resume=True, **options)
    assert report.epochs == 6
    for name, tensor in whole.gp.state_dict().items():
        assert torch.equal(tensor, parts.gp.state_dict()[name]), name


def test_same_seed_same_bits(data):
    first, second = (train_transition(*data, **OPTIONS, epochs=2, seed=3)[0] for _ in range(2))
    for a, b in zip(first.gp.state_dict().values(), second.gp.state_dict().values(), strict=True):
        assert torch.equal(a, b)


def test_finished_run_resumes_to_itself(tmp_path, data):
    first, before = train_transition(*data, **OPTIONS, run_dir=tmp_path)
    again, after = train_transition(*data, **OPTIONS, run_dir=tmp_path, resume=True)
    assert after.epochs == before.epochs < 20
    for a, b in zip(first.gp.state_dict().values(), again.gp.state_dict().values(), strict=True):
        assert torch.equal(a, b)


def test_run_folder_holds_data_log_and_frozen_gp(tmp_path, data):
    law, report = run(tmp_path, data, epochs=3)
    x, u, _ = data
    checkpoint = load_checkpoint(tmp_path / "last.ckpt")
    assert torch.equal(checkpoint["state_dict"]["regression.state"], x)
    module = GPModule.restore(tmp_path / "last.ckpt")
    assert module.regression.loss().item() == pytest.approx(report.loss, rel=1e-12)
    loaded = FrozenGP.load(tmp_path / "gp.npz")
    assert torch.equal(loaded(x, phase(u))[0], law.gp(x, phase(u))[0])
    assert (tmp_path / "log-1" / "metrics.csv").read_text().count("\n") == 4
    assert json.loads((tmp_path / "training.json").read_text())["epochs"] == 3


def test_sparse_module_is_restored(tmp_path, data):
    law, _ = run(tmp_path, data, epochs=2, **SPARSE)
    frozen = GPModule.restore(tmp_path / "last.ckpt").regression.freeze()
    assert torch.equal(frozen.posterior.alpha, law.gp.posterior.alpha)


def test_tensorboard_log(tmp_path, data):
    run(tmp_path, data, epochs=1, tensorboard=True)
    assert list((tmp_path / "tensorboard-1").glob("events*"))


def test_resume_refuses_other_data_and_broken_files(tmp_path, data):
    run(tmp_path, data, epochs=1)
    with pytest.raises(ValueError, match="state differs"):
        run(tmp_path, pairs(seed=9), epochs=2, resume=True)
    with pytest.raises(ValueError, match="resume needs run_dir"):
        train_transition(*data, **OPTIONS, resume=True)
    with pytest.raises(FileNotFoundError, match=r"last\.ckpt"):
        run(tmp_path / "empty", data, resume=True)
    path = tmp_path / "last.ckpt"
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(bytes(content))
    with pytest.raises(IntegrityError, match="truncated or altered"):
        run(tmp_path, data, epochs=2, resume=True)


def test_stop_saves_and_reports(tmp_path, data):
    calls = []
    _, report = run(tmp_path, data, stop=lambda: len(calls) == 2 or calls.append(1) is not None)
    assert report.interrupted and report.epochs == 3
    assert load_checkpoint(tmp_path / "last.ckpt")["epoch"] == 2
    assert not (tmp_path / "gp.npz").exists()
    whole, _ = run(tmp_path / "whole", data, epochs=5)
    resumed, _ = run(tmp_path, data, epochs=5, resume=True)
    assert torch.equal(whole.gp.posterior.weights, resumed.gp.posterior.weights)


def test_single_precision(data):
    law, _ = train_transition(*(t.float() for t in data), **OPTIONS, noise_floor=1e-3)
    assert law.gp.noise.dtype == torch.float32
    x, u, x_next = (t.float() for t in pairs(50, seed=1))
    assert (one_step_error(law, x, u, x_next, 1.0).rms < 3e-4).all()


def test_survives_a_covariance_that_is_not_definite(data):
    """Repeated samples under the smallest noise: line searches meet failed factorisations and step back."""
    x, u, x_next = (t.repeat(3, 1) for t in pairs(20, noise=0.0))
    law, report = train_transition(x, u, x_next, **OPTIONS, noise_floor=1e-7)
    assert torch.isfinite(law(x, u, 1.0).mean).all() and report.loss < 0


def test_data_module_splits_by_seed_and_refuses_bad_rows(data):
    x, u, x_next = data
    module = TransitionData(x, u, x_next, held_out=0.25, seed=1, batch_size=10)
    assert len(module.training()[0]) == 45 and len(module.held_out()[0]) == 15
    assert sorted([*module.training_rows.tolist(), *module.held_out_rows.tolist()]) == list(range(60))
    assert torch.equal(module.held_out_rows, TransitionData(x, u, x_next, held_out=0.25, seed=1).held_out_rows)
    batches = list(module.train_dataloader())
    assert [len(b) for b in batches] == [10, 10, 10, 10, 5]
    assert torch.cat(batches).sort().values.tolist() == list(range(45))
    broken = x.clone()
    broken[7, 1] = torch.nan
    with pytest.raises(ValueError, match="row 7"):
        TransitionData(broken, u, x_next)
    for arguments, message in [((x[:5], u, x_next), "both be"), ((x, u[:4], x_next), "S = 60")]:
        with pytest.raises(ValueError, match=message):
            TransitionData(*arguments)
    with pytest.raises(ValueError, match="held_out"):
        TransitionData(x, u, x_next, held_out=1.0)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"kernel": "structured", "inducing": 5}, "needs no inducing points"),
        ({"kernel": "ard", "inducing": 5, "optimizer": "lbfgs"}, "needs? optimizer='adam'"),
        ({"optimizer": "sgd"}, "optimizer must be"),
        ({"target": "residual"}, "needs a nominal law"),
    ],
)
def test_refusals(data, arguments, message):
    with pytest.raises(ValueError, match=message):
        train_transition(*data, **OPTIONS, **arguments)


def test_package_import_is_light():
    code = (
        "import sys, torchfilt.learning\n"
        "heavy = {'gpytorch', 'pytorch_lightning', 'scipy', 'matplotlib'} & set(sys.modules)\n"
        "assert not heavy, heavy"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_law_in_another_precision_counts_its_rounding(data):
    """A float32 law of states around 1000 errs by their rounding, far above what was learned; its noise says so."""
    x, u, x_next = data
    far = (x + 1000.0, u, x_next + 1000.0)
    exact, _ = train_transition(*far, **OPTIONS, nominal=None)
    law, _ = train_transition(*far, **OPTIONS, nominal=None, dtype=torch.float32)
    assert law.gp.noise.dtype == torch.float32
    test_x, test_u, _ = pairs(300, seed=1, noise=0.0)
    error = law((test_x + 1000.0).float(), test_u, 1.0).mean.double() - exact(test_x + 1000.0, test_u, 1.0).mean
    added = (law.gp.noise.double() - exact.gp.noise).sqrt()
    assert (added > 1e-5).all()  # 2^-24 of 1000, uniform, for the state and again for the step
    torch.testing.assert_close(added, error.square().mean(0).sqrt(), rtol=0.35, atol=0)
    again, _ = train_transition(*far, **OPTIONS, nominal=None, dtype=torch.float64)
    assert torch.equal(again.gp.noise, exact.gp.noise)


def test_groups_reach_the_calibration(data):
    x, u, x_next = (t.repeat_interleave(2, 0) for t in data)  # each sample twice: its twin tells all but the noise
    alone = train_transition(x, u, x_next, **OPTIONS, epochs=3)[1]
    together = train_transition(x, u, x_next, **OPTIONS, epochs=3, groups=torch.arange(60).repeat_interleave(2))[1]
    assert max(together.inflation) > max(alone.inflation)


def test_sigterm_ends_an_epoch_and_is_resumed(tmp_path, data):
    """Lightning answers SIGTERM by leaving the process; with ``stop`` given the fit ends in good order instead."""
    received = []
    before = signal.signal(signal.SIGTERM, lambda number, frame: received.append(number))
    calls = []

    def stop():
        calls.append(1)
        if len(calls) == 2:
            signal.raise_signal(signal.SIGTERM)
        return bool(received)

    try:
        _, report = run(tmp_path / "parts", data, epochs=5, stop=stop, **SPARSE)
    finally:
        signal.signal(signal.SIGTERM, before)
    assert received == [signal.SIGTERM] and report.interrupted
    whole, _ = run(tmp_path / "whole", data, epochs=5, **SPARSE)
    resumed, _ = run(tmp_path / "parts", data, epochs=5, resume=True, **SPARSE)
    assert torch.equal(whole.gp.posterior.alpha, resumed.gp.posterior.alpha)
