"""The GRACE log: what its README promises, and refusal of every kind of damage."""

import gzip
import json
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles import relative_motion_oracle as oracle

from torchfilt.io import files
from torchfilt.io.files import LogError
from torchfilt.io.grace import FILES, read_grace, read_orbit, read_range
from torchfilt.models.relative_motion import (
    J2_EARTH,
    Field,
    TwoBody,
    chief_controls,
    chief_orbit,
    hill_states,
    to_curvilinear,
)

FOLDER = Path(__file__).parents[2] / "data" / "grace_2010"
MU = 3.986004415e14


@pytest.fixture(scope="module")
def log():
    return read_grace(FOLDER, manifest=FOLDER / "manifest.json")


@pytest.fixture(scope="module")
def formation(log):
    chief = chief_orbit(log.time_s, log.position_a_m, log.velocity_a_m_s, Field(MU, J2_EARTH))
    return chief, hill_states(chief, log.position_b_m, log.velocity_b_m_s)


# What the README says


def test_size_units_and_times(log):
    assert all(value.dtype == torch.float64 for value in log)
    assert log.time_s.shape == (8641,)
    assert log.position_a_m.shape == log.velocity_b_m_s.shape == (8641, 3)
    assert torch.equal(log.time_s, torch.arange(8641, dtype=torch.float64) * 10)
    energy = log.velocity_a_m_s.square().sum(-1) / 2 - MU / log.position_a_m.norm(dim=-1)
    axis = -MU / (2 * energy)
    assert axis.mean() == pytest.approx(6836.36e3, abs=50)
    assert axis.std() == pytest.approx(6.8e3, abs=100)


def test_separation_and_range(log):
    separation = (log.position_b_m - log.position_a_m).norm(dim=-1)
    assert separation.min() == pytest.approx(224.06e3, abs=10)
    assert separation.max() == pytest.approx(227.84e3, abs=10)
    assert log.range_m.isnan().tolist() == [False] * 8640 + [True]
    difference = (log.range_m - separation)[:-1]
    assert difference.mean() == pytest.approx(-0.012, abs=1e-3)
    assert difference.std() == pytest.approx(0.010, abs=1e-3)


def test_hill_coordinates(formation):
    chief, x = formation
    low, high = x[:, :3].amin(0), x[:, :3].amax(0)
    assert low.tolist() == pytest.approx([-4651, 224.0e3, -2290], abs=50)
    assert high.tolist() == pytest.approx([-2728, 227.8e3, 2290], abs=50)
    assert x[:, 3:].abs().max() == pytest.approx(2.5, abs=0.1)
    radius = chief.position_m.norm(dim=-1)
    rate = (chief.position_m * chief.velocity_m_s).sum(-1) / radius
    bent = to_curvilinear(x, radius, rate)
    assert bent[:, 0].mean().abs() < 100  # the radial offset of 3.7 km was curvature
    assert bent[:, 0].abs().max() < 1100


def test_relative_velocity_is_the_derivative_of_relative_position(log):
    """4e-5 m/s rms an axis, as the README says, inertial axes; fourth-order differences of 10 s."""
    p, v = log.position_b_m - log.position_a_m, log.velocity_b_m_s - log.velocity_a_m_s
    slope = (p[:-4] - p[4:] + 8 * (p[3:-1] - p[1:-3])) / 120
    assert (slope - v[2:-2]).square().mean(0).sqrt().max() < 6e-5


def test_earth_fixed_axes_on_request(log):
    fixed = read_grace(FOLDER, inertial=False)
    assert torch.equal(fixed.position_a_m[0], log.position_a_m[0])
    assert fixed.position_a_m[0, 0] == pytest.approx(2046250.381, abs=1e-6)
    assert fixed.velocity_a_m_s[0, 0] == pytest.approx(-7239.398858, abs=1e-9)
    torch.testing.assert_close(fixed.position_b_m.norm(dim=-1), log.position_b_m.norm(dim=-1), rtol=1e-14, atol=0)


@pytest.mark.parametrize(
    ("j2", "minutes", "expected"), [(J2_EARTH, 15, 4.0), (J2_EARTH, 94, 36.0), (0.0, 15, 540.0), (0.0, 94, 5600.0)]
)
@pytest.mark.slow
def test_pairs_of_absolute_orbits_predict_as_the_readme_says(log, j2, minutes, expected):
    """Median over 8 starts of a quantity that varies by a factor of two between starts."""
    steps = minutes * 6
    starts = torch.linspace(0, 8640 - 6 * 188, 8).long()
    errors = []
    for k in starts:
        ends = [
            oracle.two_body(torch.cat([p[k], v[k]]).numpy(), 10.0 * steps, MU, j2)[:3]
            for p, v in ((log.position_a_m, log.velocity_a_m_s), (log.position_b_m, log.velocity_b_m_s))
        ]
        true = (log.position_b_m - log.position_a_m)[k + steps].numpy()
        errors.append(np.linalg.norm(ends[1] - ends[0] - true))
    assert expected / 1.6 < np.median(errors) < 1.6 * expected


@pytest.mark.parametrize(("j2", "expected"), [(J2_EARTH, 4.0), (None, 540.0)])
def test_laws_about_the_known_chief_predict_as_well_as_pairs(formation, j2, expected):
    """15 minutes in 90 steps, from every hour; the README's medians for pairs of integrations, within a quarter."""
    chief, x = formation
    law, u = TwoBody(0.0, MU, j2=j2), chief_controls(chief)
    starts = torch.arange(0, 8550, 90)
    state = x[starts]
    for k in range(90):
        state = law(state, u[starts + k], 10.0).mean
    error = (state - x[starts + 90])[:, :3].norm(dim=-1)
    assert error.median() == pytest.approx(expected, rel=0.25)


# Damage


def packed(path, name="orbit.csv.gz"):
    """A small whole file to damage: ten rows of the log."""
    lines = gzip.decompress((FOLDER / path).read_bytes()).decode().splitlines()[:10]
    return name, lines


def store(folder, name, lines, end="\n"):
    file = Path(folder) / name
    file.write_bytes(gzip.compress(("\n".join(lines) + end).encode()))
    return file


ORBIT = packed(FILES[0])[1]
RANGE = packed(FILES[2])[1]


def changed(row, column, value, rows=ORBIT):
    fields = rows[row].split(",")
    fields[column] = value
    return [*rows[:row], ",".join(fields), *rows[row + 1 :]]


def test_ten_rows_are_read(tmp_path):
    orbit = read_orbit(store(tmp_path, "a.csv.gz", ORBIT))
    assert orbit.position_m.shape == (10, 3)
    time, distance = read_range(store(tmp_path, "r.csv.gz", RANGE))
    assert time[1] == 10
    assert distance[0] == 227379.1269


@pytest.mark.parametrize(
    ("lines", "words"),
    [
        (changed(3, 2, "nan"), "row 4: values must be finite"),
        (changed(3, 6, "inf"), "row 4: values must be finite"),
        (changed(3, 4, "12x"), "row 4: could not convert"),
        (changed(2, 0, "2010-07-27"), "row 3: date must be d/m/yyyy"),
        (changed(2, 0, "31/6/2010"), "row 3: day"),
        (changed(2, 1, "00:61:00"), "row 3: time must be hh:mm:ss"),
        (changed(2, 1, "00:00:5"), "row 3: time must be hh:mm:ss"),
        ([*ORBIT[:4], ORBIT[4] + ",1", *ORBIT[5:]], "row 5: 9 columns, expected 8"),
        ([*ORBIT[:4], ORBIT[4][:40], *ORBIT[5:]], "row 5: 4 columns, expected 8"),
        ([*ORBIT[:4], "", *ORBIT[5:]], "row 5: 1 columns"),
        ([*ORBIT[:4], ORBIT[5], ORBIT[4], *ORBIT[6:]], "row 6: time goes from"),
        ([*ORBIT[:4], *ORBIT[3:]], "row 5: time goes from"),
        ([*ORBIT[:4], *ORBIT[5:]], "row 5: step of 20.0 s"),
        (ORBIT[:4], "at least 5"),
        (changed(5, 7, "2309.389481"), "m/s"),
        ([",".join([*r.split(",")[:5], *(str(float(v) / 10) for v in r.split(",")[5:])]) for r in ORBIT], "dm/s"),
        ([",".join([*r.split(",")[:2], *(str(float(v) / 1e3) for v in r.split(",")[2:])]) for r in ORBIT], "km"),
    ],
)
def test_damage_is_named_by_file_row_and_rule(tmp_path, lines, words):
    with pytest.raises(LogError, match=words) as caught:
        read_orbit(store(tmp_path, "a.csv.gz", lines))
    assert "a.csv.gz" in str(caught.value)


def test_a_wrong_velocity_is_named_where_it_is(tmp_path):
    """One wrong number: its own row is the first that differs, at the ends too."""
    for row in (0, 1, 5, 8, 9):
        velocity = float(ORBIT[row].split(",")[6]) + 5.0  # 0.5 m/s
        with pytest.raises(LogError, match=f"row {row + 1}: velocity differs"):
            read_orbit(store(tmp_path, "a.csv.gz", changed(row, 6, str(velocity))))


def test_range_rules(tmp_path):
    with pytest.raises(LogError, match="row 3: range must be positive"):
        read_range(store(tmp_path, "r.csv.gz", changed(2, 2, "-5.0", RANGE)))


def test_file_rules(tmp_path, monkeypatch):
    whole = store(tmp_path, "a.csv.gz", ORBIT)
    packed_bytes = whole.read_bytes()
    cut = tmp_path / "cut.csv.gz"
    cut.write_bytes(packed_bytes[:-20])
    with pytest.raises(LogError, match="not a whole gzip file"):
        read_orbit(cut)
    cut.write_bytes(b"plain,text\n")
    with pytest.raises(LogError, match="not a whole gzip file"):
        read_orbit(cut)
    with pytest.raises(LogError, match="cut short"):
        read_orbit(store(tmp_path, "open.csv.gz", ORBIT, end=""))
    cut.write_bytes(gzip.compress(b"\xff\xfe\n" * 6))
    with pytest.raises(LogError, match="not plain text"):
        read_orbit(cut)
    with pytest.raises(FileNotFoundError):
        read_orbit(tmp_path / "absent.csv.gz")
    monkeypatch.setattr(files, "MAX_BYTES", 100)
    with pytest.raises(LogError, match="when unpacked"):
        read_orbit(whole)
    monkeypatch.setattr(files, "MAX_PACKED_BYTES", 100)
    with pytest.raises(LogError, match="more than the limit of 100"):
        read_orbit(whole)


def test_manifest_is_enforced(tmp_path):
    good = json.loads((FOLDER / "manifest.json").read_text())
    with pytest.raises(LogError, match=r"grcb_truth.csv.gz: SHA-256 is .* the manifest says 00"):
        read_grace(FOLDER, manifest={**good, FILES[1]: "00"})
    with pytest.raises(LogError, match="the manifest says nothing"):
        read_grace(FOLDER, manifest={})
    bad = tmp_path / "manifest.json"
    bad.write_text("[1")
    with pytest.raises(LogError, match="not a JSON manifest"):
        read_grace(FOLDER, manifest=bad)
    bad.write_text("[1]")
    with pytest.raises(LogError, match="maps file names"):
        read_grace(FOLDER, manifest=bad)


def test_files_must_agree(tmp_path):
    def folder(a=ORBIT, b=ORBIT, r=RANGE):
        for name, lines in zip(FILES, (a, b, r), strict=True):
            store(tmp_path, name, lines)
        return tmp_path

    other = packed(FILES[1])[1]
    assert read_grace(folder(b=other)).range_m.shape == (10,)
    with pytest.raises(LogError, match="range differs from the orbits' separation"):
        read_grace(folder())
    with pytest.raises(LogError, match="epochs differ"):
        read_grace(folder(b=other[:9]))
    with pytest.raises(LogError, match="no orbit has an epoch"):
        read_grace(folder(b=other, r=changed(3, 1, "00:00:31", RANGE)))
    sparse = read_grace(folder(b=other, r=[*RANGE[:3], *RANGE[5:]])).range_m
    assert sparse.isnan().tolist() == [False] * 3 + [True] * 2 + [False] * 5


@given(st.integers(1, 10**6), st.data())
@settings(max_examples=40, deadline=None)
def test_a_cut_text_is_refused_or_whole_rows(tmp_path_factory, cut, data):
    """Any prefix of the text either ends at a row's end, and is read as these rows, or is refused."""
    text = "\n".join(ORBIT) + "\n"
    piece = text[: cut % len(text)]
    file = tmp_path_factory.mktemp("cut") / "a.csv.gz"
    file.write_bytes(gzip.compress(piece.encode()))
    rows = piece.count("\n")
    if piece.endswith("\n") and rows >= 5:
        assert len(read_orbit(file).time_s) == rows
    else:
        with pytest.raises(LogError):
            read_orbit(file)


@given(st.integers(0, 9), st.integers(0, 9), st.integers(2, 7), st.sampled_from(["nan", "", "-inf", "1e999", "0", "x"]))
@settings(max_examples=60, deadline=None)
def test_swapped_rows_and_bad_fields_are_refused(tmp_path_factory, i, j, column, value):
    folder = tmp_path_factory.mktemp("bad")
    if i != j:
        lines = list(ORBIT)
        lines[i], lines[j] = lines[j], lines[i]
        with pytest.raises(LogError, match=r"row \d+"):
            read_orbit(store(folder, "a.csv.gz", lines))
    with pytest.raises(LogError, match=r"a.csv.gz: row \d+"):
        read_orbit(store(folder, "a.csv.gz", changed(i, column, value)))


@given(st.binary(max_size=400))
@settings(max_examples=40, deadline=None)
def test_noise_is_refused(tmp_path_factory, noise):
    file = tmp_path_factory.mktemp("noise") / "a.csv.gz"
    for content in (noise, gzip.compress(noise)):
        file.write_bytes(content)
        with pytest.raises(LogError):
            read_orbit(file)
