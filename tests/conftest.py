"""Fixtures shared by all tests."""

import os
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest
import torch

from etsplat.core.kernels import DISTANCES, KERNELS
from etsplat.core.spelling import spelled_as_options
from etsplat.engines.cuda.launch import device_type, use_backend
from helpers.simt.build import Races, Simt, watched

# Tests run side by side, on small tensors: torch's own threads would only wait for each other.
torch.set_num_threads(1)

# Of the engine-parameterised tests.
ENGINES = ("reference", "cpu", "cuda")

REPOSITORY = Path(__file__).resolve().parent.parent


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--engine", choices=ENGINES, default=None, help="run the engine-parameterised tests on this engine only"
    )
    parser.addoption(
        "--ptx",
        metavar="ARCHITECTURE",
        help="run kernels as NVRTC compiles them, for compute_75 or newer; other tests not at all",
    )
    parser.addoption("--gpu", action="store_true", help="run the tests whose kernels run on a GPU; others not at all")


def pytest_configure(config: pytest.Config) -> None:
    Simt.architecture = config.getoption("--ptx")
    # Workers side by side, each with a thread per core, would wait for each other. Subprocesses inherit the variables.
    if "PYTEST_XDIST_WORKER" in os.environ:
        os.environ.setdefault("ETSPLAT_NUM_THREADS", "2")
        os.environ.setdefault("OMP_NUM_THREADS", "1")


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    if "engine" in metafunc.fixturenames:
        only = metafunc.config.getoption("--engine")
        metafunc.parametrize("engine", [only] if only else ENGINES, indirect=True)


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    if config.getoption("--gpu"):
        wanted = _runs_on_a_gpu
    elif config.getoption("--ptx") or watched():
        wanted = _runs_kernels
    else:
        return
    chosen = [item for item in items if isinstance(item, pytest.Function) and wanted(item)]
    config.hook.pytest_deselected(items=[item for item in items if item not in chosen])
    items[:] = chosen


def _runs_on_a_gpu(test: pytest.Function) -> bool:
    """Whether its kernels run on a GPU where there is one."""
    parameters = _parameters(test)
    by_engine = any(parameters.get(name) == "cuda" for name in ("engine", "native"))
    return by_engine or test.get_closest_marker("cuda") is not None


def _parameters(test: pytest.Function) -> dict[str, Any]:
    return test.callspec.params if hasattr(test, "callspec") else {}


def _runs_kernels(test: pytest.Function) -> bool:
    """Whether it takes a fixture by which CUDA kernels may run on the CPU."""
    parameters = _parameters(test)
    others = {"reference", "cpu", "device"}
    if any(parameters.get(name) in others for name in ("engine", "native", "cuda_engine")):
        return False
    return not {"simt", "cuda_engine", "engine_of", "races"}.isdisjoint(test.fixturenames)


@pytest.fixture
def command_line() -> Iterator[None]:
    """Messages are those of the command line, as `main()` has them; for tests that run a command without it."""
    with spelled_as_options():
        yield


@pytest.fixture(scope="session")
def reported() -> Races | None:
    """What ThreadSanitizer says, where it watches."""
    return Races() if watched() else None


@pytest.fixture(autouse=True)
def no_races(reported: Races | None) -> Iterator[None]:
    """A race in a kernel fails the test in which it is found."""
    yield
    if reported:
        assert reported.new() == []


@pytest.fixture
def engine_of() -> Iterator[Callable[[str], str]]:
    """Makes the engine of a name usable in a test and returns the name: "cuda" by the shim where there is no GPU."""
    with ExitStack() as stack:

        def prepared(name: str) -> str:
            if name == "cuda" and not torch.cuda.is_available():
                stack.enter_context(use_backend(Simt()))
            return name

        yield prepared


@pytest.fixture
def engine(request: pytest.FixtureRequest, engine_of: Callable[[str], str]) -> str:
    """The name of an engine."""
    return engine_of(request.param)


@pytest.fixture(params=list(KERNELS))
def kernel(request: pytest.FixtureRequest) -> str:
    return request.param


@pytest.fixture(params=DISTANCES)
def distance(request: pytest.FixtureRequest) -> str:
    return request.param


@pytest.fixture
def simt() -> Iterator[Simt]:
    """CUDA kernels run on CPU tensors, by the shim; engine "cuda" takes these."""
    backend = Simt()
    with use_backend(backend):
        yield backend


@pytest.fixture(params=["simt", pytest.param("device", marks=pytest.mark.cuda)])
def cuda_engine(request: pytest.FixtureRequest) -> Iterator[str]:
    """The engine "cuda", by the shim and, where there is one, on a GPU."""
    if request.param == "device":
        if not torch.cuda.is_available():
            pytest.skip("no GPU")
        yield "cuda"
    else:
        with use_backend(Simt()):
            yield "cuda"


@pytest.fixture
def cuda_device(cuda_engine: str) -> torch.device:
    """Where the tensors of engine "cuda" are: on a GPU, or on the CPU for the shim."""
    return torch.device(device_type())


@pytest.fixture
def looks_like_a_class() -> object:
    """As `list[int]` does on Python 3.10: `isinstance` takes it for a type, and `issubclass` refuses it."""

    class Alias:
        __class__ = property(lambda self: type)

    return Alias()


@pytest.fixture
def rng() -> torch.Generator:
    """A generator that starts alike in every test."""
    return torch.Generator().manual_seed(20261121)


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Folder of the real input, or a skip that says where it is looked for."""
    for path in (REPOSITORY / "data", REPOSITORY.parent / "shared" / "data"):
        if all((path / name).is_dir() for name in ("famous", "objects", "scenes")):
            return path
    pytest.skip("real input is not there: data/ with famous, objects and scenes")
