"""The backend for GPUs on a driver without one (helpers/simt/driver.py): its launches, captures and errors."""

import ctypes
import gc
import threading
from collections.abc import Iterator

import pytest
import torch

from etsplat.core.errors import EngineUnavailableError
from etsplat.data.demo_object import demo_object
from etsplat.data.photograph import photograph
from etsplat.engines.cuda import device as device_module
from etsplat.engines.cuda.compile import compile_program, target_architecture
from etsplat.engines.cuda.device import Device
from etsplat.engines.cuda.launch import launch_each, use_backend
from etsplat.engines.cuda.program import Program
from etsplat.engines.cuda.steps import Repeated
from etsplat.tasks.reconstruct import make_trainer
from etsplat.tasks.reconstruct_config import ReconstructConfig
from etsplat.tasks.starts import make_start
from helpers.simt import driver as faults
from helpers.simt.build import Simt
from helpers.simt.driver import Driver, Streams, device_without_gpu
from helpers.simt.inline import Inline
from helpers.trainers import OnEngine, same_bits

pytestmark = pytest.mark.skipif(torch.cuda.is_available(), reason="the driver is a real one")

ADD = Inline("""extern "C" __global__ void add(float* values, int count, float more) {
    const int i = blockIdx.x * blockDim.x + threadIdx.x;
    if (i < count) values[i] += more;
}
""")


@pytest.fixture
def driver() -> Driver:
    return Driver()


@pytest.fixture
def streams(driver: Driver) -> Streams:
    return Streams(driver)


@pytest.fixture
def backend(driver: Driver, streams: Streams) -> Iterator[Device]:
    with device_without_gpu(driver, streams) as found, use_backend(found):
        yield found
    assert driver.captured_stream is None
    assert driver.problems == []


def add(values: torch.Tensor, more: float = 1.0) -> None:
    launch_each(ADD, "add", len(values), (values, len(values), more))


def test_launches_arrive_with_their_arguments(backend: Device, driver: Driver) -> None:
    """Loaded at the first launch, in the context that has to be made current for it; nothing is looked up again."""
    values = torch.arange(700.0)
    add(values, 0.5)
    add(values, 2.0)
    assert torch.equal(values, torch.arange(700.0) + 2.5)
    assert driver.calls["cuLaunchKernel"] == 2
    for name in ("cuDevicePrimaryCtxRetain", "cuCtxSetCurrent", "cuModuleLoadData", "cuModuleGetFunction"):
        assert driver.calls[name] == 1, name


def test_other_threads_enter_the_context(backend: Device, driver: Driver) -> None:
    """Those of autograd have none at first."""
    values = torch.zeros(3)
    add(values)
    thread = threading.Thread(target=add, args=(values,))
    thread.start()
    thread.join()
    assert values.tolist() == [2.0] * 3
    assert driver.calls["cuDevicePrimaryCtxRetain"] == 1
    assert driver.calls["cuCtxSetCurrent"] == 2


def test_what_is_repeated_is_warmed_up_and_captured_on_one_stream(
    backend: Device, driver: Driver, streams: Streams
) -> None:
    """The order of it all: each waits for the other, the capture for the warm-up, and caches stay as they are."""
    values = torch.zeros(40)
    repeated = Repeated(lambda: add(values), backend.memory_pool())
    repeated()
    assert driver.events == ["1 waits for 0", "add on 1", "0 waits for 1"]
    driver.events.clear()
    repeated()
    assert driver.events == [
        "1 waits for 0", "capture of 1 begins", "add on 1", "capture of 1 ends", "0 waits for 1"
    ]  # fmt: skip
    assert [graph.replays for graph in streams.graphs] == [1]
    driver.events.clear()
    repeated()
    assert values.tolist() == [3.0] * 40
    assert driver.events == []
    assert driver.calls["cuLaunchKernel"] == 2  # a graph asks for none
    another = Repeated(lambda: add(values), backend.memory_pool())
    another()
    assert {event.split()[-1] for event in driver.events if "add" in event} == {"1"}


def test_arguments_of_a_graph_are_those_of_its_capture(backend: Device) -> None:
    values, more = torch.zeros(2), ctypes.c_float(1.0)
    arguments = (ctypes.c_void_p(values.data_ptr()), ctypes.c_int32(2), more)
    repeated = Repeated(lambda: backend.launch(ADD, "add", (1, 1, 1), (32, 1, 1), arguments), None)
    repeated()
    repeated()
    more.value = 100.0
    repeated()
    assert values.tolist() == [3.0, 3.0]


@pytest.mark.parametrize("failures", [1, 2])
def test_a_capture_without_room_is_made_again_when_caches_are_empty(
    backend: Device, driver: Driver, failures: int
) -> None:
    """Once; the second time it is an error, and nothing stays captured."""
    left = [failures]

    def body() -> None:
        if left[0] > 0:
            left[0] -= 1
            raise torch.OutOfMemoryError("no room")

    if failures == 1:
        backend.capture(body, None)
    else:
        with pytest.raises(torch.OutOfMemoryError, match="no room"):
            backend.capture(body, None)
    assert driver.events.count("caches emptied") == 1
    assert driver.events.count("capture of 1 begins") == 2
    assert driver.events[-1] == "0 waits for 1"


def test_kernels_are_not_loaded_in_a_capture(backend: Device, driver: Driver) -> None:
    """The driver refuses it; which is why what is captured is called once before."""
    with pytest.raises(RuntimeError, match="CUDA_ERROR_STREAM_CAPTURE_UNSUPPORTED"):
        backend.capture(lambda: add(torch.zeros(1)), None)
    assert not backend.capturing


@pytest.mark.parametrize("collecting", [True, False])
def test_no_garbage_is_collected_in_a_capture(backend: Device, collecting: bool) -> None:
    """A graph among it would be destroyed, which makes the capture invalid: an H100 refused one in hundreds. Behind it
    all is as before, also behind an error."""
    seen: list[bool] = []

    def body() -> None:
        seen.append(gc.isenabled())
        add(torch.zeros(1))

    before = gc.isenabled()
    try:
        (gc.enable if collecting else gc.disable)()
        backend.warm_up(body)
        backend.capture(body, None)
        with pytest.raises(ZeroDivisionError):
            backend.capture(lambda: [1 // 0], None)
        assert (seen, gc.isenabled()) == ([collecting, False], collecting)
    finally:
        (gc.enable if before else gc.disable)()


def test_an_error_within_a_capture_is_the_one_that_is_seen(
    backend: Device, streams: Streams, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Though to end the capture fails, too, as it does in torch."""
    end = faults.Graph.capture_end

    def ends_badly(self: faults.Graph) -> None:
        end(self)
        raise RuntimeError("operation failed due to a previous error during capture")

    monkeypatch.setattr(faults.Graph, "capture_end", ends_badly)
    with pytest.raises(ZeroDivisionError):
        backend.capture(lambda: [1 // 0], None)


@pytest.mark.parametrize(
    ("status", "error", "text"),
    [
        (faults.OUT_OF_MEMORY, torch.OutOfMemoryError, "launch of add .*: the GPU has no memory left"),
        (faults.ILLEGAL_ADDRESS, RuntimeError, "ILLEGAL_ADDRESS .*CUDA_LAUNCH_BLOCKING=1"),
        (faults.INVALID_VALUE, RuntimeError, r"launch of add \(inline.cu\): CUDA_ERROR_INVALID_VALUE"),
    ],
)
def test_failed_launches_say_what_failed(
    backend: Device, driver: Driver, status: int, error: type[Exception], text: str
) -> None:
    add(torch.zeros(1))
    driver.fail("cuLaunchKernel", status)
    with pytest.raises(error, match=text):
        add(torch.zeros(1))
    driver.fail("cuLaunchKernel", faults.SUCCESS)
    add(torch.zeros(1))


@pytest.mark.parametrize(
    ("function", "status", "text"),
    [
        ("cuDevicePrimaryCtxRetain", faults.OUT_OF_MEMORY, "context: the GPU has no memory left"),
        ("cuCtxSetCurrent", faults.INVALID_CONTEXT, "context of device 0: CUDA_ERROR_INVALID_CONTEXT"),
        ("cuModuleLoadData", faults.UNSUPPORTED_PTX, "the driver is older than NVRTC, .* update the driver"),
        ("cuModuleGetFunction", faults.INVALID_HANDLE, r"inline.cu: CUDA_ERROR_INVALID_HANDLE"),
    ],
)
def test_what_cannot_be_loaded_says_why(backend: Device, driver: Driver, function: str, status: int, text: str) -> None:
    driver.fail(function, status)
    with pytest.raises(RuntimeError, match=text):
        add(torch.zeros(1))


@pytest.mark.parametrize(("version", "nvrtc", "refused"), [(12080, 13, True), (12080, 12, False), (13020, 12, False)])
def test_drivers_run_what_compilers_of_their_number_or_before_made(
    driver: Driver, streams: Streams, monkeypatch: pytest.MonkeyPatch, version: int, nvrtc: int, refused: bool
) -> None:
    monkeypatch.setattr(device_module, "nvrtc_version", lambda _: (nvrtc, 9))
    driver.version = version
    if not refused:
        with device_without_gpu(driver, streams):
            return
    expected = pytest.raises(EngineUnavailableError, match=r"supports CUDA 12\.8 .* pip install 'etsplat\[cuda12\]'")
    with expected, device_without_gpu(driver, streams):
        pass


def test_newer_gpus_get_ptx(backend: Device, streams: Streams, monkeypatch: pytest.MonkeyPatch, tmp_path) -> None:
    """Of the newest architecture that NVRTC knows, ending with a 0; one older than all is refused."""
    monkeypatch.setenv("ETSPLAT_CACHE_DIR", str(tmp_path / "kernels"))
    assert target_architecture(9, 0) == "sm_90"
    newest = target_architecture(99, 0)
    assert newest.startswith("compute_")
    assert int(newest.removeprefix("compute_")) >= 120
    ptx = compile_program(Program("fill.cu"), newest)
    assert b".entry fill" in ptx
    assert ptx.endswith(b"\0")
    with pytest.raises(EngineUnavailableError, match=r"compute capability 3\.5"):
        target_architecture(3, 5)
    asked = []
    monkeypatch.setattr(streams, "capability", (99, 0))
    original = device_module.compile_program
    monkeypatch.setattr(device_module, "compile_program", lambda *of: (asked.append(of[1]), original(*of))[1])
    values = torch.zeros(1)
    add(values)
    assert (asked, values.item()) == ([newest], 1.0)


def test_a_fit_is_the_same_as_without_the_driver(driver: Driver, streams: Streams) -> None:
    """Steps that are captured and replayed, through cuda-bindings, with the bits of the shim alone."""
    config = ReconstructConfig.tiny().changed(
        {"resolution": 32, "iterations": 6, "refinement.first": 0.1, "refinement.subdivisions": 0}
        | {"output.evaluate_every": 0, "output.checkpoint_every": 0}
    )
    views = photograph(demo_object(), 32, 32, elevations=(-35.0, 35.0), azimuths=3, supersampling=2)

    def fitted() -> tuple[OnEngine, list[float]]:
        start = make_start(None, views, config, torch.device("cpu"))
        fit = OnEngine("cuda", lambda: make_trainer(start.mesh, views, config))
        return fit, fit.run(6)

    with use_backend(Simt()):
        alone, losses = fitted()
    with device_without_gpu(driver, streams) as backend, use_backend(backend):
        through, same_losses = fitted()
    assert same_losses == losses
    same_bits(through, alone)
    assert driver.problems == []
    assert driver.events.count("caches emptied") == 0
    assert driver.events.count("capture of 1 begins") == len(streams.graphs) > 0
    assert all(graph.replays > 1 for graph in streams.graphs)
