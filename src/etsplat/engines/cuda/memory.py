"""Device memory for kernels: many arrays in one allocation, and numbers that come back without stopping the device."""

import ctypes

import torch
from torch import Tensor

_ALIGNMENT = 256


class Arena:
    """Uninitialised arrays in one tensor, by name.

    The tensor comes from torch's allocator, which recycles it in the order of the stream and keeps it apart within a
    captured graph.
    """

    def __init__(self, device: torch.device, **sizes: int) -> None:
        """Makes room for arrays of these numbers of bytes."""
        self._offsets, end = {}, 0
        for name, size in sizes.items():
            self._offsets[name] = end
            end += -(-size // _ALIGNMENT) * _ALIGNMENT
        self._memory = torch.empty(end, dtype=torch.uint8, device=device)
        base = self._memory.data_ptr()
        self.addresses = {name: base + self._offsets[name] if size else None for name, size in sizes.items()}

    def __getitem__(self, name: str) -> ctypes.c_void_p:
        """Address of an array, as an argument of kernels."""
        return ctypes.c_void_p(self.addresses[name])

    def bytes(self, name: str, count: int) -> Tensor:
        """The first ``count`` bytes of an array."""
        begin = self._offsets[name]
        return self._memory[begin : begin + count]


class PendingNumber:
    """An int64 on its way from the device; work queued after this does not hold it up."""

    def __init__(self, source: Tensor) -> None:
        self._host = source
        self._arrived = None
        if source.is_cuda:
            self._host = torch.empty(1, dtype=torch.int64, pin_memory=True)
            self._host.copy_(source, non_blocking=True)
            self._arrived = torch.cuda.Event()
            self._arrived.record()

    def wait(self) -> int:
        """The number, when the device has got as far as where it was asked for."""
        if self._arrived is not None:
            self._arrived.synchronize()
        return int(self._host.item())
