"""The log of the hand-moved stereo camera: what its README promises, and refusal of every kind of damage."""

import io
import json
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.io import loadmat, savemat
from scipy.spatial.transform import Rotation

from torchfilt.io.files import LogError
from torchfilt.io.starry_night import FILE, read_starry_night

FOLDER = Path(__file__).parents[2] / "data" / "starry_night"
STORED = {name: value for name, value in loadmat(FOLDER / FILE).items() if not name.startswith("__")}
SEEN = (STORED["y_k_j"] != -1).all(0)


@pytest.fixture(scope="module")
def log():
    return read_starry_night(FOLDER, manifest=FOLDER / "manifest.json")


# What the README says


def test_sizes_units_and_order(log):
    rows = 1900
    assert log.times_s.shape == (rows,) and log.tangents.shape == (rows, 20, 4)
    assert log.rate_rad_s.shape == log.velocity_m_s.shape == log.position_m.shape == (rows, 3)
    assert log.quaternion.shape == (rows, 4) and log.beacons_m.shape == (20, 3)
    tensors = [value for value in (*log, *log.camera) if isinstance(value, torch.Tensor)]
    assert len(tensors) == 12 and all(value.dtype == torch.float64 for value in tensors)
    k = 1000
    assert log.times_s.tolist() == STORED["t"][0].tolist()
    assert log.rate_rad_s[k].tolist() == STORED["w_vk_vk_i"][:, k].tolist()
    assert log.velocity_m_s[k].tolist() == STORED["v_vk_vk_i"][:, k].tolist()
    assert log.position_m[k].tolist() == STORED["r_i_vk_i"][:, k].tolist()
    assert log.beacons_m[7].tolist() == STORED["rho_i_pj_i"][:, 7].tolist()
    # A rotation vector as it stands turns vehicle to inertial. A quaternion and its negative are one attitude.
    expected = Rotation.from_rotvec(STORED["theta_vk_i"].T)
    assert (Rotation.from_quat(log.quaternion.numpy()).inv() * expected).magnitude().max() < 1e-14


def test_times_are_uneven(log):
    step = log.times_s.diff()
    assert (log.times_s[-1] - log.times_s[0]).item() == pytest.approx(168.9, abs=0.05)
    assert step.min().item() == pytest.approx(0.046, abs=5e-4) and step.max().item() == pytest.approx(0.73, abs=5e-3)


def test_camera_and_variances(log):
    turn = Rotation.from_quat(log.camera.quaternion.numpy()).as_matrix()
    # Stored to rounding of its own: some 1e-9 off a rotation.
    np.testing.assert_allclose(turn, STORED["C_c_v"].T, atol=1e-6)
    assert log.camera.position_m.tolist() == STORED["rho_v_c_v"][:, 0].tolist()
    assert log.camera.baseline_m == STORED["b"].item() == pytest.approx(0.240, abs=5e-4)
    assert log.rate_variance.tolist() == STORED["w_var"][:, 0].tolist()
    assert log.velocity_variance.tolist() == STORED["v_var"][:, 0].tolist()
    focus = np.array([STORED[name].item() for name in ("fu", "fv", "fu", "fv")])
    np.testing.assert_allclose(log.tangent_variance, STORED["y_var"][:, 0] / focus**2, rtol=1e-14)
    np.testing.assert_allclose(log.rate_variance.sqrt(), [0.10, 0.13, 0.42], atol=5e-3)
    np.testing.assert_allclose(log.velocity_variance.sqrt(), [0.051, 0.046, 0.028], atol=5e-4)


def test_sightings(log):
    np.testing.assert_array_equal(~log.tangents.isnan().all(-1), SEEN)
    assert torch.equal(log.tangents.isnan().any(-1), log.tangents.isnan().all(-1))
    k, j = np.argwhere(SEEN)[4000]
    left_u, left_v, right_u, right_v = STORED["y_k_j"][:, k, j]
    fu, fv, cu, cv = (STORED[name].item() for name in ("fu", "fv", "cu", "cv"))
    expected = [(left_u - cu) / fu, (left_v - cv) / fv, (right_u - cu) / fu, (right_v - cv) / fv]
    np.testing.assert_allclose(log.tangents[k, j], expected, rtol=1e-13)
    count = SEEN.sum(1)
    assert (count == 0).mean() == pytest.approx(0.11, abs=5e-3) and (count >= 6).mean() == pytest.approx(0.38, abs=5e-3)
    empty = np.diff(np.flatnonzero(np.concatenate([[1], count, [1]])))
    assert empty.max() - 1 == 50
    assert (SEEN[:48].any(0)).sum() == 1
    assert log.beacons_m[:, 2].abs().max() < 0.0115


def test_reprojection_at_truth_has_the_stated_deviations():
    """By SciPy, of the values that are given: in pixels, about zero, and those that y_var states."""
    log = read_starry_night(FOLDER)
    world = Rotation.from_quat(log.quaternion.numpy())
    camera = Rotation.from_quat(log.camera.quaternion.numpy())
    left = np.stack(
        [
            camera.inv().apply(world.inv().apply(beacon - log.position_m.numpy()) - log.camera.position_m.numpy())
            for beacon in log.beacons_m.numpy()
        ],
        1,
    )
    right = left - [log.camera.baseline_m, 0, 0]
    assert left[SEEN][:, 2].min() > 0.25
    expected = np.concatenate([left[..., :2] / left[..., 2:], right[..., :2] / right[..., 2:]], -1)
    focus = np.array([STORED[name].item() for name in ("fu", "fv", "fu", "fv")])
    off = ((log.tangents.numpy() - expected) * focus)[SEEN]
    np.testing.assert_allclose(off.std(0), [6.16, 11.39, 6.48, 11.51], atol=0.01)
    np.testing.assert_allclose(off.std(0), np.sqrt(STORED["y_var"][:, 0]), rtol=1e-3)
    assert np.corrcoef(off[:, 1], off[:, 3])[0, 1] == pytest.approx(0.99, abs=6e-3)


def test_truth_moves_as_measured(log):
    """Rate paired with the motion into its row: the README's deviations."""
    world = Rotation.from_quat(log.quaternion.numpy())
    turn = (world[:-1].inv() * world[1:]).as_rotvec() / log.times_s.diff().numpy()[:, None]
    for shift, expected in ((1, [0.075, 0.118, 0.40]), (0, [0.10, 0.13, 0.42])):
        off = log.rate_rad_s.numpy()[shift : shift + 1899] - turn
        np.testing.assert_allclose(np.sqrt((off**2).mean(0)), expected, atol=0.015)


# Damage


PART = slice(1200, 1400)
_ROWS = ("t", "theta_vk_i", "r_i_vk_i", "w_vk_vk_i", "v_vk_vk_i")


def trial(**changes):
    """Two hundred rows, with changes; None leaves a variable out."""
    arrays = dict(STORED) | {name: STORED[name][:, PART] for name in (*_ROWS, "y_k_j")} | changes
    return {name: value for name, value in arrays.items() if value is not None}


def save(folder, content, compress=True):
    stream = io.BytesIO()
    savemat(stream, content, do_compression=compress)
    (Path(folder) / FILE).write_bytes(stream.getvalue())
    return folder


@pytest.mark.parametrize("compress", [True, False])
def test_a_part_is_read(tmp_path, log, compress):
    small = read_starry_night(save(tmp_path, trial(info="text", other=np.zeros(3)), compress))
    assert torch.equal(small.times_s, log.times_s[PART])
    assert torch.equal(small.quaternion, log.quaternion[PART])
    torch.testing.assert_close(small.tangents, log.tangents[PART], equal_nan=True, rtol=0, atol=0)


def edited(name, place, value):
    values = np.array(trial()[name], dtype=float)
    values[place] = value
    return {name: values}


K, J = np.argwhere(SEEN[PART])[300]
CHANGES = [
    ({"t": None}, "0 variables t"),
    ({"y_k_j": None}, "0 variables y_k_j"),
    ({"t": STORED["t"][:, PART].T}, r"t has shape \(200, 1\), expected \(1, 1\)"),
    ({"t": np.zeros((1, 2, 3))}, r"t has shape \(1, 2, 3\), expected \(1, 0\)"),
    ({"y_k_j": STORED["y_k_j"][:, :199]}, r"y_k_j has shape \(4, 199, 20\), expected \(4, 200, 20\)"),
    ({"theta_vk_i": STORED["theta_vk_i"][:2, PART]}, r"theta_vk_i has shape \(2, 200\), expected \(3, 200\)"),
    ({"r_i_vk_i": STORED["r_i_vk_i"][:, :10]}, r"r_i_vk_i has shape \(3, 10\), expected \(3, 200\)"),
    ({"w_vk_vk_i": STORED["w_vk_vk_i"][:, PART].T}, r"w_vk_vk_i has shape \(200, 3\)"),
    ({"rho_i_pj_i": np.zeros((3, 19))}, r"rho_i_pj_i has shape \(3, 19\), expected \(3, 20\)"),
    ({"y_var": np.ones((3, 1))}, r"y_var has shape \(3, 1\), expected \(4, 1\)"),
    ({"fu": np.ones((1, 2))}, r"fu has shape \(1, 2\), expected \(1, 1\)"),
    (edited("t", (0, 6), np.nan), "finite"),
    (edited("t", (0, 6), STORED["t"][0, 1205]), "row 7: time goes from .*; it must increase"),
    (edited("t", (0, 6), 0.0), "row 7: time goes from .*; it must increase"),
    (edited("theta_vk_i", (1, 6), np.nan), r"row 7: got .* of theta_vk_i; values must be finite"),
    (edited("r_i_vk_i", (1, 6), np.inf), r"row 7: got .* of r_i_vk_i; values must be finite"),
    (edited("w_vk_vk_i", (1, 6), np.nan), r"row 7: got .* of w_vk_vk_i; values must be finite"),
    (edited("v_vk_vk_i", (1, 6), np.nan), r"row 7: got .* of v_vk_vk_i; values must be finite"),
    (edited("rho_i_pj_i", (1, 6), np.nan), r"row 7: got .* of rho_i_pj_i; values must be finite"),
    (edited("y_k_j", (1, 6, 3), np.nan), r"row 7: got .* of y_k_j; values must be finite"),
    (edited("rho_v_c_v", (1, 0), np.nan), "rho_v_c_v; values must be finite"),
    (edited("w_vk_vk_i", (1, 6), 40.0), r"row 7: got .* rad/s of w_vk_vk_i, above 35.0; is it in degrees"),
    ({"r_i_vk_i": STORED["r_i_vk_i"][:, PART] * 1e3}, "row 1: got .* of r_i_vk_i, beyond 10.0 m; is it in mm"),
    ({"theta_vk_i": np.rad2deg(STORED["theta_vk_i"][:, PART])}, "rad in theta_vk_i, more than half a turn"),
    ({"theta_vk_i": -STORED["theta_vk_i"][:, PART]}, "differs from the motion of the truth by"),
    ({"v_vk_vk_i": -STORED["v_vk_vk_i"][:, PART]}, r"v_vk_vk_i differs .* more than 0.15 m/s"),
    ({"w_vk_vk_i": -STORED["w_vk_vk_i"][:, PART]}, r"w_vk_vk_i differs .* more than 0.5 rad/s"),
    (edited("y_k_j", (1, K, J), -1.0), f"row {K + 1}: got .* of y_k_j; a beacon is seen by both cameras or by none"),
    (edited("y_k_j", (1, K, J), 1500.0), f"row {K + 1}: got .* of y_k_j, beyond a tangent of 2.0"),
    ({"fu": np.array([[0.0]])}, "fu is 0.0; it must be finite, lengths positive"),
    ({"b": np.array([[-0.24]])}, "b is -0.24; it must be finite"),
    ({"cv": np.array([[np.nan]])}, "cv is nan; it must be finite"),
    (edited("y_var", (2, 0), 0.0), "got 0.0 of y_var; a variance must be positive and finite"),
    (edited("w_var", (0, 0), -1.0), "of w_var; a variance must be positive"),
    (edited("v_var", (0, 0), np.inf), "of v_var; a variance must be positive"),
    ({"C_c_v": 2 * STORED["C_c_v"]}, r"C_c_v is \[\[.*it must be a rotation"),
    ({"C_c_v": -STORED["C_c_v"]}, "C_c_v is .*it must be a rotation"),
    (edited("C_c_v", (0, 0), np.nan), "C_c_v is .*it must be a rotation"),
    ({"t": "text"}, "variable t of class 4, expected real numbers"),
    ({"t": {"a": 1.0}}, "variable t that is no plain array"),
    ({"y_k_j": trial()["y_k_j"] + 1j}, "variable y_k_j that is no plain array"),
]


@pytest.mark.parametrize(("change", "words"), CHANGES)
def test_damage_is_named(tmp_path, change, words):
    save(tmp_path, trial(**change))
    with pytest.raises(LogError, match=words) as caught:
        read_starry_night(tmp_path)
    assert FILE in str(caught.value)


def test_file_rules(tmp_path):
    with pytest.raises(FileNotFoundError):
        read_starry_night(tmp_path)
    whole = (FOLDER / FILE).read_bytes()
    for damaged in (whole[:-20], whole[:200], whole[:100], b"", b"MATLAB 7.3 MAT-file".ljust(4096)):
        (tmp_path / FILE).write_bytes(damaged)
        with pytest.raises(LogError, match="not a whole MATLAB 5 file"):
            read_starry_night(tmp_path)


def test_manifest_is_enforced(tmp_path):
    digests = json.loads((FOLDER / "manifest.json").read_text())
    with pytest.raises(LogError, match=r"SHA-256 is .* the manifest says 00"):
        read_starry_night(FOLDER, manifest={**digests, FILE: "00"})
    content = bytearray((FOLDER / FILE).read_bytes())
    content[200_000] ^= 1
    (tmp_path / FILE).write_bytes(content)
    with pytest.raises(LogError, match="SHA-256 is"):
        read_starry_night(tmp_path, manifest=digests)


@given(st.integers(0, 10**9), st.integers(1, 255), st.booleans())
def test_a_flipped_byte_is_refused_or_changes_a_value_only(tmp_path_factory, place, flip, compress):
    """Without a manifest: no other error, and a packed file is protected by its own checksum."""
    folder = save(tmp_path_factory.mktemp("flip"), trial(), compress)
    content = bytearray((folder / FILE).read_bytes())
    place %= len(content)
    content[place] ^= flip
    (folder / FILE).write_bytes(content)
    try:
        found = read_starry_night(folder)
    except LogError:
        return
    if compress:
        assert place < 124  # the title
    assert found.rate_rad_s.shape[1] == 3 and not found.position_m.isnan().any()


@given(st.integers(0, 10**9), st.booleans())
def test_a_cut_file_is_refused(tmp_path_factory, cut, compress):
    folder = save(tmp_path_factory.mktemp("cut"), trial(), compress)
    content = (folder / FILE).read_bytes()
    (folder / FILE).write_bytes(content[: cut % len(content)])
    with pytest.raises(LogError, match="not a whole MATLAB 5 file"):
        read_starry_night(folder)
