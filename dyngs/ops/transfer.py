"""Copies between the CPU and a GPU for which the host does not wait while the GPU has work."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache

import torch
from torch import Tensor


def sent(x: Tensor, device: torch.device | str) -> Tensor:
    """Return ``x`` on ``device``; the copy of a tensor of the CPU is queued.

    The driver has taken a copy of pageable memory before the call returns, so that ``x`` may change at once.
    """
    return x.to(device, non_blocking=x.device.type == "cpu")


class ReadBack:
    """Numbers of a tensor, which a GPU copies to the CPU as soon as it has them, while more work is queued."""

    def __init__(self, x: Tensor) -> None:
        self._ready: torch.cuda.Event | None = None
        if x.device.type != "cuda":
            self._numbers = x.detach().to("cpu", copy=True)
            return
        self._numbers = torch.empty(x.shape, dtype=x.dtype, device="cpu", pin_memory=True)
        self._numbers.copy_(x.detach(), non_blocking=True)
        self._ready = torch.cuda.Event()
        self._ready.record(torch.cuda.current_stream(x.device))

    def numbers(self) -> Tensor:
        """Return them on the CPU; waits until the GPU has come to them, not for what was queued later."""
        if self._ready is not None:
            self._ready.synchronize()
        return self._numbers


class Upload:
    """Arrays of the CPU that are copied to a GPU beside its work: by a stream of their own, from pinned memory.

    May be made in any thread. What has no such streams gets them when they are asked for.
    """

    def __init__(self, arrays: Sequence[Tensor], device: torch.device) -> None:
        self._device, self._arrays = device, list(arrays)
        self._done: torch.cuda.Event | None = None
        if device.type != "cuda":
            return
        stream = _upload_stream(device)
        with torch.cuda.stream(stream):
            self._arrays = [x.pin_memory().to(device, non_blocking=True) for x in arrays]
            self._done = torch.cuda.Event()
            self._done.record(stream)

    def arrays(self) -> list[Tensor]:
        """Return them on the GPU; what is queued after this in the current stream finds them there."""
        if self._done is None:
            return [sent(x, self._device) for x in self._arrays]
        current = torch.cuda.current_stream(self._device)
        current.wait_event(self._done)
        for x in self._arrays:
            x.record_stream(current)  # not lent anew before that stream is done with it
        return self._arrays


@cache
def _upload_stream(device: torch.device) -> torch.cuda.Stream:
    return torch.cuda.Stream(device)
