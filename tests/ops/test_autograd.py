"""What torch can do with a differentiable function holds for every operation, or is refused in plain words.

Checkpoints and hooks on saved tensors, of both kinds, are in test_memory.py, over the same table.
"""

import importlib
import inspect
import pkgutil
from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor

import etsplat
from etsplat import ops
from helpers.operations import CASES, COMPOSED, SMOOTH, loss

WITHOUT_GRADIENTS = {
    "rasterize_opaque": "z-buffer: runs without gradients",
    "render_opaque": "z-buffer: runs without gradients",
    "colors_backward": "gives gradients itself: tests/optim/test_shared_steps.py",
    "update_statistics": "in place, of detached statistics",
    "one_kind_of_colors": "a check",
    "count_levels": "returns a number",
    "texture_at_pixels": "a part of rasterize_antialiased",
    "load_nvdiffrast": "imports a module",
    "rasterize_nvdiffrast": "nvdiffrast's own; needs a GPU and that program",
    "ellipse": "camera paths: float64 on the host",
    "interpolated": "camera paths: float64 on the host",
    "orbit": "camera paths: float64 on the host",
    "spiral": "camera paths: float64 on the host",
    "start_soup": "makes parameters from points",
    "flip": "torch throughout: tests/metrics/test_flip.py",
    "geometry_metrics": "returns Python numbers",
    "psnr": "returns a Python number",
    "silhouette_iou": "returns a Python number",
    "ssim": "returns a Python number",
    "longest_edge_plan": "returns a plan of indices",
    "save_image": "writes a file",
    "save_mesh": "writes a file",
}
"""Public functions of tensors that are not in the table, and why."""


def _of_tensors(function: Any) -> bool:
    """Whether it takes floating-point tensors."""
    if not inspect.isfunction(function):
        return False
    return any("Float[" in str(p.annotation) for p in inspect.signature(function).parameters.values())


def test_every_public_operation_is_in_the_table_or_says_why_not() -> None:
    """Those of `etsplat` that take tensors, and all of `etsplat.ops`."""
    public = {name for name in etsplat.__all__ if _of_tensors(getattr(etsplat, name))}
    for module in pkgutil.iter_modules(ops.__path__, "etsplat.ops."):
        members = vars(importlib.import_module(module.name)).items()
        public |= {
            name
            for name, value in members
            if inspect.isfunction(value) and value.__module__ == module.name and not name.startswith("_")
        }
    tabled = {name.split("/")[0] for name in CASES | COMPOSED if "." not in name}
    assert public - tabled == set(WITHOUT_GRADIENTS)


FACTORIES = CASES | COMPOSED
OF_TORCH = ("pick_values", "weighted_sum")
"""Operations that engine cpu has no code of its own for."""
EVERY_OPERATION = pytest.mark.parametrize("name", FACTORIES)


def _grown(name: str, engine: str, rng: torch.Generator) -> tuple[list[Tensor], Callable[..., list[Tensor]]]:
    """Leaves that want gradients, and the outputs as a function of them."""
    leaves, run = FACTORIES[name](rng, engine)

    def outputs(*values: Tensor) -> list[Tensor]:
        return run(**dict(zip(leaves, values, strict=True)))

    return [leaf.clone().requires_grad_() for leaf in leaves.values()], outputs


def _gradients(values: list[Tensor], outputs: Callable[..., list[Tensor]]) -> list[Tensor]:
    return list(torch.autograd.grad(loss(outputs(*values)), values))


def _assert_same(found: list[Tensor], expected: list[Tensor]) -> None:
    assert len(found) == len(expected) > 0
    for one, other in zip(found, expected, strict=True):
        assert one.dtype == other.dtype
        assert torch.equal(one, other)


@pytest.mark.parametrize("name", SMOOTH)
def test_gradients_are_derivatives(name, rng):
    """gradcheck of the reference engine, in float64."""
    leaves, run = SMOOTH[name](rng, "reference")
    assert torch.autograd.gradcheck(
        lambda *values: tuple(run(**dict(zip(leaves, values, strict=True)))),
        [leaf.requires_grad_() for leaf in leaves.values()],
        fast_mode=True,
    )


@pytest.mark.parametrize("name", CASES)
def test_compiled_by_torch_it_is_the_same(name, rng):
    """torch.compile(fullgraph=False): the same bits, with their gradients; what it cannot trace breaks its graph."""
    values, outputs = _grown(name, "cpu", rng)
    torch._dynamo.reset()
    compiled = torch.compile(outputs, backend="eager", fullgraph=False)
    _assert_same(_gradients(values, compiled), _gradients(values, outputs))


@pytest.mark.parametrize("name", [name for name in CASES if name not in OF_TORCH])
def test_gradients_of_gradients_are_refused_by_native_engines(name, rng):
    """Rather than to be zero without a word, whichever way they are asked for; the reference engine has them."""
    values, outputs = _grown(name, "cpu", rng)
    ways = (
        lambda: torch.autograd.grad(loss(outputs(*values)), values, create_graph=True),
        lambda: loss(outputs(*values)).backward(create_graph=True),
        lambda: torch.autograd.functional.hvp(lambda *given: loss(outputs(*given)), tuple(values), tuple(values)),
    )
    for way in ways:
        with pytest.raises(RuntimeError, match=r'with etsplat\.engine\("reference"\)'):
            way()


@pytest.mark.parametrize(
    ("name", "by"), [*((name, "cpu") for name in CASES if name not in OF_TORCH), ("rasterize", "reference")]
)
def test_derivatives_in_forward_mode_are_refused(name, by, rng):
    """It was in words of torch, which said to write a function anew."""
    values, outputs = _grown(name, by, rng)
    with torch.autograd.forward_ad.dual_level():
        duals = [torch.autograd.forward_ad.make_dual(value.detach(), torch.ones_like(value)) for value in values]
        with pytest.raises(RuntimeError, match=r"no derivatives in forward mode .*: take backward\(\)"):
            outputs(*duals)


@EVERY_OPERATION
def test_autocast_changes_nothing(name, engine, rng, monkeypatch):
    """Operations compute in the precision of their arguments, also where autocast is on."""
    monkeypatch.setattr("helpers.operations.dtype_of", lambda engine: torch.float32)  # float64 it leaves alone
    values, outputs = _grown(name, engine, rng)
    expected = outputs(*values)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        _assert_same(outputs(*values), expected)


def test_what_autocast_has_halved_is_whole_again(rng):
    """As for torch's own operations that want float32: colours of a network, and their gradients."""
    network, features = torch.nn.Linear(4, 3), torch.rand(80, 4, generator=rng)
    vertices, faces = etsplat.icosphere(1)
    look = {"opacities": torch.ones(80), "sigma": 0.3, "cameras": etsplat.orbit_cameras(16, 16, azimuths=1)}
    with torch.autocast("cpu", dtype=torch.bfloat16):
        colors = network(features)
        assert colors.dtype == torch.bfloat16
        seen = etsplat.rasterize(vertices, faces=faces, face_colors=colors, **look).color
    assert seen.dtype == torch.float32
    assert seen.equal(etsplat.rasterize(vertices, faces=faces, face_colors=colors.float(), **look).color)
    seen.sum().backward()
    assert network.weight.grad is not None
    assert network.weight.grad.any()
    with pytest.raises(ValueError, match=r"face_colors must be torch\.float32 like vertices, got torch\.bfloat16"):
        etsplat.rasterize(vertices, faces=faces, face_colors=colors, **look)


def test_a_graph_without_a_break_says_what_breaks_it():
    """And none of the caches that the compiler warns of stand in its way."""
    target = torch.zeros(1, 8, 8, 3)
    torch._dynamo.reset()
    compiled = torch.compile(lambda color: etsplat.photometric_loss(color, target), backend="eager", fullgraph=True)
    with pytest.raises(torch._dynamo.exc.Unsupported, match=r"etsplat runs native code here.*leave fullgraph=False"):
        compiled(torch.ones(1, 8, 8, 3))


def test_gradients_in_batches_are_refused(rng):
    """They are torch's vmap by another name, and ended in its words."""
    values, outputs = _grown("rasterize", "cpu", rng)
    several = outputs(*values)[0].flatten()[:3]
    with pytest.raises(ValueError, match="without is_grads_batched or vectorize"):
        torch.autograd.grad(several, values, torch.eye(3), is_grads_batched=True, allow_unused=True)


@EVERY_OPERATION
def test_inference_mode_changes_nothing(name, engine, rng):
    values, outputs = _grown(name, engine, rng)
    expected = outputs(*values)
    with torch.inference_mode():
        found = outputs(*(value.detach().clone() for value in values))
    assert all(output.is_inference() for output in found)
    _assert_same(found, expected)


@EVERY_OPERATION
@pytest.mark.parametrize("transform", ["grad", "vmap", "jvp"])
def test_transforms_of_torch_func_are_refused(name, transform, engine, rng):
    """Native code reads memory, which tensors within a transform do not show."""
    if name == "look_at":
        pytest.skip("made of torch alone, which can do this")
    values, outputs = _grown(name, engine, rng)
    values = [value.detach() for value in values]

    def total(*values: Tensor) -> Tensor:
        return loss(outputs(*values))

    def call() -> Any:
        if transform == "jvp":
            return torch.func.jvp(total, tuple(values), tuple(map(torch.ones_like, values)))
        if transform == "vmap":
            return torch.func.vmap(total)(*(value[None] for value in values))
        return torch.func.grad(total)(*values)

    with pytest.raises(ValueError, match=r"must be a plain tensor, got one within a transform of torch\.func"):
        call()
