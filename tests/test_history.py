"""Histories: what is recorded, saved, exported, and what is refused on the way back."""

import io
import json
import pickle
import zipfile

import numpy as np
import pytest
import torch
from filters.gaussian_problem import model, problem, tensor

import torchfilt as tf
from torchfilt import storage
from torchfilt.history import FILE_KIND, space_from_plain, space_to_plain

FILTERS = {
    "kalman": lambda laws: tf.KalmanFilter(laws),
    "unscented": lambda laws: tf.UnscentedKalmanFilter(laws),
    "bootstrap": lambda laws: tf.BootstrapFilter(laws, 20),
    "local": lambda laws: tf.UnscentedParticleFilter(laws, 20),
}


def run(name="kalman", record="moments", rows=2, pattern="shared", steps=6, state=None, seed=3):
    p = problem(30, d=3, m=2, steps=steps, rows=rows)
    if pattern == "shared":
        p.ys[2, :, 0] = np.nan
    if pattern == "rows":
        p.ys[2, 0, 0] = np.nan
    filter = FILTERS[name](model(p, "linear" if name == "kalman" else "functions"))
    ys, us, dts = tensor(p.ys), tensor(p.us), tensor(p.dts)
    return filter, ys, us, dts, filter(ys, us, dts, record=record, seed=seed)


def same(a, b):
    if not isinstance(a, torch.Tensor):
        return a == b
    return a.dtype == b.dtype and torch.equal(torch.nan_to_num(a), torch.nan_to_num(b))


def test_shapes_and_sums():
    _, _, _, _, history = run(pattern="rows")
    assert history.mean.shape == (6, 2, 3)
    assert history.covariance.shape == (6, 2, 3, 3)
    assert history.log_likelihood.shape == (2,)
    assert same(history.log_likelihood, history.diagnostics.log_likelihood.sum(0))
    assert history.diagnostics.ok.dtype == torch.bool
    assert history.diagnostics.ok.shape == history.diagnostics.nis.shape == (6, 2)
    assert history.evidence == "exact"
    assert history.final.step == 6
    assert history.final.seed == 3


@pytest.mark.parametrize("name", FILTERS)
def test_what_is_recorded(name):
    """Three depths; means, likelihood and the final state are the same in all."""
    histories = {record: run(name, record)[-1] for record in ("mean", "moments", "beliefs")}
    for history in histories.values():
        assert same(history.mean, histories["beliefs"].mean)
        assert same(history.log_likelihood, histories["beliefs"].log_likelihood)
        assert same(history.final.belief[1], histories["beliefs"].final.belief[1])
    with pytest.raises(ValueError, match="no covariance: the filter ran with record='mean'"):
        _ = histories["mean"].covariance
    assert histories["mean"].beliefs is None
    assert histories["mean"].diagnostics.innovation is None
    assert "covariance" not in histories["mean"].to_numpy()
    assert same(histories["moments"].covariance, histories["beliefs"].covariance)
    beliefs = histories["beliefs"].beliefs
    if name in ("kalman", "unscented"):
        torch.testing.assert_close(beliefs.mean, histories["beliefs"].mean, rtol=0, atol=0)
        assert same(beliefs.covariance, histories["beliefs"].covariance)
    else:
        assert histories["moments"].beliefs is None
        assert beliefs.x.shape == (6, 2, 20, 3)
        torch.testing.assert_close(beliefs.covariance, histories["beliefs"].covariance, rtol=0, atol=1e-13)
        assert histories["beliefs"].diagnostics.ancestors is not None
        assert histories["moments"].diagnostics.ancestors is None


def test_an_unknown_record_is_refused():
    with pytest.raises(ValueError, match="record must be 'mean', 'moments' or 'beliefs', got 'all'"):
        run(record="all")


@pytest.mark.parametrize("record", ["mean", "moments", "beliefs"])
@pytest.mark.parametrize("name", FILTERS)
def test_saved_and_loaded_it_is_the_same_and_goes_on_bit_for_bit(name, record, tmp_path):
    filter, ys, us, dts, history = run(name, record, pattern="rows")
    path = tmp_path / "deep" / "run.npz"
    history.save(path)
    found = tf.History.load(path)
    assert same(found.mean, history.mean)
    for field, one, two in zip(tf.StepInfo._fields, found.diagnostics, history.diagnostics, strict=True):
        assert same(one, two), field
    assert found.evidence == history.evidence
    assert found.space == history.space
    if record != "mean":
        assert same(found.covariance, history.covariance)
    if history.beliefs is None:
        assert found.beliefs is None
    else:
        assert type(found.beliefs) is type(history.beliefs)
        for one, two in zip(found.beliefs, history.beliefs, strict=True):
            assert same(one, two) if isinstance(two, torch.Tensor) else one == two
    assert found.final.step == 6
    assert found.final.seed == 3
    one, two = (filter(ys, us, dts, state=state) for state in (history.final, found.final))
    assert same(one.mean, two.mean)
    assert same(one.covariance, two.covariance)
    assert same(one.log_likelihood, two.log_likelihood)


def test_single_precision_and_one_series(tmp_path):
    p = problem(31, rows=1)
    filter = tf.UnscentedKalmanFilter(model(p, dtype=torch.float32))
    history = filter(tensor(p.ys[:, 0], torch.float32), tensor(p.us[:, 0], torch.float32), tensor(p.dts))
    assert history.log_likelihood.shape == ()
    history.save(tmp_path / "run.npz")
    found = tf.History.load(tmp_path / "run.npz")
    assert same(found.mean, history.mean)
    assert found.mean.dtype == torch.float32
    assert found.log_likelihood.shape == ()


def test_a_history_with_a_graph_is_saved_without_it(tmp_path):
    p = problem(32, rows=1)
    laws = model(p, "linear")
    for parameter in laws.buffers():
        parameter.requires_grad_()
    history = tf.KalmanFilter(laws)(tensor(p.ys), tensor(p.us), tensor(p.dts))
    assert history.mean.requires_grad
    history.save(tmp_path / "run.npz")
    assert not tf.History.load(tmp_path / "run.npz").mean.requires_grad
    assert all(isinstance(array, np.ndarray) for array in history.to_numpy().values())


SPACES = [
    tf.Euclidean(),
    tf.Euclidean(3),
    tf.Angle(2),
    tf.UnitQuaternion("left"),
    tf.Product(tf.Euclidean(2), tf.Product(tf.UnitQuaternion(), tf.Angle())),
]


@pytest.mark.parametrize("space", SPACES, ids=str)
def test_spaces_survive(space):
    assert space_from_plain(json.loads(json.dumps(space_to_plain(space)))) == space


def test_the_space_of_a_run_survives(tmp_path):
    space = tf.Product(tf.Angle(), tf.Euclidean(1))
    eye = torch.eye(2, dtype=torch.float64)
    laws = tf.StateSpaceModel(
        tf.Gaussian(tensor([3.0, 0.2]), 0.1 * eye, space),
        tf.AdditiveGaussian(lambda x: torch.stack([x[..., 0] + x[..., 1], x[..., 1]], -1), 0.01 * eye, space),
        tf.AdditiveGaussian(lambda x: x[..., :1], 0.1 * eye[:1, :1], tf.Angle()),
    )
    history = tf.UnscentedKalmanFilter(laws)(tensor([[3.1], [-3.0], [-2.8]]))
    history.save(tmp_path / "run.npz")
    found = tf.History.load(tmp_path / "run.npz")
    assert found.space == found.final.belief.space == found.beliefs.space == space
    one, two = (tf.UnscentedKalmanFilter(laws)(tensor([[-2.5]]), state=h.final) for h in (history, found))
    assert same(one.mean, two.mean)


def test_a_foreign_space_cannot_be_saved():
    class Mine(tf.Euclidean):
        pass

    with pytest.raises(TypeError, match=r"only the library's own spaces can be saved, got .*Mine"):
        space_to_plain(Mine())


# Refusals


@pytest.fixture
def saved(tmp_path):
    path = tmp_path / "run.npz"
    run()[-1].save(path)
    return path


def test_absent_file(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"nothing\.npz: no such file"):
        tf.History.load(tmp_path / "nothing.npz")


@pytest.mark.parametrize("place", [0, 100, 0.5, -1])
def test_a_flipped_bit_is_refused(saved, place):
    data = bytearray(saved.read_bytes())
    data[int(place * len(data)) if isinstance(place, float) else place] ^= 1
    saved.write_bytes(bytes(data))
    with pytest.raises(storage.IntegrityError, match=r"run\.npz: SHA-256 .* truncated or altered"):
        tf.History.load(saved)


@pytest.mark.parametrize("length", [0, 10, 0.5, -1])
def test_a_truncated_file_is_refused(saved, length):
    data = saved.read_bytes()
    saved.write_bytes(data[: int(length * len(data)) if isinstance(length, float) else length])
    with pytest.raises(storage.IntegrityError, match=r"run\.npz: .*truncated or altered"):
        tf.History.load(saved)


def test_an_absent_or_altered_manifest_is_refused(saved):
    manifest = storage.manifest_path(saved)
    text = manifest.read_text()
    manifest.write_text(text.replace("sha256", "sha257", 1))
    with pytest.raises(storage.IntegrityError, match="manifest"):
        tf.History.load(saved)
    manifest.unlink()
    with pytest.raises(storage.IntegrityError, match=r"manifest .* is missing"):
        tf.History.load(saved)


class Hostile:
    def __reduce__(self):
        return (pytest.fail, ("the pickle ran",))


def npz(**arrays):
    stream = io.BytesIO()
    np.savez(stream, **arrays)
    return stream.getvalue()


def edited(saved, compression=zipfile.ZIP_STORED, **changes):
    """The archive with some of its arrays replaced (None: left out)."""
    with np.load(saved) as archive:
        arrays = {name: archive[name] for name in archive.files} | changes
    arrays = {name: value for name, value in arrays.items() if value is not None}
    return npz(**arrays)


def head(saved, **changes):
    with np.load(saved) as archive:
        content = json.loads(archive["head"].tobytes()) | changes
    return np.frombuffer(json.dumps(content).encode(), dtype=np.uint8)


HOSTILE = {
    "pickle": lambda saved: pickle.dumps(Hostile()),
    "object array": lambda saved: npz(head=np.array([Hostile()], dtype=object)),
    "object mean": lambda saved: edited(saved, mean=np.array([Hostile()], dtype=object)),
    "not an archive": lambda saved: b"hello",
    "empty": lambda saved: b"",
    "start of a zip": lambda saved: b"PK\x03\x04" + bytes(100),
    "half a zip": lambda saved: saved.read_bytes()[: saved.stat().st_size // 2],
    "plain array": lambda saved: npy(),
    "no mean": lambda saved: edited(saved, mean=None),
    "no head": lambda saved: edited(saved, head=None),
    "no likelihood": lambda saved: edited(saved, **{"info.log_likelihood": None}),
    "no status": lambda saved: edited(saved, **{"info.ok": None}),
    "words": lambda saved: edited(saved, mean=np.array(["a", "b"])),
    "head is no JSON": lambda saved: edited(saved, head=np.zeros(4, dtype=np.uint8)),
    "head is a list": lambda saved: edited(saved, head=np.frombuffer(b"[1, 2]", dtype=np.uint8)),
    "unknown space": lambda saved: edited(saved, head=head(saved, space=["os.system", {}])),
    "space of nothing": lambda saved: edited(saved, head=head(saved, space=None)),
    "wrong space": lambda saved: edited(saved, head=head(saved, space=["Angle", {"sizes": 3}])),
    "nested spaces": lambda saved: edited(saved, head=head(saved, space=["Product", 3])),
    "unknown belief": lambda saved: edited(saved, head=head(saved, belief="ensemble")),
    "step is no number": lambda saved: edited(saved, head=head(saved, step="many")),
}  # fmt: skip


def npy():
    stream = io.BytesIO()
    np.save(stream, np.zeros(3))
    return stream.getvalue()


@pytest.mark.parametrize("name", HOSTILE)
def test_a_foreign_file_with_a_valid_manifest_is_refused(saved, name):
    """Someone who can write the manifest too gets an error that names the file; no code of the file runs."""
    storage.write_verified(saved, HOSTILE[name](saved), FILE_KIND)
    with pytest.raises(storage.IntegrityError, match=r"run\.npz: not a history of this version"):
        tf.History.load(saved)


def test_a_file_of_another_kind_is_refused(saved):
    storage.write_verified(saved, saved.read_bytes(), "another kind")
    with pytest.raises(storage.IntegrityError, match="holds a 'another kind', expected a 'torchfilt history'"):
        tf.History.load(saved)


# Export


@pytest.mark.parametrize("name", FILTERS)
def test_numpy(name):
    history = run(name)[-1]
    arrays = history.to_numpy()
    np.testing.assert_array_equal(arrays["mean"], history.mean.numpy())
    np.testing.assert_array_equal(arrays["covariance"], history.covariance.numpy())
    np.testing.assert_array_equal(arrays["log_likelihood"], history.diagnostics.log_likelihood.numpy())
    assert arrays["ok"].dtype == bool
    assert ("nis" in arrays) == (name in ("kalman", "unscented"))
    assert ("ess" in arrays) == (name in ("bootstrap", "local"))


@pytest.mark.parametrize("name", FILTERS)
@pytest.mark.parametrize("pattern", ["complete", "rows"])
def test_xarray(name, pattern):
    pytest.importorskip("xarray")
    history = run(name, "beliefs", pattern=pattern)[-1]
    data = history.to_xarray()
    assert data.sizes["time"] == 6
    assert data["mean"].dims == ("time", "batch_0", "state")
    assert data["covariance"].dims == ("time", "batch_0", "error", "error_2")
    assert data["log_likelihood"].dims == ("time", "batch_0")
    np.testing.assert_array_equal(data["mean"].isel(time=2, batch_0=1), history.mean[2, 1].numpy())
    assert data.attrs["evidence"] == history.evidence
    if name == "kalman":
        shared = ("time",) if pattern == "complete" else ("time", "batch_0")
        assert data["innovation_scale_tril"].dims == (*shared, "measurement", "measurement_2")
    if name == "bootstrap":
        assert data["ancestors"].dims == ("time", "batch_0", "particle")


@pytest.mark.parametrize("batch", [(), (2,), (2, 3)])
def test_xarray_of_what_gates_decide(batch):
    """One entry a sensor where sensors have names, none where they have not; starts over have no tail."""
    pytest.importorskip("xarray")
    eye = torch.eye(1, dtype=torch.float64)
    laws = {"near": tf.LinearGaussian(eye, eye), "far": tf.LinearGaussian(eye, 4 * eye)}
    prior, motion = tf.Gaussian(torch.zeros(1, dtype=torch.float64), eye), tf.LinearGaussian(eye, eye)
    named, plain = (tf.StateSpaceModel(prior, motion, law) for law in (tf.Sensors(laws), laws["near"]))
    ys = torch.zeros(4, *batch, 2, dtype=torch.float64)
    ys[2, ..., 0] = 1e3
    dims = ("time", *(f"batch_{k}" for k in range(len(batch))))
    history = tf.Reacquire(tf.GaussianFilter(named, tf.moments.taylor(), gate=0.99), "near", 0.1)(ys, dt=0.1)
    data = history.to_xarray()
    assert data["accepted"].dims == data["gate_nis"].dims == (*dims, "sensor")
    assert data["restarted"].dims == dims
    np.testing.assert_array_equal(data["accepted"].isel(sensor=0), history.diagnostics.accepted[..., 0].numpy())
    assert not data["accepted"].isel(time=2, sensor=0).any() and data["accepted"].isel(sensor=1).all()
    assert bool(data["restarted"].isel(time=2).all())
    single = tf.GaussianFilter(plain, tf.moments.taylor(), gate=0.99)(ys[..., :1]).to_xarray()
    assert single["accepted"].dims == dims and not single["accepted"].isel(time=2).any()
