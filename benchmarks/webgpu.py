"""Time and traffic of a picture by engine "webgpu", beside engine "cpu".

python -m benchmarks.webgpu                           100,000 triangles, 960 x 540
python -m benchmarks.webgpu --triangles 1000000 --pictures 3

The triangles are small and soft, all around the camera's middle, as those of a soup are (`soup`). Processor time counts
all threads of this process; on lavapipe, which is a driver for the CPU, that is what its "GPU" takes, too.
"""

import argparse
import time
from collections.abc import Callable
from typing import Any

import torch

import etsplat
from benchmarks import machine
from etsplat.engines.webgpu.device import WebGpu, gpu


def parse(arguments: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--triangles", type=int, default=100_000)
    parser.add_argument("--size", type=int, nargs=2, default=(960, 540), metavar=("WIDTH", "HEIGHT"))
    parser.add_argument("--pictures", type=int, default=5)
    parser.add_argument("--threads", type=int, default=1, help="of engine cpu")
    return parser.parse_args(arguments)


def soup(count: int, width: int, height: int) -> dict[str, Any]:
    """Triangles of some 10 pixels, between 2 and 6 from the camera; opacities and softness at random."""
    rng = torch.Generator().manual_seed(0)
    middles = torch.rand(count, 1, 3, generator=rng) * torch.tensor([8.0, 5.0, 4.0]) - torch.tensor([4.0, 2.5, -2.0])
    return {
        "vertices": middles + 0.03 * torch.randn(count, 3, 3, generator=rng),
        "opacities": torch.rand(count, generator=rng),
        "sigma": 0.05 + 1.5 * torch.rand(count, generator=rng),
        "face_colors": torch.rand(count, 3, generator=rng),
        "cameras": etsplat.Cameras(torch.eye(4)[None], etsplat.intrinsics(50.0, width, height)[None], width, height),
    }


def timed(draw: Callable[[], torch.Tensor], pictures: int) -> tuple[float, float, torch.Tensor]:
    """Least milliseconds of the processor and of the clock, and the picture; the first one is not counted."""
    picture, found = draw(), []
    for _ in range(pictures):
        start = time.process_time(), time.perf_counter()
        picture = draw()
        found.append((1e3 * (time.process_time() - start[0]), 1e3 * (time.perf_counter() - start[1])))
    processor, clock = (min(column) for column in zip(*found, strict=True))
    return processor, clock, picture


class Traffic:
    """Counts what goes to the device and comes back."""

    def __init__(self, device: WebGpu) -> None:
        self.up = self.down = self.steps = self.submissions = 0
        self._filled, self._read, self._run = device.filled, device.read, device.run
        device.filled, device.read, device.run = self.filled, self.read, self.run

    def filled(self, name: str, values: Any) -> Any:
        """As of the device."""
        self.up += len(values) if isinstance(values, bytes) else values.nbytes
        return self._filled(name, values)

    def read(self, *arguments: Any) -> Any:
        """As of the device."""
        numbers = self._read(*arguments)
        self.down += numbers.nbytes
        return numbers

    def run(self, steps: Any, *arguments: Any) -> None:
        """As of the device."""
        self.steps += len(steps)
        self.submissions += 1
        self._run(steps, *arguments)


def main(arguments: list[str] | None = None) -> None:
    options = parse(arguments)
    etsplat.set_num_threads(options.threads)
    scene = soup(options.triangles, *options.size)
    device = gpu()
    pictures = {}
    print(f"{options.triangles:,} triangles, {options.size[0]} x {options.size[1]}; {machine.description()}")
    for name in ("cpu", "webgpu"):
        with etsplat.engine(name):
            processor, clock, pictures[name] = timed(lambda: etsplat.rasterize(**scene).color, options.pictures)
        place = f"{options.threads} threads" if name == "cpu" else device.name
        print(f"{name}: {processor:.0f} ms of the processor, {clock:.0f} ms by the clock ({place})")
    difference = (pictures["cpu"] - pictures["webgpu"]).abs()
    beyond = float((difference > 1 / 510).float().mean())
    print(f"difference: {float(difference.max()):.1e} at most, {beyond:.1e} of the values by more than half of 1/255")
    counted = Traffic(device)
    with etsplat.engine("webgpu"):
        etsplat.rasterize(**scene)
    print(f"{counted.submissions} submissions, {counted.steps} dispatches")
    print(f"{counted.up:,} bytes to the device, {counted.down:,} back; buffers {device.held_bytes:,}")


if __name__ == "__main__":
    main()
