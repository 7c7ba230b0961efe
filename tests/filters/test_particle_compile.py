"""`torch.compile(filter.advance, fullgraph=True)`: one graph, the eager numbers."""

import numpy as np
import pytest
import torch
from particle_problem import PLANE, series, state_space

import torchfilt as tf
from torchfilt.resampling import ess_below, systematic

JOINT = dict(redraw="always", split=0.0, pooled=False, weights="joint")
FILTERS = {
    "bootstrap": lambda model: tf.BootstrapFilter(model, 64, systematic),
    "bootstrap-adaptive": lambda model: tf.BootstrapFilter(model, 64, ess_below(0.5)),
    "unscented-joint": lambda model: tf.UnscentedParticleFilter(model, 32, **JOINT),
    "unscented-pooled": lambda model: tf.UnscentedParticleFilter(model, 32),
    "bank": lambda model: tf.LocallyLinearizedParticleFilter(model, 32, redraw="resample"),
}


# The compiler itself uses a name that its own package deprecates.
@pytest.mark.slow
@pytest.mark.parametrize("name", FILTERS)
def test_compiled_step_equals_eager(name):
    """Tolerance: the compiler may add in another order, 4 steps of rounding; ancestors would show any larger error."""
    torch._dynamo.reset()
    ys, _ = series(4)
    filter = FILTERS[name](state_space(PLANE))
    compiled = torch.compile(filter.advance, fullgraph=True)
    state = filter.init((2,), 1)
    eager = fast = state.belief
    for k, y in enumerate(ys.unsqueeze(1).expand(-1, 2, -1)):
        noise = filter.draw(eager, k, 1)
        eager, info = filter.advance(eager, y, None, None, noise, "none")
        fast, fast_info = compiled(fast, y, None, None, noise, "none")
        np.testing.assert_allclose(fast.x, eager.x, rtol=0, atol=1e-11)
        np.testing.assert_allclose(fast.log_weights, eager.log_weights, rtol=0, atol=1e-10)
        np.testing.assert_allclose(fast_info.log_likelihood, info.log_likelihood, rtol=0, atol=1e-11)
        assert torch.equal(fast_info.ancestors, info.ancestors) and fast_info.ok.all()
