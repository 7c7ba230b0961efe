"""What all tests share: examples that repeat, and a watch on the state that belongs to the user."""

from collections.abc import Iterator

import pytest
import torch
from hypothesis import settings

# The same examples on each run and machine; the first example of a compiled function takes seconds.
settings.register_profile("repeatable", derandomize=True, deadline=None, max_examples=40, database=None)
settings.load_profile("repeatable")


@pytest.fixture(autouse=True)
def global_state_is_left_alone() -> Iterator[None]:
    """The library has no right to change the default dtype, the thread count or the gradient mode."""

    def state() -> tuple[torch.dtype, int, bool]:
        return torch.get_default_dtype(), torch.get_num_threads(), torch.is_grad_enabled()

    before = state()
    yield
    assert state() == before
