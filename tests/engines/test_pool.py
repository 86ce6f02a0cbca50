"""Threads of the CPU engine, where processes fork and where they end."""

import os
import subprocess
import sys

import pytest

import etsplat
from etsplat.engines.native.pool import empty_image, zeros_image

DRAWING = """
import os, signal, threading, time, torch
from etsplat import Cameras, intrinsics, look_at, rasterize, set_num_threads
set_num_threads(2)
view = look_at(torch.tensor([[0.0, 0.5, 3.0]]), torch.zeros(3), torch.tensor([0.0, 1.0, 0.0]))
cameras = Cameras(view, intrinsics(50, 160, 120)[None], 160, 120)
many, grey = torch.rand(3000, 3, 3), torch.full((3000,), 0.5)  # torch's random numbers have a lock of their own
def draw(count):
    soup = {"face_colors": grey[:count, None], "opacities": grey[:count], "sigma": 0.3}
    return rasterize(many[:count], **soup, cameras=cameras).color
def work():
    while True:
        draw(3000)
draw(3000)
for _ in range(2):
    threading.Thread(target=work, daemon=True).start()
"""

FORKING = """
torch.set_num_threads(1)  # those of torch do not survive a fork
ended = []
for k in range(30):
    time.sleep(0.002 * (k % 5))
    child = os.fork()
    if child == 0:
        signal.alarm(5)
        shape = draw(500).shape
        os._exit(0 if shape == (1, 120, 160, 1) else 3)
    ended.append(os.waitpid(child, 0)[1])
    if ended[-1]:
        break
print(ended, flush=True)
os._exit(0)
"""


def run(code):
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="processes do not fork on this system")
def test_children_of_a_process_that_renders_can_render():
    """Nobody whom the child has not holds its locks, and its pool has threads of its own."""
    done = run(DRAWING + FORKING)
    assert done.stdout == f"{[0] * 30}\n", done.stderr


@pytest.mark.parametrize("count", [1.5, -1, "2", True])
def test_threads_are_a_whole_number(count):
    with pytest.raises(ValueError, match="count must be an integer of at least 0, got"):
        etsplat.set_num_threads(count)


def test_the_interpreter_ends_while_threads_draw():
    """Before Python 3.14 it ends threads that come back to it, in the middle of C++ that may not be left so."""
    done = run(DRAWING + "time.sleep(0.1)")
    assert done.returncode == 0, done.stderr


def test_images_for_which_there_is_no_room_say_how_much_they_want() -> None:
    for make in (empty_image, zeros_image):
        with pytest.raises(MemoryError, match=r"no room for an image of shape \(4194304, 4194304, 4\), 281,475 GB"):
            make(1 << 22, 1 << 22, 4)
