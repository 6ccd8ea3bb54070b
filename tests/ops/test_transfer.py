"""Copies that nobody waits for: values, and on a GPU (made up here) the order of what is queued."""

from __future__ import annotations

from contextlib import contextmanager

import pytest
import torch
from torch import Tensor

from dyngs.ops.transfer import ReadBack, Upload, sent


def test_numbers_are_as_they_were_when_they_were_asked_for() -> None:
    x = torch.tensor([1.0, 2.5], requires_grad=True)
    read = ReadBack(x)
    with torch.no_grad():
        x.zero_()
    assert read.numbers().tolist() == [1.0, 2.5]


def test_arrays_come_as_they_are() -> None:
    arrays = [torch.arange(6).view(2, 3), torch.zeros(0, dtype=torch.uint8)]
    for found, expected in zip(Upload(arrays, torch.device("cpu")).arrays(), arrays, strict=True):
        assert torch.equal(found, expected)
    there = Upload(arrays, torch.device("meta")).arrays()
    assert [x.device.type for x in there] == ["meta"] * 2
    assert sent(arrays[0], "meta").device.type == "meta"


class MadeUpGpu:
    """What torch.cuda has of streams and events, for tensors whose device is said to be a GPU; notes all calls."""

    def __init__(self) -> None:
        self.calls: list[str] = []

    def on(self, patch: pytest.MonkeyPatch) -> None:
        gpu = self

        class Event:
            def record(self, stream: str) -> None:
                gpu.calls.append(f"event recorded in {stream}")

            def synchronize(self) -> None:
                gpu.calls.append("host waits for the event")

        class Stream(str):
            def wait_event(self, _: Event) -> None:
                gpu.calls.append(f"{self} waits for the event")

        @contextmanager
        def stream(queue: str):
            gpu.calls.append(f"begin {queue}")
            yield
            gpu.calls.append(f"end {queue}")

        patch.setattr(torch.cuda, "Event", Event)
        patch.setattr(torch.cuda, "stream", stream)
        patch.setattr(torch.cuda, "current_stream", lambda _: Stream("current"))
        patch.setattr("dyngs.ops.transfer._upload_stream", lambda _: Stream("uploads"))
        patch.setattr(Tensor, "pin_memory", lambda x: gpu.calls.append("pinned") or x)
        patch.setattr(Tensor, "record_stream", lambda _, s: gpu.calls.append(f"used in {s}"))
        to = Tensor.to

        def copied(x: Tensor, device: torch.device, non_blocking: bool = False) -> Tensor:
            gpu.calls.append("copied, queued" if non_blocking else "copied")
            return to(x, "cpu")

        patch.setattr(Tensor, "to", copied)


def test_a_image_is_copied_beside_the_work_of_the_gpu(monkeypatch: pytest.MonkeyPatch) -> None:
    gpu, x = MadeUpGpu(), torch.arange(3)
    with monkeypatch.context() as patch:
        gpu.on(patch)
        upload = Upload([x], torch.device("cuda", 0))
        assert gpu.calls == ["begin uploads", "pinned", "copied, queued", "event recorded in uploads", "end uploads"]
        gpu.calls.clear()
        assert torch.equal(upload.arrays()[0], x)
    assert gpu.calls == ["current waits for the event", "used in current"], "and the host waits for nothing"
