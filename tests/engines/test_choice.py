"""Which engine and which device are chosen, and what is said where there is none."""

import threading

import pytest
import torch

import etsplat
from etsplat import _native
from etsplat.core.errors import EngineUnavailableError, InputError
from etsplat.engines import choice
from etsplat.engines.choice import engine_for, queued_steps, resolve_device
from etsplat.engines.cpu.engine import CpuEngine
from etsplat.engines.cuda import device as cuda_device_module
from etsplat.engines.cuda.engine import CudaEngine
from etsplat.engines.engine import Engine
from etsplat.engines.native.engine import NativeEngine
from etsplat.geometry.icosphere import icosphere
from etsplat.geometry.topology import MeshTopology
from etsplat.ops.mesh_energies import mesh_energies
from etsplat.ops.spherical_harmonics import spherical_harmonics
from etsplat.ops.triangle_area import mean_area
from helpers.simt.build import Simt

CPU = torch.device("cpu")


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_engine_follows_the_precision(dtype):
    """On the CPU: native for float32, the reference for float64."""
    assert engine_for(torch.zeros(1, dtype=dtype)).name == ("cpu" if dtype == torch.float32 else "reference")


def test_other_precisions_are_refused():
    with pytest.raises(ValueError, match=r"tensors must be float32 or float64, got torch\.float16"):
        engine_for(torch.zeros(1, dtype=torch.float16))


def test_a_block_chooses_and_blocks_nest():
    """The innermost counts; None leaves the choice as it is; afterwards, also after an error, all is as before."""
    tensor = torch.zeros(1)
    with etsplat.engine("reference"):
        assert engine_for(tensor).name == "reference"
        with etsplat.engine(None):
            assert engine_for(tensor).name == "reference"
        with etsplat.engine("cpu"):
            assert engine_for(tensor).name == "cpu"
        assert engine_for(tensor).name == "reference"
    with pytest.raises(KeyError), etsplat.engine("reference"):
        raise KeyError
    assert engine_for(tensor).name == "cpu"


def test_an_unknown_engine_is_refused_with_the_list():
    with (
        pytest.raises(ValueError, match="engine must be one of reference, cpu, cuda, webgpu or None, got 'metal'"),
        etsplat.engine("metal"),
    ):
        pass


def test_other_threads_keep_their_own_choice():
    """A block of one thread is not seen by another, in either direction."""
    inside, chosen = threading.Barrier(2), {}

    def other() -> None:
        with etsplat.engine("reference"):
            inside.wait(10)
            chosen["other"] = engine_for(torch.zeros(1)).name
            inside.wait(10)

    thread = threading.Thread(target=other)
    thread.start()
    inside.wait(10)
    chosen["main"] = engine_for(torch.zeros(1)).name
    inside.wait(10)
    thread.join()
    assert chosen == {"main": "cpu", "other": "reference"}


class Toy(Engine):
    """Computes like the reference and counts the pictures and losses."""

    name = "toy"

    def __init__(self) -> None:
        self.losses = self.backwards = 0

    def mesh_energies(self, *arguments):
        self.losses += 1
        energies = super().mesh_energies(*arguments)
        if energies[0].requires_grad:
            energies[0].register_hook(self._count)
        return energies

    def _count(self, _gradient):
        self.backwards += 1


@pytest.fixture
def toy(monkeypatch: pytest.MonkeyPatch) -> Toy:
    monkeypatch.setattr(choice, "_engines", dict(choice._engines))
    toy = Toy()
    etsplat.register_engine(toy)
    return toy


def test_what_is_built_in_stays(toy: Toy):
    """An engine without a name of its own would take the place of the oracle; one of yours may be replaced."""
    etsplat.register_engine(Toy())
    for name in ("reference", "cpu"):
        toy.name = name
        with pytest.raises(ValueError, match=f"engine must have a name of its own, got '{name}', which is built in"):
            etsplat.register_engine(toy)
    with pytest.raises(ValueError, match="engine must be an Engine, got int"):
        etsplat.register_engine(3)  # pyright: ignore[reportArgumentType]


def test_an_engine_of_ones_own_is_used_where_it_is_chosen(toy: Toy):
    """Registered, it runs the operations of its block and no others, and is in the list of those that there are."""
    topology = MeshTopology.from_faces(icosphere(1)[1], 42)
    vertices = icosphere(1)[0]
    expected = mesh_energies(vertices, topology.connectivity)
    assert toy.losses == 0
    with etsplat.engine("toy"):
        energies = mesh_energies(vertices, topology.connectivity)
        mean_area(vertices[topology.faces])
    assert toy.losses == 1
    torch.testing.assert_close(energies, expected)
    with pytest.raises(ValueError, match="reference, cpu, cuda, webgpu, toy or None"), etsplat.engine("metal"):
        pass


@pytest.mark.parametrize("elsewhere", [False, True])
def test_backward_keeps_the_engine_of_forward(toy: Toy, elsewhere: bool):
    """Outside of the block, within another one, and in another thread."""
    vertices = icosphere(1)[0].requires_grad_()
    with etsplat.engine("toy"):
        edge = mesh_energies(vertices, MeshTopology.from_faces(icosphere(1)[1], 42).connectivity).edge
    if elsewhere:
        thread = threading.Thread(target=edge.backward)
        thread.start()
        thread.join()
    else:
        with etsplat.engine("cpu"):
            edge.backward()
    assert (toy.losses, toy.backwards) == (1, 1)


def test_native_backward_keeps_its_engine(monkeypatch: pytest.MonkeyPatch):
    """The native gradient belongs to what was computed natively, whatever is chosen afterwards."""
    coefficients, directions, called = torch.rand(5, 4, 3).requires_grad_(), torch.rand(5, 3), []
    backward = _native.spherical_harmonics_backward

    def noted(*given, **named):
        called.append(1)
        return backward(*given, **named)

    monkeypatch.setattr(_native, "spherical_harmonics_backward", noted)
    colors = spherical_harmonics(coefficients, directions, 1)
    with etsplat.engine("reference"):
        colors.sum().backward()
    assert called == [1]


def test_every_engine_has_every_operation():
    """Engine "cuda" inherits nothing from the reference; engine "cpu" only what is a few operations of torch."""
    operations = {name for name, value in vars(Engine).items() if isinstance(value, staticmethod)}
    own = {cls: set(vars(cls)) | set(vars(NativeEngine)) for cls in (CpuEngine, CudaEngine)}
    assert operations <= own[CudaEngine]
    assert operations - own[CpuEngine] == {"pick_values", "update_statistics", "weighted_sum"}


def test_engine_cuda_wants_float32_on_a_gpu(simt: Simt):
    """Where the shim stands for the GPU, CPU tensors are on it; without, they are not."""
    with etsplat.engine("cuda"):
        assert engine_for(torch.zeros(1)).name == "cuda"
        with pytest.raises(ValueError, match=r"engine cuda computes in float32, got torch\.float64"):
            engine_for(torch.zeros(1, dtype=torch.float64))


def test_engine_cuda_refuses_tensors_on_the_cpu():
    with etsplat.engine("cuda"), pytest.raises(ValueError, match="engine cuda needs tensors on a GPU, got cpu"):
        engine_for(torch.zeros(1))


def test_only_engine_cuda_queues_steps(simt: Simt):
    with etsplat.engine("cuda"):
        assert queued_steps(torch.zeros(1)) is engine_for(torch.zeros(1)).queued
    with pytest.raises(ValueError, match="engine cpu queues no steps"):
        queued_steps(torch.zeros(1))


def test_device_and_engine_must_not_contradict_each_other():
    """One line that names both."""
    for device, engine in (("cpu", "cuda"), ("cuda", "cpu")):
        with pytest.raises(InputError, match=f"engine: {engine} does not compute on device {device}"):
            resolve_device(device, engine)


def test_a_device_is_chosen_where_none_is_named(simt: Simt):
    """The engine decides; an engine of the CPU stays there."""
    assert resolve_device("cpu", None) == CPU
    assert resolve_device(None, "reference") == CPU
    assert resolve_device(None, "cuda") == CPU  # the shim's tensors are there


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_without_a_gpu_tasks_run_on_the_cpu_unless_asked_otherwise():
    """No GPU is no reason to fail, but asking for one is answered with what is missing."""
    assert resolve_device(None, None) == CPU
    for device, engine in (("cuda", None), (None, "cuda")):
        with pytest.raises(EngineUnavailableError, match="compute on the CPU"):
            resolve_device(device, engine)


def test_a_gpu_that_cannot_be_used_is_named_with_the_reason(monkeypatch, capsys):
    """With a torch that is too old, say, tasks run on the CPU, and a line says why."""
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(cuda_device_module.torch, "__version__", "2.9.1+cu128")
    assert resolve_device(None, None) == CPU
    assert "computing on the CPU: the GPU engine needs torch 2.11 or newer, found 2.9.1" in capsys.readouterr().err
