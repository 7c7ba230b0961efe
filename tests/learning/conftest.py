"""Fixtures of this folder."""

import pytest
from learning_problem import pairs


@pytest.fixture
def data():
    return pairs()
