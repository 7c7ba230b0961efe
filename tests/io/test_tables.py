"""Packed tables: what is read equals what NumPy reads, and each fault is named by row and rule."""

import gzip
import hashlib
import re

import numpy as np
import pytest
import torch

from torchfilt.io.files import LogError
from torchfilt.io.tables import read_table

HEADER = "t,a,b"
ROWS = ("0,1.5,-2e3", "0.1,0.25,7", "0.3, 1e-300,-0")


def store(tmp_path, text, name="one.csv.gz"):
    path = tmp_path / name
    path.write_bytes(gzip.compress(text.encode()))
    return path


def text_of(*lines, end="\n"):
    return "\n".join(lines) + end


def test_numbers_are_those_of_numpy(tmp_path):
    table = read_table(store(tmp_path, text_of(HEADER, *ROWS)), HEADER, None)
    expected = np.loadtxt(list(ROWS), delimiter=",")
    assert table.name == "one.csv.gz"
    assert table.time_s.tolist() == expected[:, 0].tolist()
    assert table.values.tolist() == expected[:, 1:].tolist()
    assert table.time_s.dtype == table.values.dtype == torch.float64
    assert table.time_s.is_contiguous()


def test_one_row_is_a_table(tmp_path):
    table = read_table(store(tmp_path, text_of(HEADER, ROWS[0])), HEADER, None)
    assert table.time_s.shape == (1,) and table.values.shape == (1, 2)


def test_a_label_is_checked_and_left_out(tmp_path):
    path = store(tmp_path, text_of("t,id,a", "0,X,1", "1,X,2"))
    table = read_table(path, "t,id,a", None, label="X")
    assert table.time_s.tolist() == [0, 1] and table.values.tolist() == [[1], [2]]
    with pytest.raises(LogError, match=r"one.csv.gz: row 1: second column is 'X', expected 'Y'"):
        read_table(path, "t,id,a", None, label="Y")
    with pytest.raises(LogError, match=r"row 2: second column is '', expected 'X'"):
        read_table(store(tmp_path, text_of("t,id,a", "0,X,1", "1")), "t,id,a", None, label="X")


def test_an_open_end_is_taken_where_it_is_allowed(tmp_path):
    path = store(tmp_path, text_of(HEADER, *ROWS, end=""))
    with pytest.raises(LogError, match=r"one.csv.gz: row 3: no line end; the file is cut short"):
        read_table(path, HEADER, None)
    assert len(read_table(path, HEADER, None, open_end=True).time_s) == 3
    whole = store(tmp_path, text_of(HEADER, *ROWS).replace("\n", "\r\n"))
    assert len(read_table(whole, HEADER, None, open_end=True).time_s) == 3


@pytest.mark.parametrize(
    ("lines", "words"),
    [
        (("t,b,a", ROWS[0]), "header is 't,b,a', with columns in another order or beside them; expected 't,a,b'"),
        (("t,a", ROWS[0]), "header is 't,a', without the columns b; expected 't,a,b'"),
        (("",), "header is '', without the columns t, a, b"),
        ((HEADER,), "no rows"),
        ((HEADER, ROWS[0], "", ROWS[1]), "row 2: 1 columns, expected 3"),
        ((HEADER, *ROWS, ""), "row 4: 1 columns, expected 3"),
        ((HEADER, ROWS[0], "1,2"), "row 2: 2 columns, expected 3"),
        ((HEADER, "1,2", "1,2"), "row 1: 2 columns, expected 3"),
        ((HEADER, ROWS[0], "1,2,3,4"), "row 2: 4 columns, expected 3"),
        ((HEADER, ROWS[0], "1,two,3"), "row 2: could not convert string to float: 'two'"),
        ((HEADER, ROWS[0], "# 1,2,3"), "row 2: could not convert"),
        ((HEADER, ROWS[0], "1,nan,3"), "row 2: .*finite"),
        ((HEADER, "inf,2,3"), "row 1: .*finite"),
    ],
)
def test_faults_are_named_by_row_and_rule(tmp_path, lines, words):
    with pytest.raises(LogError, match="one.csv.gz: " + words):
        read_table(store(tmp_path, text_of(*lines)), HEADER, None)


def test_digests_and_missing_files(tmp_path):
    path = store(tmp_path, text_of(HEADER, *ROWS))
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    assert len(read_table(path, HEADER, {path.name: digest}).time_s) == 3
    with pytest.raises(LogError, match=re.escape(f"one.csv.gz: SHA-256 is {digest}, the manifest says 00")):
        read_table(path, HEADER, {path.name: "00"})
    with pytest.raises(LogError, match="the manifest says nothing"):
        read_table(path, HEADER, {})
    with pytest.raises(FileNotFoundError):
        read_table(tmp_path / "absent.csv.gz", HEADER, None)
