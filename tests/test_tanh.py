"""The compiled hyperbolic tangent of networks in training."""

import pytest

pytest.importorskip("stable_baselines3")
import torch

from baselines.training.learner import Tanh


def test_the_compiled_tanh_has_the_values_and_gradients_of_torch():
    x, y = (torch.linspace(-12.0, 12.0, 1001, requires_grad=True) for _ in range(2))
    weights = torch.linspace(-1.0, 2.0, 1001)
    ours = Tanh()(x + 0.0)  # in place of what the sum gives
    (ours * weights).sum().backward()
    (torch.tanh(y) * weights).sum().backward()
    # The rational function errs by 4e-7 at most, its slope 1 - y^2 by twice that.
    torch.testing.assert_close(ours, torch.tanh(y), rtol=0.0, atol=4e-7)
    torch.testing.assert_close(x.grad, y.grad, rtol=0.0, atol=2e-6)
    assert ours.abs().max() == 1.0


def test_the_compiled_tanh_keeps_what_is_not_finite_and_refuses_a_leaf():
    odd = torch.tensor([float("nan"), float("inf"), float("-inf")])
    torch.testing.assert_close(Tanh()(odd), torch.tensor([float("nan"), 1.0, -1.0]), equal_nan=True)
    with pytest.raises(RuntimeError, match="leaf Variable that requires grad"):
        Tanh()(torch.zeros(3, requires_grad=True))
