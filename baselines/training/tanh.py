"""The hyperbolic tangent of `baselines.policies.tanh` as a function of torch, with its gradient."""

from __future__ import annotations

from typing import Any

import torch

from quad_envs.compilation.decorators import entry_of

from ..policies.tanh import tanh_in_place

_tanh_in_place = entry_of(tanh_in_place)


class _TanhInPlace(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, x: torch.Tensor) -> torch.Tensor:
        _tanh_in_place(x.detach().view(-1).numpy())
        ctx.mark_dirty(x)
        ctx.save_for_backward(x)
        return x

    @staticmethod
    def backward(ctx: Any, *bars: torch.Tensor) -> torch.Tensor:
        (y,) = ctx.saved_tensors
        return torch.ops.aten.tanh_backward(bars[0], y)  # type: ignore[no-any-return]


def fast_tanh_(x: torch.Tensor) -> torch.Tensor:
    """Tanh of a contiguous float32 tensor on the CPU, in its place: of what a linear layer has just given.

    Raises:
        RuntimeError: If the tensor is a leaf that wants a gradient, as torch's own functions in place.
    """
    return _TanhInPlace.apply(x)  # type: ignore[no-any-return, no-untyped-call]
